"""Sums and products of nonnegative doubles rounded up, and exact matrices rounded to doubles.

The l1 bounds of this room are sums of nonnegative terms, so one factor above
the accumulated rounding error turns a computed value into an upper bound. The
rounding mode is never changed: the factor rests on the error n u / (1 - n u) of
a sum of n products in any order, with or without fused multiply-adds
(N. J. Higham, Accuracy and Stability of Numerical Algorithms, section 3.1).
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from obsynth.derive.rigour.enclosure import Enclosure, gamma_bound
from obsynth.derive.rigour.exact_matrix import ExactMatrix
from obsynth.symbolic.arrays import FloatArray

# Above the underflow of fewer than 2^40 operations, whether or not it is flushed to zero.
TINY = 2.0**-980


def raised(value: FloatArray, roundings: int) -> FloatArray:
    """Return an upper bound of a nonnegative expression evaluated in doubles."""
    # three more: the factor, the product with it and the sum are rounded themselves
    return np.asarray(value * (1.0 + 2.0 * gamma_bound(roundings + 3)) + TINY)


def lowered(value: FloatArray, roundings: int) -> FloatArray:
    """Return a lower bound, not below zero, of such an expression."""
    return np.maximum(value * (1.0 - 2.0 * gamma_bound(roundings + 3)) - TINY, 0.0)


def add_up(*terms: FloatArray) -> FloatArray:
    """Return an upper bound of a sum of nonnegative arrays of one shape."""
    return raised(np.sum(np.stack(terms), axis=0), len(terms))


def product_up(left: FloatArray, right: FloatArray) -> FloatArray:
    """Return an upper bound of the product of nonnegative matrices."""
    return raised(left @ right, left.shape[-1] + 1)


def nearest(values: ExactMatrix) -> Enclosure:
    """Round an exact matrix to doubles and bound what is lost."""
    mid, rad = np.zeros(values.shape), np.zeros(values.shape)
    for i, row in enumerate(values.to_fractions()):
        for j, value in enumerate(row):
            mid[i, j] = float(value)
            lost = abs(value - Fraction(mid[i, j]))
            if lost:
                rad[i, j] = np.nextafter(float(lost), np.inf)
    return Enclosure(mid, rad)
