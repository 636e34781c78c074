"""The guaranteed discrete step of the observer, and its continuous form.

Between two samples the output moves, so the bounds of A are frozen over everything it may show:
y - v plus what C x falls in one step at most, up to y + v plus what it rises. The bounding
systems are then linear with constant coefficients over the step, and their exact exponential
(uniformisation, all terms nonnegative) keeps the order for every sample time; zeta, Omega and xi
move by the same transition, so x - zeta + Omega theta keeps its sign. The fault bounds follow by
backward Euler, which is a convex combination of two bounds.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from obsynth.derive.rigour import outward
from obsynth.designs.core.boxes import Ends
from obsynth.designs.core.core import Core, Known, Parts, Seen
from obsynth.designs.core.given import Start
from obsynth.designs.core.stepping import select, slices
from obsynth.designs.set_adaptive.equations import (
    MONITORS,
    Drive,
    Memory,
    columns,
    drives,
    ends,
    image,
    memory_sizes,
    pulls,
    residuals,
    responses,
    theta_rates,
)
from obsynth.designs.set_adaptive.record import SetDesign
from obsynth.designs.set_adaptive.transition import SHOWN, apply, uniformisation
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError


def first_memory(design: SetDesign, start: Start) -> dict[str, FloatArray]:
    """Start from boxes of the state and of the constant faults; guess and y0 are not used."""
    if np.any(start.x[:, 0] < 0.0):
        raise ObsynthError("x_range reaches below zero, which the method excludes")
    f_box = design.plant.box("f") if start.f_range is None else start.f_range
    x, f = (outward(box, design.precision).T for box in (start.x, f_box))
    return begun([*x], [*f])


def begun(x: Sequence[Any], f: Sequence[Any]) -> dict[str, Any]:
    """Return the parts of the memory that are not zero, for ends of the state and the faults."""
    bounds = {"zeta_m": x[0], "zeta_M": x[1], "xi_m": x[0], "xi_M": x[1]}
    return {**bounds, "theta_m": f[1], "theta_M": f[0]}


def build_core(design: SetDesign) -> Core:
    """Build the observer.

    At instant k: first the fault bounds from y_k, then xi of x_k, then the prediction to k + 1
    with u_k. Where a reading is missing the output is anywhere in its range, and no fault bound
    moves. The printed law keeps no order, so no bound of it is given.
    """
    plant, sizes = design.plant, memory_sizes(design)
    m = len(plant.output)
    row_of = [int(np.flatnonzero(row)[0]) for row in design.C]
    scale = np.array([design.C[k, i] for k, i in enumerate(row_of)])
    x_box, f_box = (outward(plant.box(kind), design.precision) for kind in ("x", "f"))
    y_box = scale[:, None] * x_box[row_of]
    guaranteed = design.law == "cooperative"
    C = ca.DM(design.C)

    def run(seen: Seen) -> Known:
        memory = Memory(seen.memory, design)
        shown = seen.y - ca.DM(design.W2 @ design.w_centre)
        v = ca.DM(design.noise) + SHOWN[design.precision] * (ca.DM(design.noise) + ca.fabs(shown))
        low, high = (
            ca.vertcat(*(ca.if_else(bit, side[k], end[k]) for k, bit in enumerate(seen.used)))
            for side, end in ((shown - v, y_box[:, 0]), (shown + v, y_box[:, 1]))
        )
        r = residuals(design, memory, low, high)
        theta_m, theta_M = _adapt(design, memory, r, ca.fmax(ca.fabs(low), ca.fabs(high)))
        theta_m = select(seen.all_used, theta_m, memory["theta_m"])
        theta_M = select(seen.all_used, theta_M, memory["theta_M"])
        smallest, largest = ca.fmin(theta_m, theta_M), ca.fmax(theta_m, theta_M)
        empty = ca.SX(0)
        for k in range(m):
            empty = ca.logic_or(empty, (C @ memory["xi_m"])[k] > high[k])
            empty = ca.logic_or(empty, (C @ memory["xi_M"])[k] < low[k])
        exact = _exact_arguments(design, seen.u, seen.theta)
        lower, upper = _frozen(design, low, high, seen.u, exact)
        changed = {"theta_m": theta_m, "theta_M": theta_M}
        changed |= _predict(design, memory, lower, upper, smallest, largest)
        changed |= _monitor(design, memory, r, seen.all_used)
        x, f = Ends(memory["xi_m"], memory["xi_M"]), Ends(smallest, largest)
        known = Known(x.middle, f.middle, x, f, columns(changed), empty=empty)
        return known if guaranteed else replace(known, x=None, f=None, empty=no, valid=no)

    def begin(x: Ends, f: Ends, kept: Parts) -> Parts:
        nothing = {name: ca.SX.zeros(sizes[name]) for name in ("Omega_m", "Omega_M")}
        near = [one.meet(Ends.of(box)) for one, box in ((x, x_box), (f, f_box))]
        return {**nothing, **begun(*((one.lower, one.upper) for one in near))}

    def place(x: Ends, f: Ends, kept: Parts) -> Parts:
        return {name: ca.SX.zeros(sizes[name]) for name in MONITORS}

    no = ca.SX(0)
    return Core(run, begin, place, domain=x_box, bridges=True)


def build_ode(design: SetDesign) -> ca.Function:
    """Build (memory, u, y[, theta]) -> dmemory of equations (6)-(8), (13), (14).

    With noise the bounds are those for states anywhere in y - v to y + v (inside their ranges)
    and the gain is fed with y -+ v; without, they are the printed functions of y, outside of the
    ranges too, as far as they are regular.
    """
    plant = design.plant
    vector = ca.SX.sym("memory", sum(memory_sizes(design).values()))
    u, y = ca.SX.sym("u", len(plant.u)), ca.SX.sym("y", len(plant.output))
    scheduling = [s for s in design.bounds.exact if s.name in plant.names("rho")]
    theta = ca.SX.sym("theta", sum(s.measured for s in plant.rho))
    layout = slices(memory_sizes(design))
    memory = Memory({name: vector[place] for name, place in layout.items()}, design)
    shown = y - ca.DM(design.W2 @ design.w_centre)
    v = ca.DM(design.noise)
    low, high = shown - v, shown + v
    exact = _exact_arguments(design, u, theta)
    lower, upper = drives(design, ends(design, low, high, design.noisy), (low, high), u, exact)
    G = ca.DM(design.G)
    r = residuals(design, memory, low, high)
    d_theta = theta_rates(design, memory, r)
    smallest = ca.fmin(memory["theta_m"], memory["theta_M"])
    largest = ca.fmax(memory["theta_m"], memory["theta_M"])
    faults = image(design.G, smallest, largest)
    changed = {"theta_m": d_theta[0], "theta_M": d_theta[1]}
    forget = 0.0 if design.window is None else 1.0 / design.window
    both = zip(("m", "M"), (lower, upper), faults, r, responses(design, memory), strict=True)
    for o, drive, fault, residual, N in both:
        changed[f"zeta_{o}"] = drive.M @ memory[f"zeta_{o}"] + drive.c
        changed[f"Omega_{o}"] = drive.M @ memory[f"Omega_{o}"] - G
        changed[f"xi_{o}"] = drive.M @ memory[f"xi_{o}"] + drive.c + fault
        changed[f"R_{o}"] = N.T @ N - forget * memory[f"R_{o}"]
        changed[f"b_{o}"] = N.T @ residual - forget * memory[f"b_{o}"]
    changed["weight"] = 1.0 - forget * memory["weight"]
    rates = columns(changed)
    inputs = {"memory": vector, "u": u, "y": y}
    if scheduling:
        inputs["theta"] = theta
    return ca.Function(
        "ode",
        list(inputs.values()),
        [ca.densify(ca.vertcat(*(rates[name] for name in layout)))],
        list(inputs),
        ["dmemory"],
    )


def _adapt(
    design: SetDesign, memory: Memory, r: tuple[ca.SX, ca.SX], sizes: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """Fault bounds by backward Euler: in the cooperative law a mean of bounds, so a bound."""
    own, results = (memory["theta_m"], memory["theta_M"]), []
    if design.law == "printed":
        for N, residual, end in zip(responses(design, memory), r, own, strict=True):
            gain = ca.DM(np.diag(design.Gamma)) * design.Ts
            system = ca.SX.eye(len(design.Gamma)) + gain @ N.T @ N
            results.append(ca.densify(ca.solve(system, end + gain @ (N.T @ residual))))
        return results[0], results[1]
    for found, end, sign in zip(pulls(design, memory, r, sizes), own, (1.0, -1.0), strict=True):
        parts = []
        for i, gain in enumerate((design.Ts * design.Gamma).tolist()):
            moved, size, weight = end[i], ca.fabs(end[i]), ca.SX(1.0)
            for pull in found[i]:
                moved = moved + gain * pull.factor * pull.rest
                size = size + gain * ca.fabs(pull.factor) * pull.size
                weight = weight + gain * pull.factor * pull.factor
            parts.append((moved + sign * design.rounding * size) / weight)
        results.append(ca.vertcat(*parts))
    return results[0], results[1]


def _frozen(
    design: SetDesign, low: ca.SX, high: ca.SX, u: ca.SX, exact: ca.SX
) -> tuple[Drive, Drive]:
    """Return the bounding systems for everything that C x may show until the next sample."""
    push = ca.DM(design.input_rate) @ u
    size = ca.DM(np.abs(design.rate).max(axis=1)) + ca.fabs(push)
    fall = ca.fmin(ca.DM(design.rate[:, 0]) + push - SHOWN[design.precision] * size, 0.0)
    rise = ca.fmax(ca.DM(design.rate[:, 1]) + push + SHOWN[design.precision] * size, 0.0)
    box = []
    for row in design.C:
        i = int(np.flatnonzero(row)[0])
        box.append(row[i] * design.plant.box("x")[i])
    y_box = outward(np.array(box), design.precision)
    reached = (low + design.Ts * fall, high + design.Ts * rise)
    outputs = tuple(
        ca.fmin(ca.fmax(side, ca.DM(y_box[:, 0])), ca.DM(y_box[:, 1])) for side in reached
    )
    return drives(design, ends(design, *reached, clipped=True), (outputs[0], outputs[1]), u, exact)


def _predict(
    design: SetDesign, memory: Memory, lower: Drive, upper: Drive, smallest: ca.SX, largest: ca.SX
) -> dict[str, ca.SX]:
    """Move zeta, Omega and xi over one step; the last column collects what rounding may do."""
    weights = uniformisation(design.Ts, design.mu)
    G, q = ca.DM(design.G), len(design.Gamma)
    declared = ca.DM(np.abs(design.plant.box("f")).max(axis=1))
    allowed = ca.fmax(declared, ca.fmax(ca.fabs(smallest), ca.fabs(largest)))
    faults = image(design.G, smallest, largest)
    changed = {}
    for o, drive, fault, sign in (("m", lower, faults[0], -1.0), ("M", upper, faults[1], 1.0)):
        zeta, Omega, xi = (memory[f"{name}_{o}"] for name in ("zeta", "Omega", "xi"))
        magnitude = ca.fmax(ca.fabs(zeta), ca.fabs(xi)) + ca.fabs(Omega) @ allowed
        forced = drive.size + ca.fabs(G) @ allowed + ca.fabs(drive.M) @ magnitude
        state = ca.horzcat(zeta, xi, Omega, magnitude)
        pushed = ca.horzcat(drive.c, drive.c + fault, -G, forced)
        moved = apply(weights, drive.M, state, pushed)
        slack = sign * design.rounding * moved[:, 2 + q]
        changed[f"zeta_{o}"] = moved[:, 0] + slack
        changed[f"xi_{o}"] = moved[:, 1] + slack
        changed[f"Omega_{o}"] = moved[:, 2 : 2 + q]
    return changed


def _monitor(
    design: SetDesign, memory: Memory, r: tuple[ca.SX, ca.SX], y_finite: ca.SX
) -> dict[str, ca.SX]:
    """Integrals (13) over all time, or with the weight exp(-(age)/window)."""
    keep = 1.0 if design.window is None else float(np.exp(-design.Ts / design.window))
    changed = {"weight": keep * memory["weight"] + design.Ts * y_finite}
    for o, residual, N in zip(("m", "M"), r, responses(design, memory), strict=True):
        for name, value in ((f"R_{o}", N.T @ N), (f"b_{o}", N.T @ residual)):
            added = ca.if_else(y_finite, design.Ts * value, ca.SX(*value.shape))
            changed[name] = keep * memory[name] + added
    return changed


def _exact_arguments(design: SetDesign, u: ca.SX, theta: ca.SX) -> ca.SX:
    """Return the arguments of the bounds that are known exactly, from inputs and scheduling."""
    names = design.plant.names("u")
    measured = [s.name for s in design.plant.rho if s.measured]
    values = [
        u[names.index(s.name)] if s.name in names else theta[measured.index(s.name)]
        for s in design.bounds.exact
    ]
    return ca.vertcat(*values) if values else ca.SX(0, 1)
