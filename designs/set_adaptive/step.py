"""The guaranteed discrete step of the observer, and its continuous form.

Bounds of A are frozen over everything that the output may show until the next sample; the exact
exponential of the bounding systems keeps their order (docs/methods/set_adaptive_observer.md).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from obsynth.derive.rigour import outward
from obsynth.designs.core.boxes import Ends, column, select, some
from obsynth.designs.core.core import Core, Known, Parts, Seen
from obsynth.designs.core.given import Start
from obsynth.designs.core.stepping import make_ode, slices
from obsynth.designs.set_adaptive.equations import (
    MONITORS,
    Drive,
    Memory,
    Pair,
    carried,
    columns,
    drives,
    ends,
    image,
    memory_sizes,
    pulls,
    residuals,
    responses,
    speeds,
    theta_rates,
)
from obsynth.designs.set_adaptive.record import SetDesign
from obsynth.designs.set_adaptive.transition import SHOWN, apply, uniformisation
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError


def first_memory(design: SetDesign, start: Start) -> dict[str, FloatArray]:
    """Start from boxes of the state and of the constant faults; guess and y0 are not used."""
    if design.coordinates is None and np.any(start.x[:, 0] < 0.0):
        raise ObsynthError("x_range reaches below zero, which the method excludes")
    f_box = design.plant.box("f") if start.f_range is None else start.f_range
    z = into(design, *(ca.DM(end) for end in start.x.T))
    z_box = np.column_stack([np.array(end).ravel() for end in z])
    x, f = (outward(box, design.precision).T for box in (z_box, f_box))
    return begun([*x], [*f])


def into(design: SetDesign, low: Any, high: Any) -> tuple[Any, Any]:
    """Return the ends of z, in which the bounds move, for ends of the state."""
    given = design.coordinates
    return carried(None if given is None else given.S, low, high, design.rounding)


def begun(x: Sequence[Any], f: Sequence[Any]) -> dict[str, Any]:
    """Return the parts of the memory that are not zero, for ends of z and of the faults."""
    bounds = {"zeta_m": x[0], "zeta_M": x[1], "xi_m": x[0], "xi_M": x[1]}
    return {**bounds, "theta_m": f[1], "theta_M": f[0]}


def build_core(design: SetDesign) -> Core:
    """Build the observer: fault bounds from y_k, where it is whole, xi of x_k, the prediction."""
    plant, sizes = design.plant, memory_sizes(design)
    m = len(plant.output)
    x_box, f_box = (outward(plant.box(kind), design.precision) for kind in ("x", "f"))
    y_box = outward(design.output_box, design.precision)
    guaranteed, precision = design.law == "cooperative", design.precision

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
        xi = memory["xi_m"], memory["xi_M"]
        least, most = carried(design.frame.C, *xi, design.rounding)
        empty = some(ca.logic_or(least[k] > high[k], most[k] < low[k]) for k in range(m))
        exact = _exact_arguments(design, seen.u, seen.theta)
        x = Ends(*carried(design.frame.back, *xi, design.rounding))
        lower, upper = _frozen(design, low, high, x, seen.u, exact)
        changed = {"theta_m": theta_m, "theta_M": theta_M}
        changed |= _predict(design, memory, lower, upper, smallest, largest)
        changed |= _monitor(design, memory, r, seen.all_used)
        f = Ends(smallest, largest)
        known = Known(
            x.middle(design.precision),
            f.middle(design.precision),
            x,
            f,
            columns(changed),
            empty=empty,
        )
        return known if guaranteed else replace(known, x=None, f=None, empty=no, valid=no)

    def begin(x: Ends, f: Ends, kept: Parts) -> Parts:
        nothing = {name: ca.SX.zeros(sizes[name]) for name in ("Omega_m", "Omega_M")}
        near, faults = (
            x.meet(Ends.of(x_box, precision)),
            f.meet(Ends.of(f_box, precision)),
        )
        z = into(design, near.lower, near.upper)
        return {**nothing, **begun(z, (faults.lower, faults.upper))}

    def place(x: Ends, f: Ends, kept: Parts) -> Parts:
        return {name: ca.SX.zeros(sizes[name]) for name in MONITORS}

    no = ca.SX(0)
    return Core(run, begin, place, domain=x_box, bridges=True)


def build_ode(design: SetDesign) -> ca.Function:
    """Build (memory, u, y[, theta]) -> dmemory of equations (6)-(8), (13), (14)."""
    plant = design.plant
    vector = ca.SX.sym("memory", sum(memory_sizes(design).values()))
    u, y = ca.SX.sym("u", len(plant.u)), ca.SX.sym("y", len(plant.output))
    theta = ca.SX.sym("theta", sum(s.measured for s in plant.rho))
    layout = slices(memory_sizes(design))
    memory = Memory({name: vector[place] for name, place in layout.items()}, design)
    shown = y - ca.DM(design.W2 @ design.w_centre)
    v = ca.DM(design.noise)
    low, high = shown - v, shown + v
    exact = _exact_arguments(design, u, theta)
    xi = Ends(*carried(design.frame.back, memory["xi_m"], memory["xi_M"], 0.0))
    x, states = _state(design, low, high, xi), ends(design, low, high, design.noisy)
    lower, upper = drives(design, states, (low, high), u, exact, (x.lower, x.upper))
    G = ca.DM(design.frame.G)
    r = residuals(design, memory, low, high)
    d_theta = theta_rates(design, memory, r)
    smallest = ca.fmin(memory["theta_m"], memory["theta_M"])
    largest = ca.fmax(memory["theta_m"], memory["theta_M"])
    faults = image(design.frame.G, smallest, largest)
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
    inputs = {"memory": vector, "u": u, "y": y, "theta": theta}
    return make_ode(inputs, ca.vertcat(*(rates[name] for name in layout)))


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


def _state(design: SetDesign, low: ca.SX, high: ca.SX, x: Ends) -> Ends:
    """Return ends of all states from ends of C x, of themselves and of their ranges."""
    names, lower, upper = design.plant.names("x"), ca.SX(x.lower), ca.SX(x.upper)
    for state, first, second in zip(
        design.bounds.states, *map(ca.vertsplit, ends(design, low, high, False)), strict=True
    ):
        i = names.index(state.name)
        lower[i], upper[i] = ca.fmax(lower[i], first), ca.fmin(upper[i], second)
    return Ends(lower, upper).meet(Ends.of(design.plant.box("x"), design.precision))


def _reached(design: SetDesign, now: Ends, speed: Pair, box: FloatArray) -> Pair:
    """Return ends that hold until the next sample for what moves at some speeds inside a box."""
    low, high = map(ca.DM, outward(box, design.precision).T)
    moved = (
        now.lower + design.Ts * ca.fmin(speed[0], 0.0),
        now.upper + design.Ts * ca.fmax(speed[1], 0.0),
    )
    first, second = (ca.fmin(ca.fmax(side, low), high) for side in moved)
    return first, second


def _declared(design: SetDesign, rate: FloatArray, input_rate: FloatArray, u: ca.SX) -> Pair:
    """Return speeds over the declared ranges."""
    push, size = ca.DM(input_rate) @ u, ca.DM(np.abs(rate).max(axis=1))
    wide = SHOWN[design.precision] * (size + ca.fabs(push))
    return ca.DM(rate[:, 0]) + push - wide, ca.DM(rate[:, 1]) + push + wide


def _frozen(
    design: SetDesign, low: ca.SX, high: ca.SX, x: Ends, u: ca.SX, exact: ca.SX
) -> tuple[Drive, Drive]:
    """Return bounding systems for all that C x may show, or states reach, in a sample."""
    given, states = design.coordinates, (x.lower, x.upper)
    if given is None:
        speed = _declared(design, design.rate, design.input_rate, u)
        outputs = _reached(design, Ends(low, high), speed, design.output_box)
        return drives(design, ends(design, *outputs, True), outputs, u, exact, states)
    x_box, now = design.plant.box("x"), _state(design, low, high, x)
    states = _reached(design, now, _declared(design, given.rate, given.input_rate, u), x_box)
    speed = speeds(design, ends(design, *_shown(design, states), True), u, exact, states)
    near = Ends(*_reached(design, now, speed, x_box)).meet(Ends(*states))
    states = near.lower, near.upper
    outputs = _shown(design, states)
    return drives(design, ends(design, *outputs, True), outputs, u, exact, states)


def _shown(design: SetDesign, states: Pair) -> Pair:
    """Return the ends of C x, each a positive multiple of one state."""
    C = ca.DM(design.C)
    slack = design.rounding * (C @ ca.fmax(ca.fabs(states[0]), ca.fabs(states[1])))
    return C @ states[0] - slack, C @ states[1] + slack


def _predict(
    design: SetDesign, memory: Memory, lower: Drive, upper: Drive, smallest: ca.SX, largest: ca.SX
) -> dict[str, ca.SX]:
    """Move zeta, Omega and xi over one step; the last column collects what rounding may do."""
    weights = uniformisation(design.Ts, design.mu)
    G, q = ca.DM(design.frame.G), len(design.Gamma)
    declared = ca.DM(np.abs(design.plant.box("f")).max(axis=1))
    allowed = ca.fmax(declared, ca.fmax(ca.fabs(smallest), ca.fabs(largest)))
    faults = image(design.frame.G, smallest, largest)
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
    return column(
        u[names.index(s.name)] if s.name in names else theta[measured.index(s.name)]
        for s in design.bounds.exact
    )
