"""Symmetric matrices whose entries are functions of a box."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from obsynth.derive.intervals.program import enclose
from obsynth.derive.intervals.search.batch import Problem
from obsynth.derive.rigour import UNIT_ROUNDOFF, middle_and_radius
from obsynth.symbolic.arrays import BoolArray, FloatArray


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
