"""What runs: a prediction corrected by the gain, and the bound of its error."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from luenberger.record import LuenbergerDesign
from obsynth.designs.core.boxes import Ends, select
from obsynth.designs.core.core import Core, Known, Parts, Seen
from obsynth.designs.core.given import Start
from obsynth.designs.core.stepping import clip
from obsynth.symbolic.arrays import FloatArray

UP = 1.0 + 2.0**-40
"""Above the relative rounding errors of the sums of one step."""
SETTLED = 1.01
MOST_CALLS = 100_000


def memory_sizes(design: LuenbergerDesign) -> dict[str, int]:
    """Return the parts of the memory: the prediction and the bound of its error."""
    n = len(design.L)
    return {"prediction": n, "bound": n}


def first_memory(design: LuenbergerDesign, start: Start) -> dict[str, ArrayLike]:
    """Start at the guess; how far off it is follows from the box of the first state."""
    return {"prediction": start.guess}


def settling(
    design: LuenbergerDesign, box: FloatArray, calls: int | None = None
) -> tuple[int, FloatArray]:
    """Return how many calls the bound takes to within 1 % of b, and what it is from then on.

    It begins from a box of half widths `box` around an estimate that is within 1 % of b itself.
    The multiple of b that the first bound is below falls from call to call, as N b + n <= b.
    """
    N, n, b, k = design.closed.N, design.closed.n, design.b, 0
    s = float(((2.0 * box + SETTLED * b) / b).max()) * UP * b
    while k < (MOST_CALLS if calls is None else min(calls, MOST_CALLS)):
        if calls is None and np.all(s <= SETTLED * b):
            break
        s, k = np.minimum(s, (N @ s + n) * UP**3), k + 1
    return k, s


def build_core(design: LuenbergerDesign) -> Core:
    """Build the observer; the estimate is clipped to the box, which brings it nearer to x."""
    model, plant = design.model, design.plant
    box, C = plant.box("x"), ca.DM(model.C)

    def run(seen: Seen) -> Known:
        xhat, s = clip(seen.memory["prediction"], box), seen.memory["bound"]
        half = s * UP + 2.0**-40 * ca.fabs(xhat)
        expected = C @ xhat + ca.DM(model.W2 @ model.w_centre)
        innovation = select(seen.all_used, seen.y - expected, 0.0 * expected)
        quiet = [ca.DM.zeros(0)] * 2 + [ca.DM(model.w_centre)] + [ca.DM.zeros(0)] * 2
        moved = plant.function()(xhat, seen.u, *quiet)[0] + ca.DM(design.L) @ innovation

        def grown(comparison: Any) -> ca.SX:
            return (ca.DM(comparison.N) @ half + ca.DM(comparison.n)) * UP

        after = select(seen.all_used, grown(design.closed), grown(design.missing))
        memory = {"prediction": moved, "bound": after}
        return Known(xhat, ca.SX(0, 1), Ends(xhat - half, xhat + half), None, memory)

    def begin(x: Ends, f: Ends, kept: Parts) -> Parts:
        xhat = clip(kept["prediction"], box)
        return {"bound": ca.fmax(x.upper - xhat, xhat - x.lower) * UP + 2.0**-40 * ca.fabs(xhat)}

    own = {"domain": box, "bridges": True, "nonnegative": ("bound",)}
    return Core(run, begin, lambda x, f, kept: kept, **own)
