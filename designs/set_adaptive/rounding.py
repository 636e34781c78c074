"""How far rounding may carry one step, and boxes that hold their own doubles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from obsynth.symbolic.arrays import FloatArray

PRECISIONS = ("double", "single")
UNIT: Mapping[str, float] = {"double": 2.0**-53, "single": 2.0**-24}
"""Unit roundoff."""
SHOWN: Mapping[str, float] = {"double": 2.0**-48, "single": 2.0**-21}
"""Above the relative error of a measurement, its conversion into the precision included."""


def allowance(precision: str, n: int, product: float = 0.0) -> float:
    """Return what the rounding of one step may be, relative to the size of its terms.

    What is added to a bound is this share of the sum of the magnitudes of all its terms, so that
    cancellation does not matter. Making the terms takes at most 24 roundings one after the other;
    every factor Q of the exponential 16 for its entries and n for the product, and the terms with
    j factors have the weight of a Poisson variable with mean h mu, so that h mu factors count.
    Twice that, and 2^-42 in double precision.
    """
    count = 2.0 * (24.0 + (16.0 + n) * (1.0 + product))
    return max(count * UNIT[precision], 2.0**-42)


def precision_of(options: Mapping[str, Any]) -> str:
    """Return the precision of a stored design."""
    return str(options.get("precision", "double"))


def outward(box: FloatArray, precision: str) -> FloatArray:
    """Return a box whose ends are numbers of the precision and that holds the given one."""
    if precision == "double":
        return np.array(box, dtype=float)
    single = np.asarray(box, dtype=np.float32)
    low = np.where(single[:, 0] > box[:, 0], np.nextafter(single[:, 0], -np.inf), single[:, 0])
    high = np.where(single[:, 1] < box[:, 1], np.nextafter(single[:, 1], np.inf), single[:, 1])
    return np.column_stack([low, high]).astype(float)
