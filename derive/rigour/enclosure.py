"""Matrices with a radius: sums and products of doubles with rigorous rounding bounds.

S. M. Rump, "Fast and parallel interval arithmetic", BIT 39 (1999), gives the midpoint-radius
products; here the rounding mode stays to nearest, so every radius is computed with the bound
n u / (1 - n u) on a sum of n products, which holds for any order of summation and with fused
multiply-adds (N. J. Higham, Accuracy and Stability, section 3.1).
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive.rigour.rationals import ExactMatrix
from obsynth.derive.rigour.rounding import UNIT_ROUNDOFF, gamma_bound, raised, smallest_above
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError


@dataclass(frozen=True, eq=False)
class Enclosure:
    """Every real matrix within ``rad`` of ``mid``, entry by entry.

    Numbers and arrays that meet an enclosure count as exact doubles. A leading axis holds one
    matrix per vertex. Entries that overflow become NaN or infinite and prove nothing.

    mid: midpoints
    rad: radii, not negative; one radius for all vertices may be a broadcast view
    """

    mid: FloatArray
    rad: FloatArray

    __array_ufunc__ = None

    @classmethod
    def of(cls, value: Any, radius: ArrayLike = 0.0) -> Enclosure:
        """Exact doubles, or doubles with a radius; exact matrices are rounded, enclosures pass."""
        if isinstance(value, Enclosure):
            return value
        if isinstance(value, ExactMatrix):
            return _rounded(value)
        mid = np.asarray(value, dtype=float)
        if mid.ndim == 0:
            mid = mid.reshape(1, 1)
        if mid.ndim not in (2, 3):
            raise ObsynthError(
                f"an enclosure of shape {mid.shape}: matrices (r, c) or families (N, r, c)",
                shape=mid.shape,
            )
        rad = np.broadcast_to(np.asarray(radius, dtype=float), mid.shape)
        if not np.all(rad >= 0):
            raise ObsynthError("the radius of an enclosure has a negative or NaN entry")
        return cls(mid, rad)

    @classmethod
    def combine(cls, centre: Enclosure, directions: Enclosure, weights: ArrayLike) -> Enclosure:
        """Enclose ``centre + sum_k weights[i, k] directions[k]`` for every vertex i."""
        table = np.asarray(weights, dtype=float)
        count, rows, columns = table.shape[1], *centre.shape
        steps = directions.mid.reshape(count, rows * columns)
        spread = directions.rad.reshape(count, rows * columns)
        mid = centre.mid + (table @ steps).reshape(-1, rows, columns)
        # The largest weight of every parameter bounds the rounding at all vertices at once.
        largest = np.abs(table).max(axis=0, initial=0.0)
        size = np.abs(centre.mid) + (largest @ np.abs(steps)).reshape(rows, columns)
        rad = centre.rad + (largest @ spread).reshape(rows, columns)
        bound = raised(rad + gamma_bound(count + 1) * size, count + 8)
        return cls(mid, np.broadcast_to(bound, mid.shape))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of one member."""
        return self.mid.shape[-2], self.mid.shape[-1]

    @property
    def T(self) -> Enclosure:
        """Transpose of every member."""
        return Enclosure(np.swapaxes(self.mid, -1, -2), np.swapaxes(self.rad, -1, -2))

    def contains(self, value: ArrayLike) -> bool:
        """Whether the doubles given lie inside, certainly."""
        distance = np.abs(np.asarray(value, dtype=float) - self.mid)
        return bool(np.all(distance * (1.0 + 4 * UNIT_ROUNDOFF) <= self.rad))

    def member(self, index: Any) -> Enclosure:
        """Select vertices of a family."""
        return self if self.mid.ndim == 2 else Enclosure(self.mid[index], self.rad[index])

    def __getitem__(self, key: Any) -> Enclosure:
        rows, columns = key if isinstance(key, tuple) else (key, slice(None))
        rows, columns = (
            slice(k, k + 1 or None) if isinstance(k, (int, np.integer)) else k
            for k in (rows, columns)
        )
        return Enclosure(
            self.mid[..., rows, :][..., :, columns], self.rad[..., rows, :][..., :, columns]
        )

    def __neg__(self) -> Enclosure:
        return Enclosure(-self.mid, self.rad)

    def __add__(self, other: Any) -> Enclosure:
        if _is_zero(other):
            return self
        right = Enclosure.of(other)
        if self.shape != right.shape:
            raise ObsynthError(f"enclosures of shapes {self.shape} and {right.shape} do not fit")
        mid = self.mid + right.mid
        return Enclosure(mid, raised(self.rad + right.rad + UNIT_ROUNDOFF * np.abs(mid), 4))

    __radd__ = __add__

    def __sub__(self, other: Any) -> Enclosure:
        return self if _is_zero(other) else self + (-Enclosure.of(other))

    def __rsub__(self, other: Any) -> Enclosure:
        return -self if _is_zero(other) else Enclosure.of(other) - self

    def __mul__(self, other: Any) -> Enclosure:
        right = Enclosure.of(other)
        mid = self.mid * right.mid
        left_size = np.abs(self.mid) + self.rad
        rad = left_size * right.rad + self.rad * np.abs(right.mid) + UNIT_ROUNDOFF * np.abs(mid)
        return Enclosure(mid, raised(rad, 8))

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Enclosure:
        right = Enclosure.of(other)
        smallest = np.abs(right.mid) * (1 - 2 * UNIT_ROUNDOFF) - raised(right.rad, 1)
        if not np.all(smallest > 0):
            raise ObsynthError("division by an enclosure that contains zero")
        mid = self.mid / right.mid
        rad = (self.rad + np.abs(mid) * right.rad) / smallest + 2 * UNIT_ROUNDOFF * np.abs(mid)
        return Enclosure(mid, raised(rad, 12))

    def __rtruediv__(self, other: Any) -> Enclosure:
        return Enclosure.of(other) / self

    def __matmul__(self, other: Any) -> Enclosure:
        right = Enclosure.of(other)
        inner = self.shape[1]
        mid = self.mid @ right.mid
        left_size = np.abs(self.mid)
        rounding = gamma_bound(inner) * (left_size @ np.abs(right.mid))
        spread = rounding
        if np.any(right.rad):
            spread = spread + (left_size + self.rad) @ right.rad
        if np.any(self.rad):
            spread = spread + self.rad @ np.abs(right.mid)
        return Enclosure(mid, raised(spread, inner + 8))

    def __rmatmul__(self, other: Any) -> Enclosure:
        return Enclosure.of(other) @ self


def _rounded(matrix: ExactMatrix) -> Enclosure:
    """Nearest doubles, with what is lost."""
    mid = matrix.to_floats()
    lost = [
        [smallest_above(abs(value - Fraction(near))) for value, near in zip(*rows, strict=True)]
        for rows in zip(matrix.to_fractions(), mid.tolist(), strict=True)
    ]
    return Enclosure(mid, np.array(lost).reshape(mid.shape))


def _is_zero(value: Any) -> bool:
    return isinstance(value, (int, float)) and value == 0
