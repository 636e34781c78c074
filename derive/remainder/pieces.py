"""Hull of an interval program over a box that is cut into many pieces, without derivatives.

For expressions that only have to be bounded in their order of magnitude: one sweep over a batch of
pieces costs far less than gradients of a long program.
"""

from collections.abc import Sequence

import numpy as np

from obsynth.derive.intervals.program import Program, evaluate
from obsynth.symbolic.arrays import FloatArray

PIECES = {"fast": 256, "normal": 4096, "tight": 65536}


def hull_over_pieces(
    program: Program, box: FloatArray, pieces: int, cuts: Sequence[int] | None = None
) -> tuple[FloatArray, FloatArray]:
    """Enclose all outputs of a program over a box."""
    lower, upper = box[:, :1].copy(), box[:, 1:].copy()
    for axis in plan_cuts(program, box, pieces) if cuts is None else cuts:
        lower, upper = _halve(lower, upper, axis)
    low, high = evaluate(program, lower, upper)
    return low.min(axis=1), high.max(axis=1)


def plan_cuts(program: Program, box: FloatArray, pieces: int) -> list[int]:
    """Choose which variables to halve.

    Every variable is halved once for a trial; the cuts go where they promise most, each one half
    of what the one before it gave.
    """
    used = sorted({j for k in range(len(program.outputs)) for j in program.support(k)})
    axes = [j for j in used if box[j, 1] > box[j, 0]]
    if not axes or pieces < 2:
        return []
    lower, upper = box[:, :1], box[:, 1:]
    # the whole box and all trials in one batch
    trials = [(lower, upper), *(_halve(lower, upper, j) for j in axes)]
    low, high = evaluate(
        program, np.hstack([t[0] for t in trials]), np.hstack([t[1] for t in trials])
    )
    whole = high[:, 0] - low[:, 0]
    gains = {}
    for row, j in enumerate(axes):
        pair = slice(1 + 2 * row, 3 + 2 * row)
        halved = high[:, pair].max(axis=1) - low[:, pair].min(axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.where(whole > 0.0, 1.0 - halved / whole, 0.0)
        # an infinite hull that becomes finite is the best that can happen
        share = np.where(np.isfinite(halved) & ~np.isfinite(whole), 1.0, share)
        gains[j] = float(np.where(np.isfinite(share), share, 0.0).sum())
    cuts: list[int] = []
    while 2 << len(cuts) <= pieces:
        axis = max(axes, key=lambda j: gains[j])
        gains[axis] *= 0.5
        cuts.append(axis)
    return cuts


def _halve(lower: FloatArray, upper: FloatArray, axis: int) -> tuple[FloatArray, FloatArray]:
    middle = np.clip(0.5 * (lower[axis] + upper[axis]), lower[axis], upper[axis])
    left, right = upper.copy(), lower.copy()
    left[axis], right[axis] = middle, middle
    return np.hstack([lower, right]), np.hstack([left, upper])
