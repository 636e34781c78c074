"""When the solver gives up: scale the problem, then ask another solver, and tell."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from obsynth.designs.core.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.lmi.clarabel_backend import solve_form
from obsynth.designs.lmi.cones import Cone, ConicForm, conic_form
from obsynth.designs.lmi.cvxpy_backend import solve_with_cvxpy
from obsynth.designs.lmi.problem import Problem
from obsynth.designs.lmi.solution import Solution
from obsynth.designs.lmi.variables import upper_triangle

SECOND_SOLVERS = ("SDPA", "SCS")

_SWEEPS = 6


def solve_with_retries(
    problem: Problem,
    second_solvers: Sequence[str] = SECOND_SOLVERS,
    good_enough: Callable[[Solution], bool] | None = None,
    **settings: Any,
) -> Solution:
    """Solve by Clarabel, then by Clarabel on the scaled problem, then by other solvers."""
    form = conic_form(problem)
    attempts: list[str] = []

    def final(solution: Solution) -> bool:
        attempts.append(f"{solution.solver}: {solution.status}")
        if solution.infeasible:
            raise InfeasibleDesign(
                f"{problem.name}: the solver reports that no values satisfy all constraints",
                attempts,
                duals=solution.duals,
                attempts=tuple(attempts),
                **solution.facts(),
            )
        return solution.solved or (good_enough is not None and good_enough(solution))

    solution = solve_form(form, problem, settings)
    if final(solution):
        return replace(solution, attempts=tuple(attempts))
    scaled, columns, rows = rescaled(form)
    solution = solve_form(scaled, problem, settings, columns=columns, rows=rows)
    solution = replace(solution, solver="Clarabel, scaled")
    if final(solution):
        return replace(solution, attempts=tuple(attempts))
    import cvxpy as cp

    installed = cp.installed_solvers()
    for name in second_solvers:
        if name not in installed:
            attempts.append(f"{name}: not installed")
            continue
        try:
            solution = solve_with_cvxpy(problem, name, accept_inaccurate=True)
        except SolverTrouble as trouble:
            attempts.append(str(trouble))
            continue
        if final(solution):
            return replace(solution, attempts=tuple(attempts))
    raise SolverTrouble(
        f"{problem.name}: no solver solved it",
        [*attempts, "widen the margins or bound the variables"],
        attempts=tuple(attempts),
        status=solution.status,
    )


def rescaled(form: ConicForm) -> tuple[ConicForm, NDArray[np.float64], NDArray[np.float64]]:
    """Scale unknowns and blocks by powers of two; matrix blocks by a congruence D F D."""
    columns, rows = np.ones(len(form.c)), np.ones(len(form.b))
    size = sparse.csr_array(abs(form.A))
    offset = np.abs(form.b)
    for _ in range(_SWEEPS):
        current = sparse.csr_array(sparse.diags_array(rows) @ size @ sparse.diags_array(columns))
        largest = np.maximum(_row_maxima(current), offset * rows)
        for cone in form.cones:
            rows[cone.rows] *= _cone_factor(cone, largest[cone.rows])
        current = sparse.csr_array(sparse.diags_array(rows) @ size @ sparse.diags_array(columns))
        columns *= _power_of_two(_row_maxima(sparse.csr_array(current.T)))
    A = sparse.csc_array(sparse.diags_array(rows) @ form.A @ sparse.diags_array(columns))
    return replace(form, c=form.c * columns, A=A, b=form.b * rows), columns, rows


def _row_maxima(matrix: sparse.csr_array) -> NDArray[np.float64]:
    return np.asarray(matrix.max(axis=1).todense(), dtype=float).ravel()


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
