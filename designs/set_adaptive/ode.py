"""The continuous form of the observer, `Observer.ode`."""

from __future__ import annotations

import casadi as ca

from obsynth.designs.set_adaptive.equations import (
    Memory,
    drives,
    ends,
    memory_layout,
    residuals,
    theta_rates,
)
from obsynth.designs.set_adaptive.record import SetDesign


def build_ode(design: SetDesign) -> ca.Function:
    """Build (memory, u, y[, theta]) -> dmemory of equations (6)-(8), (13), (14).

    With noise the bounds are those for states anywhere in y - v to y + v (inside their ranges)
    and the gain is fed with y -+ v; without, they are the printed functions of y, outside of the
    ranges too, as far as they are regular.
    """
    plant = design.plant
    n, q = len(plant.x), len(plant.f)
    noisy = bool(design.options["noise"])
    vector = ca.SX.sym("memory", memory_layout(n, q)["initialised"].stop)
    u, y = ca.SX.sym("u", len(plant.u)), ca.SX.sym("y", len(plant.output))
    scheduling = [s for s in design.bounds.exact if s.name in plant.names("rho")]
    theta = ca.SX.sym("theta", sum(s.measured for s in plant.rho))
    memory = Memory(vector, n, q)
    shown = y - ca.DM(design.W2 @ design.w_centre)
    v = ca.DM(design.noise)
    low, high = shown - v, shown + v
    exact = exact_arguments(design, u, theta)
    lower, upper = drives(design, ends(design, low, high, noisy), (low, high), u, exact)
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


def exact_arguments(design: SetDesign, u: ca.SX, theta: ca.SX) -> ca.SX:
    """Return the arguments of the bounds that are known exactly, from inputs and scheduling."""
    names = design.plant.names("u")
    measured = [s.name for s in design.plant.rho if s.measured]
    values = [
        u[names.index(s.name)] if s.name in names else theta[measured.index(s.name)]
        for s in design.bounds.exact
    ]
    return ca.vertcat(*values) if values else ca.SX(0, 1)
