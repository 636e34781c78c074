"""Symmetric matrices over boxes: as functions, and as intervals with extreme eigenvalue and norm.

x'Ax over the matrices with |A - C| <= R is x'Cx + |x|'R|x|, which is x'(C + S R S)x with the signs
of x on the diagonal of S. So the largest eigenvalue over all of them is the largest over the sign
matrices (Hertz 1992), and it is attained there. The norm is the largest eigenvalue of [0 A; A' 0],
with one sign per row and one per column (Rohn). A sign matters only where R couples it with
others: one sign per connected part of R is free.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from obsynth.derive.algebra.connected import connected
from obsynth.derive.intervals.program import enclose
from obsynth.derive.intervals.search.batch import Problem
from obsynth.derive.rigour import (
    UNIT_ROUNDOFF,
    finite,
    largest_eigenvalue,
    middle_and_radius,
    perron_bound,
    up,
)
from obsynth.symbolic.arrays import BoolArray, FloatArray

MOST_SIGNS = 16


@dataclass(frozen=True, eq=False)
class FieldRange:
    """Matrices and their derivatives over a batch of boxes: within centre +- radius.

    smooth: where the derivatives say how the matrices change over the box
    """

    centre: FloatArray
    radius: FloatArray
    slope_centre: FloatArray
    slope_radius: FloatArray
    smooth: BoolArray


@dataclass(frozen=True, eq=False)
class SymmetricField:
    """S(z) = fixed + sum over e of s_e(z) at (row_e, column_e), row <= column, and its mirror.

    `lower` and `upper` are guaranteed ranges of the s_e over the box of the problem.
    """

    problem: Problem
    rows: Sequence[int]
    columns: Sequence[int]
    fixed: FloatArray
    lower: FloatArray
    upper: FloatArray

    @property
    def size(self) -> int:
        """Rows of the matrices."""
        return len(self.fixed)

    @property
    def variables(self) -> int:
        """Number of variables of the box."""
        return len(self.problem.lower)

    def _place(self, values: FloatArray) -> FloatArray:
        """Put values, shape (m, ...), at both places of every expression."""
        k = self.size
        result = np.zeros((k, k, *values.shape[1:]))
        for value, i, j in zip(values, self.rows, self.columns, strict=True):
            result[i, j] = value
            result[j, i] = value
        return np.moveaxis(result, (0, 1), (-2, -1))

    def over(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Enclose the matrices over boxes."""
        m = len(self.rows)
        found = enclose(self.problem.program, lower, upper, range(m), 0)
        return self._matrices(found.lower, found.upper)

    def matrix_of_ranges(self) -> tuple[FloatArray, FloatArray]:
        """Return centre and radius, (1, k, k), of the entrywise ranges over the whole box."""
        return self._matrices(self.lower[:, None], self.upper[:, None])

    def _matrices(self, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
        low = np.maximum(low, self.lower[:, None])
        high = np.minimum(high, self.upper[:, None])
        centre, radius = middle_and_radius(low, high)
        centre, radius = self._place(centre) + self.fixed, self._place(radius)
        return centre, radius + 2.0 * UNIT_ROUNDOFF * (np.abs(centre) + np.abs(self.fixed))

    def with_slopes(self, lower: FloatArray, upper: FloatArray) -> FieldRange:
        """Enclose matrices and derivatives over boxes."""
        problem, m = self.problem, len(self.rows)
        used = sorted({k for k in problem.gradient.ravel().tolist() if k >= 0})
        found = enclose(problem.program, lower, upper, [*range(m), *used], m)
        centre, radius = self._matrices(found.lower[:m], found.upper[:m])
        row = np.zeros(len(problem.program.outputs), dtype=np.int64)
        row[used] = m + np.arange(len(used))
        place, present = row[problem.gradient], problem.gradient[:, :, None] >= 0
        slope_lower = np.where(present, found.lower[place], 0.0)
        slope_upper = np.where(present, found.upper[place], 0.0)
        finite = np.isfinite(slope_lower) & np.isfinite(slope_upper)
        smooth = np.asarray(finite.all(axis=(0, 1)) & ~found.rough[:m].any(axis=0), dtype=np.bool_)
        slope_lower, slope_upper = slope_lower * smooth, slope_upper * smooth
        slope_centre, slope_radius = middle_and_radius(
            np.where(smooth, slope_lower, 0.0), np.where(smooth, slope_upper, 0.0)
        )
        return FieldRange(
            centre,
            radius,
            np.swapaxes(self._place(slope_centre), 0, 1),
            np.swapaxes(self._place(slope_radius), 0, 1),
            smooth,
        )


def augment(matrix: FloatArray) -> FloatArray:
    """Return [0 A; A' 0], whose largest eigenvalue is the norm of A."""
    *front, m, n = matrix.shape
    result = np.zeros((*front, m + n, m + n))
    result[..., :m, m:] = matrix
    result[..., m:, :m] = np.swapaxes(matrix, -1, -2)
    return result


def sign_patterns(coupled: BoolArray, most: int = MOST_SIGNS) -> FloatArray | None:
    """List the sign vectors that can make a difference."""
    k = len(coupled)
    groups = connected(np.flatnonzero(row).tolist() for row in coupled | np.eye(k, dtype=bool))
    free = [other for group in groups for other in group[1:]]
    if len(free) > most:
        return None
    patterns = np.ones((1 << len(free), k))
    for pattern, signs in zip(patterns, product((1.0, -1.0), repeat=len(free)), strict=True):
        pattern[free] = signs
    return patterns


def eigenvalue_over_interval(
    centre: FloatArray, radius: FloatArray, most: int = MOST_SIGNS
) -> tuple[FloatArray, bool]:
    """Bound the largest eigenvalue over each interval of a batch, (N, k, k), and say how.

    Exact up to rounding when all sign matrices were looked at, up to 2^most of them (Hertz 1992).
    """
    coupled: BoolArray = np.asarray((radius > 0.0).any(axis=0), dtype=np.bool_)
    patterns = sign_patterns(coupled, most)
    if patterns is None:
        return up(largest_eigenvalue(centre)[1] + perron_bound(radius)), False
    known = np.where(np.isfinite(radius), radius, 0.0)
    bound = np.full(len(centre), -np.inf)
    for signs in np.array_split(patterns, max(1, len(patterns) * len(centre) // 4096)):
        corners = centre[:, None] + signs[:, :, None] * known[:, None] * signs[:, None, :]
        flat = corners.reshape(-1, *centre.shape[1:])
        upper = largest_eigenvalue(flat, 2.0 * UNIT_ROUNDOFF * np.abs(flat))[1]
        bound = np.maximum(bound, upper.reshape(corners.shape[:2]).max(axis=1))
    return np.where(finite(radius), bound, np.inf), True
