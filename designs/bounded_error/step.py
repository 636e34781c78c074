"""The run-time function of the observer: equations (10)-(12) and (33)-(36) as one step."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from obsynth.designs.bounded_error.peak.design import first_transient, peak_runtime
from obsynth.designs.bounded_error.record import EllipsoidBound, UioDesign
from obsynth.designs.bounded_error.runtime import (
    ROUND_UP,
    ULPS,
    RuntimeBound,
    StartBox,
    check_range_of_T,
    ellipsoid_runtime,
    first_levels,
)
from obsynth.designs.core.given import Start, read_vector
from obsynth.designs.core.stepping import (
    FINITE,
    all_finite,
    clip,
    finite_or,
    inside,
    make_step,
    select,
    slices,
    status_word,
)


def memory_sizes(design: UioDesign) -> dict[str, int]:
    """Return the parts of the memory vector.

    ``z`` (10), ``fhat`` (12), ``bound`` (the s of `RuntimeBound`),
    ``prediction`` (of the state, used when a measurement is missing) and
    ``initialised`` (0 or 1).
    """
    n, n_f = len(design.A), len(design.rate)
    return {"z": n, "fhat": n_f, "bound": n + n_f, "prediction": n, "initialised": 1}


def running_bound(design: UioDesign) -> RuntimeBound:
    """Return how the half widths of a design evolve."""
    ellipsoid = isinstance(design.bound, EllipsoidBound)
    return ellipsoid_runtime(design) if ellipsoid else peak_runtime(design)


def first_memory(
    design: UioDesign, start: Start, z0: ArrayLike | None = None
) -> dict[str, ArrayLike]:
    """Start at z_0 = T guess, or at a given z_0 as the paper does; y0 is not needed."""
    x_box, z = start.x, design.T @ start.guess
    if z0 is not None:
        z = read_vector(z0, "z0", design.plant.names("x"))
        if isinstance(design.bound, EllipsoidBound):
            check_range_of_T(design, design.bound, z)
    fhat = start.f.mean(axis=1)
    box = StartBox(design, z, x_box, fhat, start.f)
    first = first_levels if isinstance(design.bound, EllipsoidBound) else first_transient
    return {"z": z, "fhat": fhat, "bound": first(design, box), "prediction": start.guess}


def build_step(design: UioDesign) -> ca.Function:
    """Build `Observer.step` of the bounded-error observer.

    Equations (10)-(12) with N = T A - K C and L = K - N E are, with the
    innovation nu_k = y_k - C xhat_k, the same as

        z_{k+1}    = T f(xhat_k, u_k, fhat_k) + K nu_k ,
        xhat_k     = z_k - E y_k ,
        fhat_{k+1} = fhat_k + F nu_k ,

    where f is the plant's own right-hand side without unknown input. This form
    needs neither the split nor N, G, L, so nothing is lost by rounding them.
    """
    bound = running_bound(design)
    model, C, W2, w_centre = design.plant, design.C, design.W2, design.w_centre
    n, n_u, n_f, m = len(model.x), len(model.u), len(model.f), C.shape[0]
    layout = slices(memory_sizes(design))
    memory = ca.SX.sym("memory", layout["initialised"].stop)
    u, y = ca.SX.sym("u", n_u), ca.SX.sym("y", m)
    z, fhat, s, prediction = (memory[layout[k]] for k in ("z", "fhat", "bound", "prediction"))
    initialised = memory[layout["initialised"]] > 0.5
    box, f_box = model.box("x"), model.box("f")

    y_shifted = y - ca.DM(W2 @ w_centre)
    y_finite, u_finite = all_finite(y), all_finite(u)
    expected = ca.DM(C) @ prediction
    y_used = finite_or(y_shifted, expected)
    nominal = [0.0 if signal.nominal is None else float(signal.nominal) for signal in model.u]
    u_used = finite_or(u, nominal)

    xhat = z - ca.DM(design.E) @ y_used
    innovation = y_used - ca.DM(C) @ xhat
    xhat_inside = inside(xhat, xhat, box)
    fhat_inside = inside(fhat, fhat, f_box)
    can_reset = ca.logic_and(xhat_inside, fhat_inside)
    s_parts = []
    for i in range(n + n_f):
        kept = s[i]
        if np.isfinite(bound.reset[i]):
            again = ca.if_else(can_reset, float(bound.reset[i]), ca.inf)
            kept = ca.if_else(s[i] <= FINITE, s[i], again)
        s_parts.append(ca.if_else(y_finite, kept, ca.inf))
    s_now = ca.vertcat(*s_parts)
    inner = s_now * ca.DM(bound.scale)
    estimate = ca.vertcat(xhat, fhat)
    half = (ca.sqrt(inner) if bound.root else inner) * ROUND_UP + ca.DM(bound.add)
    half = half + ULPS * ca.fabs(estimate)
    valid = ca.logic_and(initialised, s_now[0] <= FINITE)
    half = ca.vertcat(*(ca.if_else(valid, half[i], ca.inf) for i in range(n + n_f)))
    x_lower, x_upper = xhat - half[:n], xhat + half[:n]
    f_lower, f_upper = fhat - half[n:], fhat + half[n:]

    allowed = ca.DM(np.abs(C)) @ half[:n] + ca.DM(np.abs(W2) @ design.w_radius)
    consistent = ca.SX(1)
    for i in range(m):
        consistent = ca.logic_and(consistent, ca.fabs(innovation[i]) <= allowed[i])
    status = status_word(
        {
            "not_initialised": ca.logic_not(initialised),
            "non_finite_input": ca.logic_not(ca.logic_and(y_finite, u_finite)),
            "outside_domain": ca.logic_not(
                ca.logic_and(inside(x_lower, x_upper, box), xhat_inside)
            ),
            "inconsistent_measurement": ca.logic_not(consistent),
            "fault_not_valid": ca.logic_not(valid),
        }
    )

    # Outside the box the dynamics may not be defined (a level below zero); the
    # estimate is clipped there so that the recursion stays finite. Inside, where
    # the guarantee holds, clipping does nothing.
    rhs = model.function()
    zeros = {"d": len(model.d), "p": len(model.p), "rho": len(model.rho)}
    next_state = rhs(
        clip(xhat, box),
        u_used,
        ca.DM.zeros(zeros["d"]),
        fhat,
        ca.DM(w_centre),
        ca.DM.zeros(zeros["p"]),
        ca.DM.zeros(zeros["rho"]),
    )[0]
    z_next = ca.DM(design.T) @ next_state + ca.DM(design.K) @ innovation
    fhat_next = fhat + ca.DM(design.F) @ innovation
    s_next = ca.DM(bound.decay) * s_now + ca.DM(bound.offset)
    s_next = ca.vertcat(*(ca.if_else(u_finite, s_next[i], ca.inf) for i in range(n + n_f)))
    moved = ca.vertcat(z_next, fhat_next, s_next, next_state, 1)
    return make_step(
        {"memory": memory, "u": u, "y": y},
        {
            "memory": select(initialised, moved, memory),
            "xhat": xhat,
            "fhat": fhat,
            "x_lower": x_lower,
            "x_upper": x_upper,
            "f_lower": f_lower,
            "f_upper": f_upper,
            "status": status,
        },
    )
