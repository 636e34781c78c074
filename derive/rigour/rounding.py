"""Doubles rounded to a chosen side.

The rounding mode is never changed. One operation is stepped outwards by one double (`down`, `up`);
a formula with nonnegative terms only is multiplied by one factor above its accumulated rounding
error (`raised`, `lowered`), which rests on the error n u / (1 - n u) of a sum of n products in any
order, with or without fused multiply-adds (N. J. Higham, Accuracy and Stability of Numerical
Algorithms, section 3.1).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from fractions import Fraction

import numpy as np

from obsynth.symbolic.arrays import FloatArray

UNIT_ROUNDOFF = 2.0**-53
UNIT: Mapping[str, float] = {"double": UNIT_ROUNDOFF, "single": 2.0**-24}
"""Unit roundoff of a precision."""

# Above the underflow of fewer than 2^40 operations, whether or not it is flushed to zero.
TINY = 2.0**-980


def down(value: FloatArray | float) -> FloatArray:
    """Step to the next double towards minus infinity."""
    return np.nextafter(value, -np.inf)


def up(value: FloatArray | float) -> FloatArray:
    """Step to the next double towards plus infinity; the counterpart of `down`."""
    return np.nextafter(value, np.inf)


def smallest_above(value: Fraction) -> float:
    """Return the smallest double that is not below a rational number."""
    nearest = float(value)
    return nearest if Fraction(nearest) >= value else math.nextafter(nearest, math.inf)


def middle_and_radius(low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Split intervals so that middle +- radius holds them; no radius where both ends are equal.

    Intervals that are not finite get the middle 0 and an infinite radius.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        middle = 0.5 * low + 0.5 * high
        radius = np.maximum(high - middle, middle - low)
    known = np.isfinite(middle) & np.isfinite(radius)
    outward = np.where(radius > 0.0, up(radius), 0.0)
    return np.where(known, middle, 0.0), np.where(known, outward, np.inf)


def gamma_bound(n: int) -> float:
    """Upper bound of n u / (1 - n u), the relative error of n roundings."""
    return n * UNIT_ROUNDOFF * (1.0 + 2.0**-10)


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


def allowance(precision: str, n: int, product: float = 0.0) -> float:
    """Return what the rounding of one step may be, relative to the size of its terms.

    What is added to a bound is this share of the sum of the magnitudes of all its terms, so that
    cancellation does not matter. Making the terms takes at most 24 roundings one after the other;
    every factor Q = I + M / mu of a transition over h 16 for its entries and n for the product, and
    the terms with j factors have the weight of a Poisson variable with mean h mu, the `product`,
    so that h mu factors count. Twice that, and 2^-42 in double precision.
    """
    count = 2.0 * (24.0 + (16.0 + n) * (1.0 + product))
    return max(count * UNIT[precision], 2.0**-42)


def outward(box: FloatArray, precision: str) -> FloatArray:
    """Return a box, shape (n, 2), whose ends are numbers of the precision and that holds it."""
    if precision == "double":
        return np.array(box, dtype=float)
    single = np.asarray(box, dtype=np.float32)
    low = np.where(single[:, 0] > box[:, 0], np.nextafter(single[:, 0], -np.inf), single[:, 0])
    high = np.where(single[:, 1] < box[:, 1], np.nextafter(single[:, 1], np.inf), single[:, 1])
    return np.column_stack([low, high]).astype(float)
