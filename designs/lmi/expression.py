"""Matrix unknowns and what is affine in them, alone or as a family with one member per vertex."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
import scipy.sparse as sparse
from numpy.typing import ArrayLike, NDArray

from obsynth.symbolic.errors import ObsynthError

Matrix = NDArray[np.float64]
IntArray = NDArray[np.intp]


class ExpressionError(ObsynthError):
    """An expression that is not affine, or whose shapes do not fit."""


class Structure(StrEnum):
    """Pattern of a matrix variable."""

    FULL = "full"
    SYMMETRIC = "symmetric"
    DIAGONAL = "diagonal"
    SCALAR = "scalar"


def upper_triangle(n: int) -> tuple[IntArray, IntArray]:
    """Rows and columns of the upper triangle, stacked by columns."""
    columns, rows = np.tril_indices(n)
    return rows, columns


@dataclass(frozen=True)
class Variable:
    """A matrix variable: a value compared by name, shape and structure (free entries)."""

    name: str
    shape: tuple[int, int]
    structure: Structure

    @property
    def size(self) -> int:
        """Number of free entries."""
        return len(self.free_entries[0])

    @property
    def free_entries(self) -> tuple[IntArray, IntArray]:
        """Rows and columns of the free entries, in the order of the parameter vector."""
        rows, columns = self.shape
        if self.structure is Structure.SYMMETRIC:
            return upper_triangle(rows)
        if self.structure is Structure.DIAGONAL:
            index = np.arange(rows)
            return index, index
        index = np.arange(rows * columns)
        return index % rows, index // rows

    def operator(self) -> sparse.csr_array:
        """Sparse map (rows * columns, size) from the free entries to the column-stacked matrix."""
        rows, columns = self.free_entries
        index = np.arange(len(rows))
        targets = columns * self.shape[0] + rows
        if self.structure is Structure.SYMMETRIC:
            off = rows != columns
            targets = np.concatenate([targets, (rows * self.shape[0] + columns)[off]])
            index = np.concatenate([index, index[off]])
        entries = self.shape[0] * self.shape[1]
        return sparse.csr_array((np.ones(len(index)), (targets, index)), shape=(entries, len(rows)))

    def unpack(self, entries: ArrayLike) -> Matrix:
        """Matrix with the given free entries."""
        stacked = self.operator() @ np.asarray(entries, dtype=float)
        matrix: Matrix = stacked.reshape(self.shape, order="F")
        return matrix

    def pack(self, matrix: ArrayLike) -> Matrix:
        """Free entries of a matrix of this variable's shape."""
        values = np.asarray(matrix, dtype=float).reshape(self.shape)
        return values[self.free_entries]


@dataclass(frozen=True, eq=False)
class Affine:
    """constant + sum over the variables of a linear operator, beside NumPy arrays as an array.

    An array with a leading axis, (N, r, c), makes a family: one member per vertex, and arithmetic
    broadcasts over it as ``numpy.matmul`` does.

    terms: operators from the free entries of the variable to the entries of the expression, vertex
        after vertex, each stacked by columns
    """

    constant: Matrix
    terms: Mapping[Variable, sparse.csr_array]

    # NumPy leaves the operators to this class when an array stands on the left.
    __array_ufunc__ = None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of one member."""
        return self.constant.shape[-2], self.constant.shape[-1]

    @property
    def members(self) -> int | None:
        """Number of vertices, or None for an expression that is no family."""
        return None if self.constant.ndim == 2 else self.constant.shape[0]

    @property
    def T(self) -> Affine:
        """Transpose of every member."""
        return self._take(np.swapaxes(self._numbers(), -1, -2))

    @classmethod
    def of_variable(cls, variable: Variable) -> Affine:
        """Make the expression that is just the variable."""
        return cls(np.zeros(variable.shape), {variable: variable.operator()})

    @classmethod
    def stacked(cls, parts: Sequence[Affine]) -> Affine:
        """All entries of several expressions in one column, each stacked by columns."""
        sizes = [part.constant.size for part in parts]
        starts = np.cumsum([0, *sizes])
        pieces: dict[Variable, list[tuple[int, sparse.coo_array]]] = {}
        for part, start in zip(parts, starts, strict=False):
            for variable, operator in part.terms.items():
                pieces.setdefault(variable, []).append((int(start), operator.tocoo()))
        terms = {
            variable: sparse.csr_array(
                (
                    np.concatenate([op.data for _, op in found]),
                    (
                        np.concatenate([op.row + start for start, op in found]),
                        np.concatenate([op.col for _, op in found]),
                    ),
                ),
                shape=(int(starts[-1]), variable.size),
            )
            for variable, found in pieces.items()
        }
        return cls(np.concatenate([_stack(part.constant) for part in parts])[:, None], terms)

    def value(self, values: Mapping[str, ArrayLike]) -> Matrix:
        """Insert values by name."""
        stacked = _stack(self.constant)
        for variable, operator in self.terms.items():
            stacked = stacked + operator @ variable.pack(values[variable.name])
        return _unstack(stacked, self.constant.shape)

    def member(self, index: int | slice | NDArray[Any]) -> Affine:
        """Select vertices of a family: an integer gives one matrix, an array a smaller family."""
        if self.members is None:
            return self
        return self._take(self._numbers()[index])

    def __getitem__(self, key: Any) -> Affine:
        """Entries or sub-blocks of every member; the result has two dimensions."""
        rows, columns = key if isinstance(key, tuple) else (key, slice(None))
        picked = self._numbers()[..., _as_slice(rows), :][..., :, _as_slice(columns)]
        return self._take(picked)

    def __neg__(self) -> Affine:
        return Affine(-self.constant, {v: -op for v, op in self.terms.items()})

    def __add__(self, other: Any) -> Affine:
        if is_zero(other):
            return self
        right = constant(other)
        shape = _common_shape(self, right, "+")
        left, right = self._broadcast(shape), right._broadcast(shape)
        terms = dict(left.terms)
        for variable, operator in right.terms.items():
            terms[variable] = terms[variable] + operator if variable in terms else operator
        return Affine(left.constant + right.constant, terms)

    __radd__ = __add__

    def __sub__(self, other: Any) -> Affine:
        return self if is_zero(other) else self + (-constant(other))

    def __rsub__(self, other: Any) -> Affine:
        return -self if is_zero(other) else constant(other) - self

    def __mul__(self, other: Any) -> Affine:
        """Elementwise product with a constant that broadcasts (a number, or (N, 1, 1))."""
        if isinstance(other, Affine):
            return _product_of_variables(self, other, "*")
        factor = _as_matrix(other)
        shape = np.broadcast_shapes(self.constant.shape, factor.shape)
        wide = self._broadcast(shape)
        scale = _stack(np.broadcast_to(factor, shape))
        terms = {v: op.multiply(scale[:, None]).tocsr() for v, op in wide.terms.items()}
        return Affine(wide.constant * factor, terms)

    __rmul__ = __mul__

    def __truediv__(self, other: float) -> Affine:
        return self * (1.0 / other)

    def __matmul__(self, other: Any) -> Affine:
        if isinstance(other, Affine):
            return _product_of_variables(self, other, "@")
        return self._times(_as_matrix(other))

    def __rmatmul__(self, other: Any) -> Affine:
        # X' A' has the entries of A X, and transposing only renumbers.
        return self.T._times(np.swapaxes(_as_matrix(other), -1, -2)).T

    def __rshift__(self, other: Any) -> Inequality:
        return Inequality("psd", self - other)

    def __lshift__(self, other: Any) -> Inequality:
        return Inequality("psd", -(self - other))

    def __ge__(self, other: Any) -> Inequality:
        return Inequality("nonnegative", self - _as_bound(other, self))

    def __le__(self, other: Any) -> Inequality:
        return Inequality("nonnegative", _as_bound(other, self) - self)

    def _numbers(self) -> IntArray:
        """Row number in the operators of every entry."""
        count = self.constant.size
        return _unstack(np.arange(count), self.constant.shape)

    def _take(self, numbers: IntArray) -> Affine:
        rows = _stack(numbers)
        picked = _stack(self.constant)[rows]
        terms = {v: op[rows] for v, op in self.terms.items()}
        kept = {v: op for v, op in terms.items() if op.nnz}
        return Affine(_unstack(picked, numbers.shape), kept)

    def _broadcast(self, shape: tuple[int, ...]) -> Affine:
        if self.constant.shape == shape:
            return self
        return self._take(np.broadcast_to(self._numbers(), shape))

    def _times(self, factor: Matrix) -> Affine:
        rows, inner = self.shape
        if factor.shape[-2] != inner:
            raise ExpressionError(
                f"product of shapes {self.shape} and {factor.shape[-2:]}: {inner} columns meet "
                f"{factor.shape[-2]} rows",
                left=self.shape,
                right=factor.shape,
            )
        value = self.constant @ factor
        stacked = factor if factor.ndim == 3 else factor[None]
        member, k, column = np.nonzero(stacked)
        entries = stacked[member, k, column]
        count = 1 if value.ndim == 2 else value.shape[0]
        if factor.ndim == 2 and count > 1:
            member = np.repeat(np.arange(count), len(k))
            k, column, entries = np.tile(k, count), np.tile(column, count), np.tile(entries, count)
        source = member if self.members is not None else np.zeros_like(member)
        lines = np.arange(rows)
        target = ((member * value.shape[-1] + column) * rows)[:, None] + lines
        origin = ((source * inner + k) * rows)[:, None] + lines
        product = sparse.csr_array(
            (np.repeat(entries, rows), (target.ravel(), origin.ravel())),
            shape=(value.size, self.constant.size),
        )
        return Affine(value, {v: product @ op for v, op in self.terms.items()})


@dataclass(frozen=True, eq=False)
class Inequality:
    """An expression and the cone it lies in: ``"psd"`` or elementwise ``"nonnegative"``."""

    cone: str
    expression: Affine


def symmetric(name: str, n: int) -> Affine:
    """Symmetric n x n variable."""
    return _variable(Variable(name, (n, n), Structure.SYMMETRIC))


def full(name: str, rows: int, columns: int) -> Affine:
    """Rows x columns variable without structure."""
    return _variable(Variable(name, (rows, columns), Structure.FULL))


def diagonal(name: str, n: int) -> Affine:
    """Diagonal n x n variable."""
    return _variable(Variable(name, (n, n), Structure.DIAGONAL))


def scalar(name: str) -> Affine:
    """One number, as a 1 x 1 expression that multiplies constant matrices with ``*``."""
    return _variable(Variable(name, (1, 1), Structure.SCALAR))


def constant(value: Any) -> Affine:
    """Make an expression without variables; expressions pass unchanged."""
    return value if isinstance(value, Affine) else Affine(_as_matrix(value), {})


def trace(expression: Affine) -> Affine:
    """Sum of the diagonal of every member, as a 1 x 1 expression."""
    n = expression.shape[0]
    numbers = np.diagonal(expression._numbers(), axis1=-2, axis2=-1)[..., None, :]
    return expression._take(numbers) @ np.ones((n, 1))


def _variable(variable: Variable) -> Affine:
    if not variable.name or min(variable.shape) < 1:
        raise ExpressionError(
            f"variable {variable.name!r} of shape {variable.shape}: a name and at least one "
            "row and column are needed",
            name=variable.name,
            shape=variable.shape,
        )
    return Affine.of_variable(variable)


def _as_matrix(value: Any) -> Matrix:
    array = np.asarray(value, dtype=float)
    if array.ndim == 0:
        return array.reshape(1, 1)
    if array.ndim not in (2, 3):
        raise ExpressionError(
            f"a constant of shape {array.shape}: expressions take numbers, matrices (r, c) and "
            "families (N, r, c); write a vector as a column, v[:, None]",
            shape=array.shape,
        )
    return array


def is_zero(value: Any) -> bool:
    """Whether a value is the plain number 0, which has every shape."""
    return isinstance(value, (int, float)) and value == 0


def _as_bound(value: Any, expression: Affine) -> Any:
    """Widen a number to bound every entry; matrices have to fit."""
    if isinstance(value, (int, float, np.number)):
        return np.full(expression.shape, float(value))
    return value


def _as_slice(key: Any) -> Any:
    if isinstance(key, (int, np.integer)):
        return slice(key, key + 1 or None)
    return key


def _stack(array: NDArray[Any]) -> NDArray[Any]:
    return np.swapaxes(array, -1, -2).reshape(-1)


def _unstack(stacked: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    swapped = (*shape[:-2], shape[-1], shape[-2])
    return np.swapaxes(stacked.reshape(swapped), -1, -2)


def _common_shape(left: Affine, right: Affine, sign: str) -> tuple[int, ...]:
    if left.shape == right.shape and (
        left.members == right.members or None in (left.members, right.members)
    ):
        return np.broadcast_shapes(left.constant.shape, right.constant.shape)
    raise ExpressionError(
        f"shapes {left.constant.shape} {sign} {right.constant.shape} do not fit; a multiple of "
        "the identity is written t * np.eye(n)",
        left=left.constant.shape,
        right=right.constant.shape,
    )


def _product_of_variables(left: Affine, right: Affine, sign: str) -> Affine:
    if not right.terms:
        return left * right.constant if sign == "*" else left @ right.constant
    if not left.terms:
        return right * left.constant if sign == "*" else left.constant @ right
    names = [", ".join(v.name for v in side.terms) for side in (left, right)]
    raise ExpressionError(
        f"({names[0]}) {sign} ({names[1]}) is a product of variables, not an affine expression; "
        "introduce a variable for the product, as H = P K",
        left=names[0],
        right=names[1],
    )
