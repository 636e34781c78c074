"""The run-time function of the filter: equations (18)-(19) in the order in which data arrive."""

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from obsynth.designs.core.given import Start
from obsynth.designs.core.signals import noise_centre
from obsynth.designs.core.stepping import (
    all_finite,
    clip,
    finite_or,
    inside,
    make_step,
    select,
    slices,
    status_word,
)
from obsynth.designs.hinf.record import HinfDesign
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray


def memory_sizes(design: HinfDesign) -> dict[str, int]:
    """Return the parts of the memory vector.

    ``prediction`` (p of the state now), ``innovation`` (y - C xhat of the instant before),
    ``running`` (1 after the first sample), ``known_input`` (1 if u of the instant before was
    finite) and ``initialised`` (0 or 1).
    """
    m, n = design.C.shape
    return {"prediction": n, "innovation": m, "running": 1, "known_input": 1, "initialised": 1}


def first_memory(design: HinfDesign, start: Start) -> dict[str, ArrayLike]:
    """Start at the guess; the boxes and y0 are not needed, as no set is carried along."""
    return {"prediction": start.guess}


def output_box(C: FloatArray, box: FloatArray) -> FloatArray:
    """Return the ranges of C x over a box of shape (n, 2), rounded outwards, shape (m, 2)."""
    rows = []
    for row in C:
        used = np.flatnonzero(row)
        ends = np.sort(row[used, None] * box[used], axis=1)
        low, high = ends.sum(axis=0) if used.size else np.zeros(2)
        slack = 2.0**-48 * float(np.abs(ends[np.isfinite(ends)]).sum())
        rows.append((low - slack, high + slack))
    return np.array(rows).reshape(len(C), 2)


def predict(model: Plant, A: FloatArray, xhat: ca.SX, u: ca.SX) -> ca.SX:
    """Return A xhat + B u + g(c, u) with c the nearest point of the box of the states.

    The right-hand side of the plant at c, with w at its middle, is A c + B u + g(c, u) and what
    that w adds, so neither B nor g is needed, and inside the box nothing else is added.
    """
    nearest = clip(xhat, model.box("x"))
    kinds = ("d", "f", "w", "p", "rho")
    quiet = [ca.DM.zeros(len(model.names(kind))) for kind in kinds]
    quiet[kinds.index("w")] = ca.DM(noise_centre(model))
    value = model.function()(nearest, u, *quiet)[0]
    return value + ca.DM(A) @ (xhat - nearest)


def build_step(design: HinfDesign) -> ca.Function:
    """Build `Observer.step` of the H-infinity filter.

    f_k shows in y_{k+1} only, so at instant k the step returns xhat_k and fhat_{k-1}:

        r = y_k - C p ,  fhat_{k-1} = H r + D r0 ,  xhat_k = p + F r + K r0 ,
        r0 = y_k - C xhat_k ,  p = A xhat_k + B u_k + g(xhat_k, u_k) .

    The first sample has no prediction behind it: xhat_0 is the guess.
    """
    model, C, gains = design.plant, design.C, design.gains
    n, n_u, n_f, m = len(model.x), len(model.u), len(model.f), len(C)
    layout = slices(memory_sizes(design))
    memory = ca.SX.sym("memory", layout["initialised"].stop)
    u, y = ca.SX.sym("u", n_u), ca.SX.sym("y", m)
    p, r0 = memory[layout["prediction"]], memory[layout["innovation"]]
    initialised, running, known = (
        memory[layout[name]] > 0.5 for name in ("initialised", "running", "known_input")
    )
    y_finite, u_finite = all_finite(y), all_finite(u)
    expected = ca.DM(C) @ p
    # One missing entry of y leaves no innovation in any: the gains mix them.
    r = ca.vertcat(*(ca.if_else(y_finite, y[i] - expected[i], 0.0) for i in range(m)))
    nominal = [0.0 if signal.nominal is None else float(signal.nominal) for signal in model.u]
    u_used = finite_or(u, nominal)

    corrected = p + ca.DM(gains.F) @ r + ca.DM(gains.K) @ r0
    xhat = select(running, corrected, p)
    output = ca.DM(C) @ xhat
    valid = ca.logic_and(ca.logic_and(initialised, running), ca.logic_and(known, y_finite))
    estimate = ca.DM(gains.H) @ r + ca.DM(gains.D) @ r0
    fhat = ca.vertcat(*(ca.if_else(valid, estimate[i], 0.0) for i in range(n_f)))

    box, u_box = model.box("x"), model.box("u")
    y_box = output_box(C, box)
    in_domain = ca.logic_and(inside(xhat, xhat, box), inside(u_used, u_used, u_box))
    in_domain = ca.logic_and(in_domain, ca.logic_or(ca.logic_not(y_finite), inside(y, y, y_box)))
    status = status_word(
        {
            "not_initialised": ca.logic_not(initialised),
            "non_finite_input": ca.logic_not(ca.logic_and(y_finite, u_finite)),
            "outside_domain": ca.logic_not(in_domain),
            "fault_not_valid": ca.logic_not(valid),
        }
    )
    kept = ca.vertcat(*(ca.if_else(y_finite, y[i] - output[i], 0.0) for i in range(m)))
    moved = ca.vertcat(predict(model, design.A, xhat, u_used), kept, 1, u_finite, 1)
    infinite = ca.DM.inf(n), ca.DM.inf(n_f)
    return make_step(
        {"memory": memory, "u": u, "y": y},
        {
            "memory": select(initialised, moved, memory),
            "xhat": xhat,
            "fhat": fhat,
            "x_lower": ca.SX(-infinite[0]),
            "x_upper": ca.SX(infinite[0]),
            "f_lower": ca.SX(-infinite[1]),
            "f_upper": ca.SX(infinite[1]),
            "status": status,
        },
    )
