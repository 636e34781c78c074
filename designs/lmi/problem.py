"""What is stated: block matrices of unknowns, named inequalities, an objective.

A formula written with ``block``, ``+ - @ *`` and ``.T`` says its LMI once: given variables it
is the constraint the solver sees, given enclosures it is what gets proved, given exact
matrices it is the independent check.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from obsynth.derive.rigour import Enclosure, ExactMatrix
from obsynth.designs.lmi.conic import Block, Solution, Statement, solve
from obsynth.designs.lmi.cvxpy_backend import to_cvxpy
from obsynth.designs.lmi.expression import (
    Affine,
    ExpressionError,
    Inequality,
    Variable,
    constant,
    diagonal,
    full,
    is_zero,
    scalar,
    symmetric,
    trace,
)
from obsynth.symbolic.arrays import FloatArray

Arithmetic = Literal["float", "enclosure", "exact"]


def lift(value: FloatArray, arithmetic: Arithmetic, radius: FloatArray | float = 0.0) -> Any:
    """Return doubles, with a radius where the arithmetic knows one, in an arithmetic."""
    if arithmetic == "enclosure":
        return Enclosure.of(value, radius)
    return ExactMatrix.of(value) if arithmetic == "exact" else value


def block(rows: Sequence[Sequence[Any]]) -> Any:
    """Matrix of blocks."""
    grid = [[None if is_zero(cell) else _as_cell(cell) for cell in row] for row in rows]
    if len({len(row) for row in grid}) != 1:
        raise ExpressionError(f"rows of {[len(row) for row in grid]} blocks")
    heights = [_size(row, 0, f"row {i}") for i, row in enumerate(grid)]
    widths = [_size(column, 1, f"column {j}") for j, column in enumerate(zip(*grid, strict=True))]
    kinds = {type(cell) for row in grid for cell in row} - {type(None), np.ndarray}
    if len(kinds) > 1:
        names = sorted(kind.__name__ for kind in kinds)
        raise ExpressionError(f"blocks of different arithmetics: {', '.join(names)}", kinds=names)
    filled = [
        [np.zeros((heights[i], widths[j])) if cell is None else cell for j, cell in enumerate(row)]
        for i, row in enumerate(grid)
    ]
    kind = kinds.pop() if kinds else np.ndarray
    if kind is Affine:
        return _affine_block(filled)
    if kind is Enclosure:
        lifted = [[Enclosure.of(cell) for cell in row] for row in filled]
        return Enclosure(
            _dense_block([[cell.mid for cell in row] for row in lifted]),
            _radius_block([[cell.rad for cell in row] for row in lifted]),
        )
    if kind is ExactMatrix:
        return ExactMatrix.from_blocks([[ExactMatrix.of(cell) for cell in row] for row in filled])
    return _dense_block(filled)


def symmetric_block(rows: Sequence[Sequence[Any]]) -> Any:
    """Symmetric block matrix from its lower triangle: row i holds the blocks 0 to i."""
    for i, row in enumerate(rows):
        if len(row) != i + 1:
            raise ExpressionError(
                f"row {i} of a lower triangle has {i + 1} blocks, this one has {len(row)}"
            )
    n = len(rows)
    return block(
        [[rows[i][j] if j <= i else transpose(rows[j][i]) for j in range(n)] for i in range(n)]
    )


def he(matrix: Any) -> Any:
    """X + X' of a square matrix in any arithmetic."""
    return matrix + transpose(matrix)


def transpose(cell: Any) -> Any:
    """Transpose a matrix, or every member of a family, in any arithmetic; 0 stays 0."""
    if is_zero(cell):
        return 0
    return np.swapaxes(cell, -1, -2) if isinstance(cell, np.ndarray) else cell.T


def _as_cell(cell: Any) -> Any:
    if isinstance(cell, (Affine, Enclosure, ExactMatrix)):
        return cell
    array = np.asarray(cell, dtype=float)
    if array.ndim in (2, 3):
        return array
    if array.size == 1:
        return array.reshape(1, 1)
    raise ExpressionError(
        f"a block of shape {array.shape}: blocks are matrices (r, c), families (N, r, c) or 0",
        shape=array.shape,
    )


def _size(cells: Sequence[Any], axis: int, where: str) -> int:
    sizes = {cell.shape[axis - 2] for cell in cells if cell is not None}
    if len(sizes) != 1:
        raise ExpressionError(
            f"{where} of the block matrix has blocks of sizes {sorted(sizes)}"
            if sizes
            else f"{where} of the block matrix has only zeros, its size is unknown"
        )
    return int(sizes.pop())


def _dense_block(cells: Sequence[Sequence[Any]]) -> Any:
    members = np.broadcast_shapes(*(cell.shape[:-2] for row in cells for cell in row))
    return np.block(
        [[np.broadcast_to(cell, members + cell.shape[-2:]) for cell in row] for row in cells]
    )


def _radius_block(cells: Sequence[Sequence[Any]]) -> Any:
    """Block of radii; one that is common to all vertices stays a view."""
    members = np.broadcast_shapes(*(cell.shape[:-2] for row in cells for cell in row))
    common = [[_common(cell) for cell in row] for row in cells]
    small = _dense_block(common)
    return np.broadcast_to(small, members + small.shape[-2:])


def _common(radius: Any) -> Any:
    return radius[0] if radius.ndim == 3 and radius.strides[0] == 0 else radius


def _affine_block(cells: Sequence[Sequence[Any]]) -> Affine:
    lifted = [[constant(cell) for cell in row] for row in cells]
    members = np.broadcast_shapes(*(cell.constant.shape[:-2] for row in lifted for cell in row))
    offset = 0
    numbers: list[list[Any]] = []
    flat: list[Affine] = []
    for row in lifted:
        numbers.append([])
        for cell in row:
            wide = cell._broadcast(members + cell.shape)
            numbers[-1].append(wide._numbers() + offset)
            flat.append(wide)
            offset += wide.constant.size
    return Affine.stacked(flat)._take(np.block(numbers))


class Problem:
    """Linear objective, named matrix inequalities; its name is used in messages."""

    def __init__(self, name: str = "problem") -> None:
        self.name = name
        self._blocks: dict[str, Block] = {}
        self._variables: dict[str, Variable] = {}
        self.objective: Affine = constant(0.0)
        self.maximising = False
        self._criterion: Callable[[Mapping[str, Any]], float] | None = None

    @property
    def blocks(self) -> Mapping[str, Block]:
        """Constraints by name, in the order they were added."""
        return dict(self._blocks)

    @property
    def variables(self) -> Mapping[str, Variable]:
        """Variables by name, in the order they appeared."""
        return dict(self._variables)

    @property
    def size(self) -> int:
        """Number of free entries of all variables."""
        return sum(variable.size for variable in self._variables.values())

    def add_lmi(
        self,
        name: str,
        expression: Affine,
        sense: str,
        margin: float = 0.0,
        *,
        strict: bool = True,
    ) -> None:
        """Matrix inequality ``expression >> margin I`` or ``expression << -margin I``."""
        if sense not in (">>", "<<"):
            raise ExpressionError(f"{name}: sense {sense!r}; write '>>' or '<<'", block=name)
        positive = expression if sense == ">>" else -expression
        if margin:
            positive = positive - margin * np.eye(expression.shape[0])
        self._add(Block(name, "psd", positive, strict))

    def add(self, name: str, inequality: Inequality) -> None:
        """Constraint written with an operator: ``P >> 0``, ``X << Y``, ``t <= 3`` (elementwise)."""
        if not isinstance(inequality, Inequality):
            raise ExpressionError(
                f"{name}: {type(inequality).__name__} is no inequality; write P >> 0, P << Q, "
                "t >= 0 or t <= 1 with an expression on the left",
                block=name,
            )
        self._add(Block(name, inequality.cone, inequality.expression))

    def add_equality(self, name: str, expression: Affine) -> None:
        """Every entry of the expression is zero; two inequalities would leave no interior."""
        self._add(Block(name, "zero", expression))

    def minimise(self, objective: Affine) -> None:
        """Minimise a 1 x 1 expression."""
        self._set_objective(objective, maximising=False)

    def maximise(self, objective: Affine) -> None:
        """Maximise a 1 x 1 expression."""
        self._set_objective(objective, maximising=True)

    def minimise_trace_inverse(self, P: Affine, weight: Any = None) -> None:
        """Minimise trace(W P^-1) of a symmetric expression, by a Schur complement."""
        n = P.shape[0]
        factor = np.eye(n) if weight is None else np.asarray(weight, dtype=float).reshape(n, -1)
        Z = symmetric("inverse.Z", factor.shape[1])
        self._add(Block("inverse", "psd", symmetric_block([[Z], [factor, P]]), strict=False))
        self.minimise(trace(Z))
        self._criterion = lambda values: np.trace(
            factor.T @ np.linalg.solve(P.value(values), factor)
        )

    def maximise_lambda_min(self, P: Affine) -> None:
        """Maximise the smallest eigenvalue of a symmetric expression."""
        least = scalar("lambda_min.t")
        floor = P - least * np.eye(P.shape[0])
        self._add(Block("lambda_min", "psd", floor, strict=False))
        self.maximise(least)
        self._criterion = lambda values: np.linalg.eigvalsh(P.value(values))[0]

    def maximise_log_det(self, P: Affine) -> None:
        """Maximise log det P of a symmetric expression, with one exponential cone per row.

        With Z lower triangular and [P, Z; Z', diag(Z)] >= 0 it is at least the sum of log Z_ii.
        """
        n = P.shape[0]
        Z = full("log_det.Z", n, n)
        D = diagonal("log_det.D", n)
        t = full("log_det.t", n, 1)
        upper = [Z[i, i + 1 :] for i in range(n - 1)]
        ends = block([[D[i, i] - Z[i, i] for i in range(n)]])
        self._add(Block("log_det", "psd", symmetric_block([[P], [Z.T, D]]), strict=False))
        self._add(Block("log_det.triangle", "zero", block([[*upper, ends]]), strict=False))
        rows = [[t[i, 0], np.ones((1, 1)), D[i, i]] for i in range(n)]
        self._add(Block("log_det.exponential", "exponential", block(rows), strict=False))
        self.maximise(np.ones((1, n)) @ t)
        self._criterion = lambda values: np.linalg.slogdet(P.value(values))[1]

    def evaluate(self, values: Mapping[str, Any]) -> float:
        """Objective of given values; of trace(P^-1) and the like at P, whatever the auxiliary."""
        if self._criterion is not None:
            return float(self._criterion(values))
        return float(self.objective.value(values).item())

    def members(self, chosen: Mapping[str, Iterable[int]]) -> Problem:
        """Copy the problem with some vertices of the named families only."""
        copy = Problem(self.name)
        copy.objective, copy.maximising = self.objective, self.maximising
        copy._criterion = self._criterion
        copy._variables = dict(self._variables)
        copy._blocks = dict(self._blocks)
        for name, vertices in chosen.items():
            picked = self._blocks[name].expression.member(np.fromiter(vertices, dtype=np.intp))
            copy._blocks[name] = replace(self._blocks[name], expression=picked)
        return copy

    def tightened(self, margin: Affine | float) -> Problem:
        """Copy the problem with ``margin`` times the identity taken from every strict block."""
        copy = self.members({})
        for name, item in self._blocks.items():
            if item.asks_margin:
                lowered = item.expression - margin * np.eye(item.expression.shape[0])
                copy._learn(lowered, name)
                copy._blocks[name] = replace(item, expression=lowered)
        return copy

    @property
    def statement(self) -> Statement:
        """What the back ends read."""
        return Statement(self.name, self.variables, self.blocks, self.objective, self.maximising)

    def solve(self, *, accept_inaccurate: bool = False, **settings: Any) -> Solution:
        """Solve with Clarabel."""
        return solve(self.statement, accept_inaccurate=accept_inaccurate, **settings)

    def to_cvxpy(self) -> Any:
        """Translate for cvxpy; variables have the same names."""
        return to_cvxpy(self.statement)

    def __repr__(self) -> str:
        counts = ", ".join(
            f"{item.name} ({item.cone}, {item.expression.members or 1} x "
            f"{item.expression.shape[0]} x {item.expression.shape[1]})"
            for item in self._blocks.values()
        )
        return f"Problem {self.name!r}: {self.size} unknowns; {counts}"

    def _add(self, item: Block) -> None:
        if item.name in self._blocks:
            raise ExpressionError(
                f"{self.name}: two blocks are called {item.name!r}", block=item.name
            )
        rows, columns = item.expression.shape
        if item.cone == "psd" and rows != columns:
            raise ExpressionError(
                f"{item.name}: a matrix inequality of shape {rows} x {columns} is not square",
                block=item.name,
            )
        self._learn(item.expression, item.name)
        self._blocks[item.name] = item

    def _learn(self, expression: Affine, where: str) -> None:
        for variable in expression.terms:
            known = self._variables.setdefault(variable.name, variable)
            if known != variable:
                raise ExpressionError(
                    f"{where}: variable {variable.name!r} is {variable.structure} "
                    f"{variable.shape} here and {known.structure} {known.shape} elsewhere",
                    variable=variable.name,
                )

    def _set_objective(self, objective: Affine, *, maximising: bool) -> None:
        if objective.constant.size != 1:
            raise ExpressionError(
                f"{self.name}: an objective of shape {objective.shape}; take its trace"
            )
        self._learn(objective, "objective")
        self._criterion = None
        self.objective, self.maximising = objective, maximising


def cap_gain(problem: Problem, P: Affine, H: Affine, limit: float, name: str = "gain") -> None:
    """Keep |P^-1 H| below a limit: p I <= P and ``[limit^2 p I, H'; H, P] >= 0`` suffice."""
    p = scalar(f"{name}.p")
    problem.add_lmi(f"{name}.floor", P - p * np.eye(P.shape[0]), ">>", strict=False)
    cap: Any = symmetric_block([[limit**2 * p * np.eye(H.shape[1])], [H, P]])
    problem.add_lmi(f"{name}.cap", cap, ">>", strict=False)
