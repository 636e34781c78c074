"""The same problem in cvxpy: transparent, any solver, and the second opinion in tests."""

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from obsynth.designs.core.errors import SolverTrouble
from obsynth.designs.lmi.conic import Solution, Statement
from obsynth.designs.lmi.expression import Affine, Structure, Variable

# SDPA often stops a little short of its default of 1e-7 and then calls itself inaccurate.
_OPTIONS: Mapping[str, Mapping[str, Any]] = {
    "SDPA": {"epsilonStar": 1e-6, "epsilonDash": 1e-6, "lambdaStar": 1e4},
}


def to_cvxpy(problem: Statement) -> Any:
    """Translate; variables have the same names, and every vertex is a constraint."""
    import cvxpy as cp

    unknowns = {v: _variable(v) for v in problem.variables.values()}
    constraints: list[Any] = []
    for item in problem.blocks.values():
        for k in range(item.expression.members or 1):
            matrix = _matrix(item.expression.member(k), unknowns)
            if item.cone == "psd":
                constraints.append(0.5 * (matrix + matrix.T) >> 0)
            elif item.cone == "nonnegative":
                constraints.append(matrix >= 0)
            elif item.cone == "zero":
                constraints.append(matrix == 0)
            else:
                constraints.append(cp.ExpCone(matrix[:, 0], matrix[:, 1], matrix[:, 2]))
    goal = cp.sum(_matrix(problem.objective, unknowns))
    return cp.Problem(cp.Maximize(goal) if problem.maximising else cp.Minimize(goal), constraints)


def solve_with_cvxpy(problem: Statement, solver: str) -> Solution:
    """Solve by any solver cvxpy knows; the solution says how it ended."""
    import cvxpy as cp

    translated = to_cvxpy(problem)
    try:
        with warnings.catch_warnings():
            # The status says the same, and says it to the caller.
            warnings.simplefilter("ignore", UserWarning)
            translated.solve(solver=solver, **_OPTIONS.get(solver, {}))
    except cp.error.SolverError as trouble:
        raise SolverTrouble(
            f"{problem.name}: {solver} failed", [str(trouble).splitlines()[0]], solver=solver
        ) from trouble
    status = str(translated.status)
    found = translated.var_dict
    values = {
        name: _value(found.get(name), variable) for name, variable in problem.variables.items()
    }
    statistics = translated.solver_stats
    return Solution(
        values=values,
        status=status,
        solved=status == "optimal",
        infeasible=status == "infeasible",
        objective=float(translated.value) if translated.value is not None else np.nan,
        solver=solver,
        gap=np.inf,
        solve_time=float(statistics.solve_time or 0.0),
        iterations=int(statistics.num_iters or 0),
    )


def _variable(variable: Variable) -> Any:
    import cvxpy as cp

    options = {
        Structure.SYMMETRIC: {"symmetric": True},
        Structure.DIAGONAL: {"diag": True},
    }.get(variable.structure, {})
    return cp.Variable(variable.shape, name=variable.name, **options)


def _matrix(expression: Affine, unknowns: dict[Variable, Any]) -> Any:
    import cvxpy as cp

    stacked = expression.constant.T.ravel()
    for variable, operator in expression.terms.items():
        rows, columns = variable.free_entries
        entries = cp.vec(unknowns[variable], order="F")[columns * variable.shape[0] + rows]
        stacked = stacked + operator @ entries
    if not expression.terms:
        return cp.Constant(expression.constant)
    return cp.reshape(stacked, expression.shape, order="F")


def _value(found: Any, variable: Variable) -> np.ndarray[Any, np.dtype[np.float64]]:
    value = None if found is None else found.value
    if value is None:
        return np.full(variable.shape, np.nan)
    dense = value.toarray() if hasattr(value, "toarray") else value
    return np.asarray(dense, dtype=float).reshape(variable.shape)
