"""What runs: a prediction corrected by the gain, and the bound of its error."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from luenberger.record import LuenbergerDesign
from obsynth.designs.core.given import Start
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

UP = 1.0 + 2.0**-40
"""Above the relative rounding errors of the sums of one step."""


def memory_sizes(design: LuenbergerDesign) -> dict[str, int]:
    """Return the parts of the memory: the prediction, the bound of its error, a flag."""
    n = len(design.L)
    return {"prediction": n, "bound": n, "initialised": 1}


def first_memory(design: LuenbergerDesign, start: Start) -> dict[str, ArrayLike]:
    """Start at the guess, as far off as the box of the first state says."""
    return {
        "prediction": start.guess,
        "bound": np.abs(start.x - start.guess[:, None]).max(axis=1) * UP,
    }


def build_step(design: LuenbergerDesign) -> ca.Function:
    """Build `Observer.step`; the estimate is clipped to the box, which brings it nearer to x."""
    model, plant = design.model, design.plant
    n, m, box = len(design.L), len(model.C), plant.box("x")
    layout = slices(memory_sizes(design))
    memory = ca.SX.sym("memory", layout["initialised"].stop)
    u, y = ca.SX.sym("u", len(plant.u)), ca.SX.sym("y", m)
    initialised = memory[layout["initialised"]] > 0.5
    xhat, s = clip(memory[layout["prediction"]], box), memory[layout["bound"]]
    half = s * UP + 2.0**-40 * ca.fabs(xhat)
    seen, known = all_finite(y), all_finite(u)
    C = ca.DM(model.C)
    expected = C @ xhat + ca.DM(model.W2 @ model.w_centre)
    innovation = finite_or(y, expected) - expected
    allowed = ca.DM(np.abs(model.C)) @ half + ca.DM(np.abs(model.W2) @ model.w_radius)
    consistent = ca.SX(1)
    for i in range(m):
        fits = ca.fabs(innovation[i]) <= allowed[i] * UP + 2.0**-40 * ca.fabs(expected[i])
        consistent = ca.logic_and(consistent, fits)
    nominal = [0.0 if v.nominal is None else float(v.nominal) for v in plant.u]
    quiet = [ca.DM.zeros(0)] * 2 + [ca.DM(model.w_centre)] + [ca.DM.zeros(0)] * 2
    moved = plant.function()(xhat, finite_or(u, nominal), *quiet)[0]
    moved = moved + ca.DM(design.L) @ select(seen, innovation, 0.0 * expected)

    def grown(comparison: Any) -> ca.SX:
        return (ca.DM(comparison.N) @ half + ca.DM(comparison.n)) * UP

    after = select(seen, grown(design.closed), grown(design.missing))
    after = select(known, after, ca.SX.inf(n))
    lower, upper = xhat - half, xhat + half
    bits = {
        "not_initialised": ca.logic_not(initialised),
        "non_finite_input": ca.logic_not(ca.logic_and(seen, known)),
        "outside_domain": ca.logic_not(inside(lower, upper, box)),
        "inconsistent_measurement": ca.logic_not(consistent),
    }
    outputs = {
        "memory": select(initialised, ca.vertcat(moved, after, 1), memory),
        "xhat": xhat,
        "x_lower": lower,
        "x_upper": upper,
        "status": status_word(bits),
        **dict.fromkeys(("fhat", "f_lower", "f_upper"), ca.SX(0, 1)),
    }
    return make_step({"memory": memory, "u": u, "y": y}, outputs)
