"""The guaranteed discrete step of the observer, and its continuous form.

Between two samples the output moves, so the bounds of A are frozen over everything it may show:
y - v plus what C x falls in one step at most, up to y + v plus what it rises. The bounding
systems are then linear with constant coefficients over the step, and their exact exponential
(uniformisation, all terms nonnegative) keeps the order for every sample time; zeta, Omega and xi
move by the same transition, so x - zeta + Omega theta keeps its sign. The fault bounds follow by
backward Euler, which is a convex combination of two bounds.
"""

import casadi as ca
import numpy as np

from obsynth.derive.rigour import outward
from obsynth.designs.core.given import Start
from obsynth.designs.core.stepping import (
    all_finite,
    fill,
    finite_or,
    known_signals,
    make_step,
    select,
    slices,
    status_word,
)
from obsynth.designs.set_adaptive.equations import (
    Drive,
    Memory,
    drives,
    ends,
    memory_sizes,
    residuals,
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
    return _parts(design, start.x, f_box)


def _parts(design: SetDesign, x_box: FloatArray, f_box: FloatArray) -> dict[str, FloatArray]:
    """Return the parts of the memory that are not zero, for boxes of the state and the faults."""
    low, high = outward(x_box, design.precision).T
    least, largest = outward(f_box, design.precision).T
    return {
        "zeta_m": low,
        "zeta_M": high,
        "xi_m": low,
        "xi_M": high,
        "theta_m": largest,
        "theta_M": least,
    }


def build_step(design: SetDesign) -> ca.Function:
    """Build `Observer.step`.

    At instant k: first the fault bounds from y_k, then the sets of x_k, then the prediction to
    k + 1 with u_k. The memory of an observer that saw an output outside its range starts again
    when the output is back.
    """
    plant = design.plant
    q, m = len(plant.f), len(plant.output)
    layout = slices(memory_sizes(design))
    vector = ca.SX.sym("memory", layout["initialised"].stop)
    u, y = ca.SX.sym("u", len(plant.u)), ca.SX.sym("y", m)
    theta = ca.SX.sym("theta", sum(s.measured for s in plant.rho))
    scheduled = any(s.name in plant.names("rho") for s in design.bounds.exact)
    x_box, f_box = (outward(plant.box(kind), design.precision) for kind in ("x", "f"))

    y_finite = all_finite(y)
    u_used, theta_used, u_finite, inside = known_signals(plant, u, theta)
    row_of = [int(np.flatnonzero(row)[0]) for row in design.C]
    scale = np.array([design.C[k, i] for k, i in enumerate(row_of)])
    y_box = scale[:, None] * x_box[row_of]
    shown = finite_or(y - ca.DM(design.W2 @ design.w_centre), y_box.mean(axis=1))
    v = ca.DM(design.noise) + SHOWN[design.precision] * (ca.DM(design.noise) + ca.fabs(shown))
    low = select(y_finite, shown - v, ca.SX(y_box[:, 0]))
    high = select(y_finite, shown + v, ca.SX(y_box[:, 1]))
    for k in range(m):
        inside = ca.logic_and(inside, high[k] >= y_box[k, 0])
        inside = ca.logic_and(inside, low[k] <= y_box[k, 1])

    initialised = vector[layout["initialised"]] > 0.5
    again = ca.logic_and(vector[layout["left"]] > 0.5, inside)
    fresh = fill(layout, _parts(design, x_box, f_box))
    memory = Memory(select(again, ca.SX(fresh), vector), design)

    r = residuals(design, memory, low, high)
    sizes = ca.fmax(ca.fabs(low), ca.fabs(high))
    theta_m, theta_M = _adapt(design, memory, r, sizes)
    theta_m = select(y_finite, theta_m, memory["theta_m"])
    theta_M = select(y_finite, theta_M, memory["theta_M"])
    smallest, largest = ca.fmin(theta_m, theta_M), ca.fmax(theta_m, theta_M)
    consistent = ca.SX(1)
    for i in range(q):
        consistent = ca.logic_and(consistent, smallest[i] <= f_box[i, 1])
        consistent = ca.logic_and(consistent, largest[i] >= f_box[i, 0])
    f_lower = select(consistent, ca.fmax(smallest, ca.DM(f_box[:, 0])), smallest)
    f_upper = select(consistent, ca.fmin(largest, ca.DM(f_box[:, 1])), largest)

    C = ca.DM(design.C)
    for k in range(m):
        consistent = ca.logic_and(consistent, (C @ memory["xi_m"])[k] <= high[k])
        consistent = ca.logic_and(consistent, (C @ memory["xi_M"])[k] >= low[k])
    x_lower, x_upper = _contract(
        design, memory, ca.logic_and(inside, consistent), (low, high), row_of
    )

    lower, upper = _frozen(design, low, high, u_used, _exact_arguments(design, u_used, theta_used))
    changed = {"theta_m": theta_m, "theta_M": theta_M}
    changed |= _predict(design, memory, lower, upper, smallest, largest)
    changed |= _monitor(design, memory, r, y_finite)
    usable = ca.logic_and(inside, u_finite)
    changed["left"] = 1 - usable
    changed["initialised"] = ca.SX(1)

    guaranteed = design.law == "cooperative"
    valid = ca.logic_and(initialised, inside) if guaranteed else ca.SX(0)
    claims = {
        "x_lower": (x_lower, -1.0),
        "x_upper": (x_upper, 1.0),
        "f_lower": (f_lower, -1.0),
        "f_upper": (f_upper, 1.0),
    }
    shown_sets = {
        name: ca.vertcat(
            *(
                ca.if_else(initialised, value[i], sign * ca.inf) if guaranteed else sign * ca.inf
                for i in range(value.numel())
            )
        )
        for name, (value, sign) in claims.items()
    }
    inputs = {"memory": vector, "u": u, "y": y}
    if scheduled:
        inputs["theta"] = theta
    return make_step(
        inputs,
        {
            "memory": select(initialised, memory.packed(**changed), vector),
            "xhat": (x_lower + x_upper) / 2.0,
            "fhat": (f_lower + f_upper) / 2.0,
            **shown_sets,
            "status": status_word(
                {
                    "not_initialised": ca.logic_not(initialised),
                    "non_finite_input": ca.logic_not(ca.logic_and(y_finite, u_finite)),
                    "outside_domain": ca.logic_not(inside),
                    "inconsistent_measurement": ca.logic_not(consistent),
                    "fault_not_valid": ca.logic_not(valid),
                }
            ),
        },
    )


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
    memory = Memory(vector, design)
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
    changed = {"theta_m": d_theta[0], "theta_M": d_theta[1]}
    forget = 0.0 if design.window is None else 1.0 / design.window
    for o, drive, bound, residual in (
        ("m", lower, smallest, r[0]),
        ("M", upper, largest, r[1]),
    ):
        N = -ca.DM(design.C) @ memory[f"Omega_{o}"]
        changed[f"zeta_{o}"] = drive.M @ memory[f"zeta_{o}"] + drive.c
        changed[f"Omega_{o}"] = drive.M @ memory[f"Omega_{o}"] - G
        changed[f"xi_{o}"] = drive.M @ memory[f"xi_{o}"] + drive.c + G @ bound
        changed[f"R_{o}"] = N.T @ N - forget * memory[f"R_{o}"]
        changed[f"b_{o}"] = N.T @ residual - forget * memory[f"b_{o}"]
    changed["weight"] = 1.0 - forget * memory["weight"]
    changed["left"] = changed["initialised"] = ca.SX(0)
    inputs = {"memory": vector, "u": u, "y": y}
    if scheduling:
        inputs["theta"] = theta
    return ca.Function(
        "ode",
        list(inputs.values()),
        [ca.densify(memory.packed(**changed))],
        list(inputs),
        ["dmemory"],
    )


def _adapt(
    design: SetDesign, memory: Memory, r: tuple[ca.SX, ca.SX], sizes: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """Fault bounds by backward Euler: in the cooperative law a mean of two bounds, so a bound."""
    C, q, Ts = ca.DM(design.C), len(design.Gamma), design.Ts
    results = []
    for o, other, residual in (("m", "M", r[0]), ("M", "m", r[1])):
        N = -C @ memory[f"Omega_{o}"]
        own, opposite = memory[f"theta_{o}"], memory[f"theta_{other}"]
        if design.law == "printed":
            gain = ca.DM(np.diag(design.Gamma)) * Ts
            system = ca.SX.eye(q) + gain @ N.T @ N
            results.append(ca.densify(ca.solve(system, own + gain @ (N.T @ residual))))
            continue
        parts = []
        for i in range(q):
            k = int(design.fault_outputs[i])
            rest, size = residual[k], sizes[k] + ca.fabs(C[k, :] @ memory[f"zeta_{o}"])
            for j in range(q):
                if j != i:
                    rest = rest - N[k, j] * opposite[j]
                    size = size + ca.fabs(N[k, j] * opposite[j])
            push = Ts * float(design.Gamma[i]) * N[k, i]
            slack = design.rounding * (ca.fabs(own[i]) + push * size)
            moved = own[i] + push * rest + (slack if o == "m" else -slack)
            parts.append(moved / (1.0 + push * N[k, i]))
        results.append(ca.vertcat(*parts))
    return results[0], results[1]


def _contract(
    design: SetDesign,
    memory: Memory,
    usable: ca.SX,
    outputs: tuple[ca.SX, ca.SX],
    row_of: list[int],
) -> tuple[ca.SX, ca.SX]:
    """Intersect xi with the declared ranges and the measurement, where all three agree."""
    box = outward(design.plant.box("x"), design.precision)
    low = ca.fmax(memory["xi_m"], ca.DM(box[:, 0]))
    high = ca.fmin(memory["xi_M"], ca.DM(box[:, 1]))
    for k, i in enumerate(row_of):
        scale = float(design.C[k, i])
        told = outputs[0][k] / scale, outputs[1][k] / scale
        wide = SHOWN[design.precision] * (ca.fabs(told[0]) + ca.fabs(told[1]))
        low[i] = ca.fmax(low[i], told[0] - wide)
        high[i] = ca.fmin(high[i], told[1] + wide)
    agree = usable
    for i in range(len(box)):
        agree = ca.logic_and(agree, low[i] <= high[i])
    return select(agree, low, memory["xi_m"]), select(agree, high, memory["xi_M"])


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
    G = ca.DM(design.G)
    q = len(design.Gamma)
    allowed = ca.DM(np.abs(design.plant.box("f")).max(axis=1))
    changed = {}
    for o, drive, bound, sign in (("m", lower, smallest, -1.0), ("M", upper, largest, 1.0)):
        zeta, Omega, xi = (memory[f"{name}_{o}"] for name in ("zeta", "Omega", "xi"))
        magnitude = ca.fmax(ca.fabs(zeta), ca.fabs(xi)) - Omega @ allowed
        forced = drive.size + G @ ca.fmax(ca.fabs(bound), allowed)
        forced = forced + ca.fabs(drive.M) @ magnitude
        state = ca.horzcat(zeta, xi, Omega, magnitude)
        pushed = ca.horzcat(drive.c, drive.c + G @ bound, -G, forced)
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
    for o, residual in (("m", r[0]), ("M", r[1])):
        N = -ca.DM(design.C) @ memory[f"Omega_{o}"]
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
