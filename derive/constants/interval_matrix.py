"""Extreme eigenvalue and norm over interval matrices: Hertz and Rohn, with verified eigenvalues.

x'Ax over the matrices with |A - C| <= R is x'Cx + |x|'R|x|, which is x'(C + S R S)x with the signs
of x on the diagonal of S. So the largest eigenvalue over all of them is the largest over the sign
matrices (Hertz 1992), and it is attained there. The norm is the largest eigenvalue of [0 A; A' 0],
with one sign per row and one per column (Rohn). A sign matters only where R couples it with
others: one sign per connected part of R is free.
"""

from itertools import product

import numpy as np

from obsynth.derive.algebra.connected import connected
from obsynth.derive.rigour import UNIT_ROUNDOFF, finite, largest_eigenvalue, perron_bound, up
from obsynth.symbolic.arrays import BoolArray, FloatArray

MOST_SIGNS = 16


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
