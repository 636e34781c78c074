"""Bounds of concave goals: climb to the top of the box, then trust the tangent there."""

from collections.abc import Callable

import numpy as np

from obsynth.derive.intervals.search.batch import RowRanges, Rows
from obsynth.derive.intervals.search.curvature import Hessians, tangent_rise
from obsynth.derive.rigour.interval import Array, Mask, up

_STEPS = 4


def _newton(rows: Rows, hessians: Hessians, at: Array, slope: Array) -> Array:
    """One step of Newton's method inside the boxes, along the variables that may still move."""
    pressed = ((at <= rows.lower) & (slope < 0.0)) | ((at >= rows.upper) & (slope > 0.0))
    still: Mask = (pressed | (rows.upper <= rows.lower)).T
    matrix = 0.5 * (hessians.lower + hessians.upper)
    matrix[still[:, :, None] | still[:, None, :]] = 0.0
    diagonal = np.einsum("nii->ni", matrix)
    diagonal[still] = -1.0
    diagonal[...] = np.where(diagonal < 0.0, diagonal, -1.0)
    try:
        step = np.linalg.solve(matrix, -np.where(still, 0.0, slope.T)[:, :, None])[:, :, 0].T
    except np.linalg.LinAlgError:
        return at
    moved = at + np.where(np.isfinite(step), step, 0.0)
    return np.clip(moved, rows.lower, rows.upper)


def concave_bounds(
    rows: Rows,
    hessians: Hessians,
    start: Array,
    slope: Array,
    evaluate: Callable[[Rows], RowRanges],
    is_open: Callable[[Rows], Mask],
) -> Array:
    """Bound goals that are concave over their boxes.

    A concave f lies below every tangent, f(x) <= f(c) + f'(c) (x - c). Whatever c is, the bound
    holds; at the top of the box it is the largest value, up to rounding.
    """
    bound, index = rows.bound.copy(), np.arange(rows.count)
    at = start
    for _ in range(_STEPS):
        at = _newton(rows, hessians, at, slope)
        found = evaluate(Rows(rows.goal, at, at, rows.bound))
        ends = found.slope_lower, found.slope_upper
        top = up(found.upper + tangent_rise(rows.lower, rows.upper, at, ends))
        bound[index] = np.fmin(bound[index], top)
        rows = Rows(rows.goal, rows.lower, rows.upper, bound[index])
        left = np.flatnonzero(is_open(rows))
        if not len(left):
            break
        slope = 0.5 * (ends[0] + ends[1])[:, left]
        rows, hessians, at, index = rows.take(left), hessians.take(left), at[:, left], index[left]
    return bound
