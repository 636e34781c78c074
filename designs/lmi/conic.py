"""The conic form of a problem, what a solver is handed, and Clarabel called on it.

Minimise c'x with A x + s = b, s in a product of cones; matrices stand as their upper triangles by
columns, sqrt(2) off the diagonal.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from obsynth.designs.core.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.lmi.expression import Affine, ExpressionError, Variable, upper_triangle


@dataclass(frozen=True, eq=False)
class Block:
    """A named constraint: an expression and the cone it lies in.

    cone: ``"psd"``, ``"nonnegative"``, ``"zero"``, or ``"exponential"`` (rows of three)
    expression: for ``"psd"`` with sense ``<<`` the negative of what was typed, margin included
    strict: whether a margin is asked of it; helpers that define an auxiliary variable have none
    """

    name: str
    cone: str
    expression: Affine
    strict: bool = True

    @property
    def asks_margin(self) -> bool:
        """Whether the block is a matrix inequality of which a margin is asked."""
        return self.strict and self.cone == "psd"


@dataclass(frozen=True, eq=False)
class Statement:
    """A problem as a back end reads it: blocks and variables by name, and a 1 x 1 objective."""

    name: str
    variables: Mapping[str, Variable]
    blocks: Mapping[str, Block]
    objective: Affine
    maximising: bool


@dataclass(frozen=True, eq=False)
class Solution:
    """Values by variable name. A status is not a certificate: prove what matters.

    values: every variable as a matrix (numbers are 1 x 1)
    solved, infeasible: true only where the solver reports it to full accuracy
    objective: in the sense of the problem (what was minimised or maximised)
    gap: difference to the dual objective, relative to the objective where that is above one; inf
        where the solver does not tell
    duals: dual matrix of every block, (r, c) or (N, r, c); empty when the solver gives none
    attempts: how earlier attempts and this one ended, when there was more than one way to try
    """

    values: Mapping[str, NDArray[np.float64]]
    status: str
    solved: bool
    infeasible: bool
    objective: float
    gap: float
    solver: str
    solve_time: float
    iterations: int = 0
    duals: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    attempts: tuple[str, ...] = ()

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        return self.values[name]

    def value(self, expression: Affine) -> NDArray[np.float64]:
        """Value of an expression, (r, c) or (N, r, c)."""
        return expression.value(self.values)

    def number(self, name: str) -> float:
        """Read a 1 x 1 variable as a float."""
        return float(self.values[name].item())

    def facts(self) -> dict[str, Any]:
        """Status, objective, solver and time, for errors and reports."""
        names = ("status", "objective", "solver", "solve_time", "iterations")
        return {name: getattr(self, name) for name in names}


# Relative difference of mirrored coefficients that rounding explains.
_ASYMMETRY = 1e-9

_SWEEPS = 6


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
    """Data for a conic solver, in units of its own.

    c, A, b: minimise c'x subject to b - A x in the cones, in the order of the rows
    offsets: where each variable's free entries stand in x
    constant, sign: the objective typed is sign (c'x) + constant
    columns, rows: what x and the duals are multiplied by to be those of the statement
    """

    statement: Statement
    c: NDArray[np.float64]
    A: sparse.csc_array
    b: NDArray[np.float64]
    cones: tuple[Cone, ...]
    offsets: dict[str, slice]
    constant: float
    sign: float
    columns: NDArray[np.float64]
    rows: NDArray[np.float64]

    def values(self, x: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Matrices by variable name."""
        typed = x * self.columns
        return {
            name: variable.unpack(typed[self.offsets[name]])
            for name, variable in self.statement.variables.items()
        }

    def duals(self, z: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Dual of every block in the shape of its expression."""
        typed, found = z * self.rows, {}
        for cone in self.cones:
            shape = self.statement.blocks[cone.block].expression.constant.shape
            part = typed[cone.rows]
            if cone.kind == "psd":
                part = unstack_triangles(part, cone.n, cone.count).reshape(shape)
            elif cone.kind == "exponential":
                part = part.reshape(shape)
            else:
                swapped = part.reshape((*shape[:-2], shape[-1], shape[-2]))
                part = np.swapaxes(swapped, -1, -2)
            found[cone.block] = part
        return found


def conic_form(problem: Statement) -> ConicForm:
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
        statement=problem,
        c=c,
        A=sparse.csc_array(sparse.hstack(columns, format="csc")),
        b=stacked.constant.ravel(),
        cones=tuple(cones),
        offsets=offsets,
        constant=float(problem.objective.constant.item()),
        sign=sign,
        columns=np.ones(start),
        rows=np.ones(row),
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


def rescaled(form: ConicForm) -> ConicForm:
    """Scale unknowns and blocks by powers of two; matrix blocks by a congruence D F D."""
    columns, rows = np.ones(len(form.c)), np.ones(len(form.b))
    size = sparse.csr_array(abs(form.A))
    offset = np.abs(form.b)

    def scaled(matrix: Any) -> sparse.csr_array:
        return sparse.diags_array(rows) @ matrix @ sparse.diags_array(columns)

    for _ in range(_SWEEPS):
        largest = np.maximum(_row_maxima(scaled(size)), offset * rows)
        for cone in form.cones:
            rows[cone.rows] *= _cone_factor(cone, largest[cone.rows])
        columns *= _power_of_two(_row_maxima(scaled(size).T))
    return replace(
        form,
        c=form.c * columns,
        A=sparse.csc_array(scaled(form.A)),
        b=form.b * rows,
        columns=form.columns * columns,
        rows=form.rows * rows,
    )


def _row_maxima(matrix: Any) -> NDArray[np.float64]:
    return np.asarray(sparse.csr_array(matrix).max(axis=1).todense(), dtype=float).ravel()


def _power_of_two(size: NDArray[np.float64]) -> NDArray[np.float64]:
    """1 / sqrt(size), rounded to a power of two; 1 where the size is zero."""
    exponent = np.log2(np.where(size > 0, size, 1.0))
    factor: NDArray[np.float64] = np.exp2(-np.round(exponent / 2))
    return factor


def _cone_factor(cone: Cone, largest: NDArray[np.float64]) -> NDArray[np.float64]:
    """Factors that keep the rows in their cone."""
    if cone.kind in ("zero", "nonnegative"):
        return _power_of_two(largest)
    if cone.kind == "exponential":
        # Only one factor for all three rows maps the cone into itself.
        per_cone = largest.reshape(-1, 3).max(axis=1)
        return np.repeat(_power_of_two(per_cone), 3)
    i, j = upper_triangle(cone.n)
    per_member = largest.reshape(cone.count, -1)
    lines = np.zeros((cone.count, cone.n))
    for k in range(cone.n):
        lines[:, k] = per_member[:, (i == k) | (j == k)].max(axis=1)
    factor = _power_of_two(np.sqrt(lines))
    return (factor[:, i] * factor[:, j]).ravel()


def solve(problem: Statement, *, accept_inaccurate: bool = False, **settings: Any) -> Solution:
    """Solve by Clarabel; only a full answer is returned unless another one is asked for."""
    solution = solve_form(conic_form(problem), settings)
    if solution.solved or accept_inaccurate:
        return solution
    status = solution.status
    if solution.infeasible:
        raise InfeasibleDesign(
            f"{problem.name}: the solver reports that no values satisfy all constraints",
            [f"constraints: {', '.join(problem.blocks)}"],
            duals=solution.duals,
            **solution.facts(),
        )
    remedy = {
        "DualInfeasible": "the objective is unbounded: bound the variables it contains",
        "AlmostPrimalInfeasible": "the constraints hardly leave room, if any: maximise a margin",
    }.get(status, "scale the variables, widen the margins, or try another solver")
    raise SolverTrouble(
        f"{problem.name}: Clarabel ended with {status} after {solution.iterations} iterations",
        [remedy, f"constraints: {', '.join(problem.blocks)}"],
        solution=solution,
        **solution.facts(),
    )


def solve_form(form: ConicForm, settings: Mapping[str, Any]) -> Solution:
    """Run Clarabel on a conic form and name the results."""
    raw = _run(form, settings)
    status = str(raw.status)
    return Solution(
        values=form.values(np.asarray(raw.x)),
        status=status,
        solved=status == "Solved",
        infeasible=status == "PrimalInfeasible",
        objective=form.sign * raw.obj_val + form.constant,
        gap=abs(raw.obj_val - raw.obj_val_dual) / max(1.0, abs(raw.obj_val)),
        solver="Clarabel",
        solve_time=raw.solve_time,
        iterations=raw.iterations,
        duals=form.duals(np.asarray(raw.z)),
    )


def _run(form: ConicForm, settings: Mapping[str, Any]) -> Any:
    import clarabel

    kinds = {
        "zero": lambda n: clarabel.ZeroConeT(n),
        "nonnegative": lambda n: clarabel.NonnegativeConeT(n),
        "exponential": lambda n: clarabel.ExponentialConeT(),
        "psd": lambda n: clarabel.PSDTriangleConeT(n),
    }
    cones = [kinds[cone.kind](cone.n) for cone in form.cones for _ in range(cone.count)]
    options = clarabel.DefaultSettings()
    options.verbose = False
    for name, value in settings.items():
        if not hasattr(options, name):
            raise SolverTrouble(f"Clarabel has no setting {name!r}", setting=name)
        setattr(options, name, value)
    size = len(form.c)
    nothing = sparse.csc_matrix((size, size))
    data = sparse.csc_matrix(form.A)
    return clarabel.DefaultSolver(nothing, form.c, data, form.b, cones, options).solve()
