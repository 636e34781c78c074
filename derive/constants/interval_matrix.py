"""Extreme eigenvalue and norm over interval matrices: Hertz and Rohn, with verified eigenvalues.

x'Ax over the matrices with |A - C| <= R is x'Cx + |x|'R|x|, which is x'(C + S R S)x with the signs
of x on the diagonal of S. So the largest eigenvalue over all of them is the largest over the sign
matrices (Hertz 1992), and it is attained there. The norm is the largest eigenvalue of [0 A; A' 0],
with one sign per row and one per column (Rohn). A sign matters only where R couples it with
others: one sign per connected part of R is free.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

from obsynth.derive.algebra.connected import connected
from obsynth.derive.rigour import UNIT_ROUNDOFF, largest_eigenvalue, perron_bound, up
from obsynth.symbolic.arrays import BoolArray, FloatArray

MOST_SIGNS = 16


@dataclass(frozen=True, eq=False)
class IntervalExtreme:
    """Largest eigenvalue or norm over an interval matrix: bounded, and attained at a member.

    Exact up to rounding when all sign matrices were looked at.
    """

    upper: float
    attained: float
    matrix: FloatArray
    exact: bool


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


def eigenvalue_over_interval(centre: FloatArray, radius: FloatArray) -> IntervalExtreme:
    """Bound the largest eigenvalue of all symmetric matrices of an interval (Hertz 1992)."""
    patterns = sign_patterns(radius > 0.0)
    if patterns is None:
        lower, upper = largest_eigenvalue(centre[None])
        wide = float(up(upper[0] + perron_bound(radius[None])[0]))
        return IntervalExtreme(wide, float(lower[0]), centre, False)
    best, attained, matrix = -np.inf, -np.inf, centre
    for block in np.array_split(patterns, max(1, len(patterns) // 4096)):
        corners = centre + block[:, :, None] * radius * block[:, None, :]
        rounding = UNIT_ROUNDOFF * np.abs(corners) * 1.01
        lower, upper = largest_eigenvalue(corners, rounding)
        best = max(best, float(upper.max()))
        k = int(np.argmax(lower))
        if float(lower[k]) > attained:
            attained, matrix = float(lower[k]), corners[k]
    return IntervalExtreme(best, attained, matrix, True)
