"""The conic form of a problem: minimise c'x with A x + s = b, s in a product of cones."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from obsynth.designs.lmi.expression import Affine, ExpressionError
from obsynth.designs.lmi.problem import Problem
from obsynth.designs.lmi.variables import upper_triangle

# Relative difference of mirrored coefficients that rounding explains.
_ASYMMETRY = 1e-9


@dataclass(frozen=True)
class Cone:
    """``count`` equal cones of one block: kind, size n, and their rows of A."""

    block: str
    kind: str
    n: int
    count: int
    rows: slice


@dataclass(frozen=True, eq=False)
class ConicForm:
    """Data for a conic solver; matrices as upper triangles by columns, sqrt(2) off the diagonal.

    c, A, b: minimise c'x subject to b - A x in the cones
    cones: in the order of the rows
    offsets: where each variable's free entries stand in x
    constant, sign: the objective typed is sign (c'x) + constant
    """

    c: NDArray[np.float64]
    A: sparse.csc_array
    b: NDArray[np.float64]
    cones: tuple[Cone, ...]
    offsets: dict[str, slice]
    constant: float
    sign: float

    def unpack(self, x: NDArray[np.float64], problem: Problem) -> dict[str, NDArray[np.float64]]:
        """Matrices by variable name."""
        return {
            name: variable.unpack(x[self.offsets[name]])
            for name, variable in problem.variables.items()
        }


def conic_form(problem: Problem) -> ConicForm:
    """Stack the blocks of a problem."""
    offsets, start = {}, 0
    for name, variable in problem.variables.items():
        offsets[name] = slice(start, start + variable.size)
        start += variable.size
    if not start or not problem.blocks:
        raise ExpressionError(f"{problem.name}: no variable or no constraint to solve for")
    order = {"zero": 0, "nonnegative": 1, "exponential": 2, "psd": 3}
    cones, parts, row = [], [], 0
    for item in sorted(problem.blocks.values(), key=lambda b: order[b.cone]):
        expression, kind, n, count = item.expression, item.cone, item.expression.shape[0], 1
        if kind == "psd":
            count = expression.members or 1
            expression = _triangles(expression, item.name)
            kind = "nonnegative" if n == 1 else kind
        elif kind == "exponential":
            count, n = expression.constant.size // 3, 3
            expression = expression.T
        length = expression.constant.size
        if kind in ("nonnegative", "zero"):
            n, count = length, 1
        cones.append(Cone(item.name, kind, n, count, slice(row, row + length)))
        parts.append(expression)
        row += length
    stacked = Affine.stacked(parts)
    sign = -1.0 if problem.maximising else 1.0
    c = np.zeros(start)
    for variable, operator in problem.objective.terms.items():
        c[offsets[variable.name]] = sign * operator.toarray().ravel()
    columns = [
        -stacked.terms[variable]
        if variable in stacked.terms
        else sparse.csr_array((row, variable.size))
        for variable in problem.variables.values()
    ]
    return ConicForm(
        c=c,
        A=sparse.csc_array(sparse.hstack(columns, format="csc")),
        b=stacked.constant.ravel(),
        cones=tuple(cones),
        offsets=offsets,
        constant=float(problem.objective.constant.item()),
        sign=sign,
    )


def unstack_triangles(stacked: NDArray[np.float64], n: int, count: int) -> NDArray[np.float64]:
    """Symmetric matrices (count, n, n) from their scaled upper triangles."""
    rows, columns = upper_triangle(n)
    scale = np.where(rows == columns, 1.0, 1.0 / np.sqrt(2.0))
    matrices = np.zeros((count, n, n))
    matrices[:, rows, columns] = stacked.reshape(count, -1) * scale
    matrices[:, columns, rows] = matrices[:, rows, columns]
    return matrices


def _triangles(expression: Affine, name: str) -> Affine:
    """Scaled upper triangles of the symmetric part, as one column."""
    n = expression.shape[0]
    rows, columns = upper_triangle(n)
    numbers = expression._numbers().reshape(-1, n, n)
    upper = expression._take(numbers[:, rows, columns].reshape(1, -1).T)
    lower = expression._take(numbers[:, columns, rows].reshape(1, -1).T)
    _check_symmetric(upper, lower, n, name)
    scale = np.where(rows == columns, 1.0, np.sqrt(2.0))
    weights = np.tile(0.5 * scale, len(numbers))[:, None]
    return (upper + lower) * weights


def _check_symmetric(upper: Affine, lower: Affine, n: int, name: str) -> None:
    difference = upper - lower
    size = max([np.abs(upper.constant).max(), *(_largest(op) for op in upper.terms.values())])
    bad = np.flatnonzero(np.abs(difference.constant.ravel()) > _ASYMMETRY * size).tolist()
    for operator in difference.terms.values():
        entries = operator.tocoo()
        bad += entries.row[np.abs(entries.data) > _ASYMMETRY * size].tolist()
    if bad:
        rows, columns = upper_triangle(n)
        member, entry = divmod(min(bad), len(rows))
        raise ExpressionError(
            f"{name}: vertex {member} is not symmetric at entry "
            f"({rows[entry]}, {columns[entry]}); write the lower triangle with symmetric_block",
            block=name,
        )


def _largest(operator: sparse.csr_array) -> float:
    return float(np.abs(operator.data).max()) if operator.nnz else 0.0
