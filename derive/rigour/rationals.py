"""Exact rational matrices and arrays: nothing is lost until somebody asks for doubles.

Every double is a rational with a power of two below. So the blocks of an LMI can be formed without
any rounding, with the operators of the other arithmetics (`ExactMatrix`), and decided by
elimination over the integers; arrays of rationals (`exact`) have the operators of NumPy.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.derive.rigour.interval import smallest_above
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

Exact = NDArray[np.object_]
_WRITTEN = re.compile(r"-?[0-9]{1,4000}(/[1-9][0-9]{0,3999})?")


def number(value: Any) -> Any:
    """Read the rational (`flint.fmpq`) that a double, an integer or a fraction of any kind is."""
    from flint import fmpq

    if isinstance(value, fmpq):
        return value
    if isinstance(value, (float, np.floating)):
        if not np.isfinite(value):
            raise ObsynthError(f"{value} is no rational number")
        return fmpq(*float(value).as_integer_ratio())
    if isinstance(value, (int, np.integer)):
        return fmpq(int(value))
    if isinstance(value, Fraction):
        return fmpq(value.numerator, value.denominator)
    if hasattr(value, "p") and hasattr(value, "q"):
        return fmpq(int(value.p), int(value.q))
    raise ObsynthError(f"{value!r} ({type(value).__name__}) is no exact number")


def _fraction(value: Any) -> Fraction:
    return Fraction(value) if isinstance(value, int) else Fraction(int(value.p), int(value.q))


@dataclass(frozen=True, eq=False)
class ExactMatrix:
    """A rational matrix with the operators of the other arithmetics.

    entries: the value; use :meth:`of` to make one from doubles, integers or fractions
    """

    entries: Any

    __array_ufunc__ = None

    @classmethod
    def of(cls, value: Any) -> ExactMatrix:
        """From a number, a nested sequence of numbers or an array, without rounding."""
        from flint import fmpq_mat

        if isinstance(value, ExactMatrix):
            return value
        array = np.asarray(value, dtype=object)
        if array.ndim == 0:
            array = array.reshape(1, 1)
        if array.ndim != 2:
            raise ObsynthError(
                f"an exact matrix of shape {array.shape}: take one vertex of a family at a time",
                shape=array.shape,
            )
        return cls(fmpq_mat(*array.shape, [number(x) for x in array.ravel()]))

    @classmethod
    def from_blocks(cls, rows: Sequence[Sequence[ExactMatrix]]) -> ExactMatrix:
        """Matrix of blocks whose sizes fit."""
        table = [
            [x for cell in row for x in cell.entries.table()[i]]
            for row in rows
            for i in range(row[0].shape[0])
        ]
        from flint import fmpq_mat

        return cls(fmpq_mat(table))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.entries.nrows(), self.entries.ncols()

    @property
    def T(self) -> ExactMatrix:
        """Transpose."""
        return ExactMatrix(self.entries.transpose())

    def to_fractions(self) -> list[list[Fraction]]:
        """Nested list of fractions."""
        return [[_fraction(x) for x in row] for row in self.entries.table()]

    def to_floats(self) -> FloatArray:
        """Entries rounded to the nearest double."""
        floats = [[float(x) for x in row] for row in self.to_fractions()]
        return np.array(floats, dtype=float).reshape(self.shape)

    def inverse(self) -> ExactMatrix:
        """Exact inverse; a singular matrix raises."""
        try:
            return ExactMatrix(self.entries.inv())
        except ZeroDivisionError:
            raise ObsynthError(f"the exact {self.shape} matrix is singular") from None

    def __getitem__(self, key: Any) -> ExactMatrix:
        numbers = np.arange(self.shape[0] * self.shape[1]).reshape(self.shape)
        rows, columns = key if isinstance(key, tuple) else (key, slice(None))
        rows, columns = (
            slice(k, k + 1 or None) if isinstance(k, (int, np.integer)) else k
            for k in (rows, columns)
        )
        picked = numbers[rows, :][:, columns]
        from flint import fmpq_mat

        flat = self.entries.entries()
        return ExactMatrix(fmpq_mat(*picked.shape, [flat[i] for i in picked.ravel()]))

    def __neg__(self) -> ExactMatrix:
        return ExactMatrix(-self.entries)

    def __add__(self, other: Any) -> ExactMatrix:
        if _is_zero(other):
            return self
        right = ExactMatrix.of(other)
        _check_shapes(self, right)
        return ExactMatrix(self.entries + right.entries)

    __radd__ = __add__

    def __sub__(self, other: Any) -> ExactMatrix:
        return self if _is_zero(other) else self + (-ExactMatrix.of(other))

    def __rsub__(self, other: Any) -> ExactMatrix:
        return -self if _is_zero(other) else ExactMatrix.of(other) - self

    def __mul__(self, other: Any) -> ExactMatrix:
        left, right = self, ExactMatrix.of(other)
        if left.shape == (1, 1):
            return ExactMatrix(right.entries * left.entries[0, 0])
        if right.shape == (1, 1):
            return ExactMatrix(left.entries * right.entries[0, 0])
        _check_shapes(left, right)
        from flint import fmpq_mat

        pairs = zip(left.entries.entries(), right.entries.entries(), strict=True)
        return ExactMatrix(fmpq_mat(*left.shape, [a * b for a, b in pairs]))

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> ExactMatrix:
        divisor = ExactMatrix.of(other)
        if divisor.shape != (1, 1) or divisor.entries[0, 0] == 0:
            raise ObsynthError("an exact matrix is divided by a number that is not zero")
        return ExactMatrix(self.entries * (1 / divisor.entries[0, 0]))

    def __rtruediv__(self, other: Any) -> ExactMatrix:
        return ExactMatrix.of(other) / self

    def __matmul__(self, other: Any) -> ExactMatrix:
        return ExactMatrix(self.entries * ExactMatrix.of(other).entries)

    def __rmatmul__(self, other: Any) -> ExactMatrix:
        return ExactMatrix.of(other) @ self


def is_positive_definite(matrix: Any) -> bool:
    """Decide definiteness exactly, by the signs of the leading minors."""
    exact = ExactMatrix.of(matrix)
    if exact.shape[0] != exact.shape[1] or exact.entries != exact.entries.transpose():
        raise ObsynthError(f"the exact {exact.shape} matrix is not symmetric")
    from flint import fmpz_mat

    rows = [[int(v) for v in row] for row in exact.entries.numer_denom()[0].tolist()]
    minors = ([row[:k] for row in rows[:k]] for k in range(1, len(rows) + 1))
    return all(fmpz_mat(minor).det() > 0 for minor in minors)


def _is_zero(value: Any) -> bool:
    return isinstance(value, (int, float)) and value == 0


def _check_shapes(left: ExactMatrix, right: ExactMatrix) -> None:
    if left.shape != right.shape:
        raise ObsynthError(f"exact matrices of shapes {left.shape} and {right.shape} do not fit")


def exact(values: Any) -> Exact:
    """Return the rational numbers that doubles, fractions or SymPy rationals are."""
    array = np.asarray(values)
    if array.dtype != np.object_:
        array = array.astype(float)
    result = np.empty(array.shape, dtype=object)
    for place, value in np.ndenumerate(array):
        result[place] = number(value)
    return result


def nearest(values: Exact) -> FloatArray:
    """Return the nearest doubles."""
    return _each(float, values)


def above(values: Exact) -> FloatArray:
    """Return the smallest doubles that are not below the values."""
    return _each(smallest_above, values)


def _each(rounding: Callable[[Fraction], float], values: Exact) -> FloatArray:
    found = [rounding(_fraction(value)) for value in values.ravel()]
    return np.array(found, dtype=float).reshape(values.shape)


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


def image(matrix: Any, lower: Any, upper: Any) -> tuple[Any, Any]:
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
    for value in flat:
        if not isinstance(value, str) or not _WRITTEN.fullmatch(value):
            raise ValueError(f"{str(value)[:60]!r} is no rational number such as '-1/3'")
    return exact(np.array([Fraction(v) for v in flat], dtype=object).reshape(shape))
