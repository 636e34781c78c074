"""The run-time function of the observer: equations (10)-(12) and (33)-(36) as one step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from obsynth.designs.core.stepping import (
    FINITE,
    all_finite,
    clip,
    finite_or,
    inside,
    make_step,
    select,
    status_word,
)
from obsynth.symbolic.arrays import FloatArray

if TYPE_CHECKING:
    from obsynth.symbolic import Plant


ROUND_UP = 1.0 + 2.0**-50
# covers the rounding of estimate - half and estimate + half
ULPS = 2.0**-50


@dataclass(frozen=True, eq=False)
class RuntimeBound:
    """How the guaranteed half widths evolve, one scalar recursion per component.

    ``s+ = decay * s + offset``; the half width of a component is
    ``sqrt(s * scale) + add`` if `root` is set (ellipsoids, eqs. (35)-(36)) and
    ``s * scale + add`` otherwise (peak bounds). All arrays have shape (n + n_f,).

    reset: value of s that holds whenever the state, the fault and their estimates lie in the
        declared boxes; infinite where no such box is declared
    """

    decay: FloatArray
    offset: FloatArray
    scale: FloatArray
    add: FloatArray
    root: bool
    reset: FloatArray

    def half_widths(self, s: FloatArray) -> FloatArray:
        """Return the half widths that belong to a value of s."""
        inner = s * self.scale
        return (np.sqrt(inner) if self.root else inner) * ROUND_UP + self.add

    @property
    def steady(self) -> FloatArray:
        """Half widths in the limit k to infinity."""
        return self.half_widths(self.offset / (1.0 - self.decay))


def memory_layout(n: int, n_f: int) -> dict[str, slice]:
    """Return the parts of the memory vector.

    ``z`` (10), ``fhat`` (12), ``bound`` (the s of `RuntimeBound`),
    ``prediction`` (of the state, used when a measurement is missing) and
    ``initialised`` (0 or 1).
    """
    sizes = {"z": n, "fhat": n_f, "bound": n + n_f, "prediction": n, "initialised": 1}
    layout: dict[str, slice] = {}
    at = 0
    for name, size in sizes.items():
        layout[name] = slice(at, at + size)
        at += size
    return layout


def build_step(
    model: Plant,
    C: FloatArray,
    W2: FloatArray,
    E: FloatArray,
    T: FloatArray,
    K: FloatArray,
    F: FloatArray,
    w_centre: FloatArray,
    w_radius: FloatArray,
    bound: RuntimeBound,
) -> ca.Function:
    """Build `Observer.step` of the bounded-error observer.

    Equations (10)-(12) with N = T A - K C and L = K - N E are, with the
    innovation nu_k = y_k - C xhat_k, the same as

        z_{k+1}    = T f(xhat_k, u_k, fhat_k) + K nu_k ,
        xhat_k     = z_k - E y_k ,
        fhat_{k+1} = fhat_k + F nu_k ,

    where f is the plant's own right-hand side without unknown input. This form
    needs neither the split nor N, G, L, so nothing is lost by rounding them.

    Shapes: w_centre, w_radius (n_w,).
    """
    n, n_u, n_f, m = len(model.x), len(model.u), len(model.f), C.shape[0]
    layout = memory_layout(n, n_f)
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

    xhat = z - ca.DM(E) @ y_used
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

    allowed = ca.DM(np.abs(C)) @ half[:n] + ca.DM(np.abs(W2) @ w_radius)
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
    z_next = ca.DM(T) @ next_state + ca.DM(K) @ innovation
    fhat_next = fhat + ca.DM(F) @ innovation
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
