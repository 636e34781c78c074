"""Rational arrays: what the guarantee is computed with before anything is rounded."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.derive.rigour.exact_matrix import ExactMatrix
from obsynth.symbolic.arrays import FloatArray

Exact = NDArray[np.object_]


def exact(values: Any) -> Exact:
    """Return the rational numbers (`flint.fmpq`) that doubles, fractions or SymPy rationals are."""
    from flint import fmpq

    def read(value: Any) -> Any:
        if isinstance(value, fmpq):
            return value
        if isinstance(value, float):
            return fmpq(*value.as_integer_ratio())
        if isinstance(value, int):
            return fmpq(value)
        if isinstance(value, Fraction):
            return fmpq(value.numerator, value.denominator)
        return fmpq(int(value.p), int(value.q))

    array = np.asarray(values)
    if array.dtype != np.object_:
        array = array.astype(float)
    result = np.empty(array.shape, dtype=object)
    for place, value in np.ndenumerate(array):
        result[place] = read(value if array.dtype == np.object_ else float(value))
    return result


def _fraction(value: Any) -> Fraction:
    return Fraction(value) if isinstance(value, int) else Fraction(int(value.p), int(value.q))


def nearest(values: Exact) -> FloatArray:
    """Return the nearest doubles."""
    result = np.zeros(values.shape)
    for place, value in np.ndenumerate(values):
        result[place] = float(_fraction(value))
    return result


def above(values: Exact) -> FloatArray:
    """Return the smallest doubles that are not below the values."""
    result = nearest(values)
    for place, value in np.ndenumerate(values):
        if Fraction(float(result[place])) < _fraction(value):
            result[place] = math.nextafter(result[place], math.inf)
    return result


def inverse(matrix: Exact) -> Exact:
    """Return the exact inverse of a square matrix; a singular one raises `ObsynthError`."""
    if matrix.size == 0:
        return matrix.copy()
    n = len(matrix)
    entries = ExactMatrix.of(matrix).inverse().entries.tolist()
    return np.array(entries, dtype=object).reshape(n, n)


def positive(matrix: Any) -> Any:
    """Return M+ = max(M, 0) elementwise."""
    return np.maximum(matrix, 0)


def negative(matrix: Any) -> Any:
    """Return M- = max(-M, 0) elementwise, so that M = M+ - M-."""
    return np.maximum(-matrix, 0)


def hull(matrix: Any, lower: Any, upper: Any) -> tuple[Any, Any]:
    """Return the smallest box that holds M a for every a in a box, as (lower, upper)."""
    plus, minus = positive(matrix), negative(matrix)
    return plus @ lower - minus @ upper, plus @ upper - minus @ lower


def magnitude(matrix: Any) -> Any:
    """Return |M| elementwise."""
    return np.abs(matrix)


def to_text(values: Exact) -> list[Any]:
    """Return a nested list of texts as ``-1/3``."""
    flat = [str(_fraction(value)) for value in values.ravel()]
    nested: list[Any] = np.array(flat, dtype=object).reshape(values.shape).tolist()
    return nested


def from_text(nested: Any, shape: tuple[int, ...]) -> Exact:
    """Read what `to_text` wrote; empty arrays get their shape from the caller."""
    flat = np.array(nested, dtype=object).ravel()
    return exact(np.array([Fraction(str(v)) for v in flat], dtype=object).reshape(shape))
