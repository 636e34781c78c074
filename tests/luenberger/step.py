"""What runs: a prediction corrected by the gain, and the bound of its error."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from luenberger.record import LuenbergerDesign
from luenberger.synthesis import prediction
from obsynth.designs.core.boxes import Ends, Rounding, select
from obsynth.designs.core.core import Core, Known, Parts, Seen
from obsynth.designs.core.given import Start
from obsynth.designs.core.half_widths import UP, above
from obsynth.designs.core.signals import finite_box
from obsynth.designs.core.stepping import clip, inside
from obsynth.symbolic.arrays import FloatArray

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
    up = UP * above(design.precision, len(b)) ** 2
    s = float(((2.0 * box + SETTLED * b) / b).max()) * UP * b
    while k < (MOST_CALLS if calls is None else min(calls, MOST_CALLS)):
        if calls is None and np.all(s <= SETTLED * b):
            break
        s, k = np.minimum(s, (N @ s + n) * up**3), k + 1
    return k, s


def build_core(design: LuenbergerDesign) -> Core:
    """Build the observer; the estimate is clipped to the box, which brings it nearer to x."""
    model, plant, precision = design.model, design.plant, design.precision
    box, limits = plant.box("x"), finite_box(plant, "u")
    moved, up = prediction(model, design.L), above(precision, len(design.L))
    blind = prediction(model, 0.0 * design.L)
    ulps = 4.0 * Rounding(precision).step

    def run(seen: Seen) -> Known:
        xhat, s = clip(seen.memory["prediction"], box, precision), seen.memory["bound"]
        half = s * up + ulps * ca.fabs(xhat)

        def grown(comparison: Any) -> ca.SX:
            return (ca.DM(comparison.N) @ half + ca.DM(comparison.n)) * up

        y, used = seen.y, seen.all_used
        memory = {
            "prediction": select(used, moved(xhat, seen.u, y), blind(xhat, seen.u, 0.0 * y)),
            "bound": select(used, grown(design.closed), grown(design.missing)),
        }
        sound = inside(seen.u, seen.u, limits, precision)
        sets = Ends(xhat - half, xhat + half)
        return Known(xhat, ca.SX(0, 1), sets, None, memory, sound=sound)

    def begin(x: Ends, f: Ends, kept: Parts) -> Parts:
        xhat = clip(kept["prediction"], box, precision)
        return {"bound": ca.fmax(x.upper - xhat, xhat - x.lower) * up + ulps * ca.fabs(xhat)}

    own = {"domain": box, "bridges": True, "nonnegative": ("bound",)}
    return Core(run, begin, lambda x, f, kept: kept, **own)
