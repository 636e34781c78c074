"""Clarabel, called without a modelling language in between."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.designs.core.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.lmi.cones import Cone, ConicForm, conic_form, unstack_triangles
from obsynth.designs.lmi.problem import Problem
from obsynth.designs.lmi.solution import Solution


def solve(problem: Problem, *, accept_inaccurate: bool = False, **settings: Any) -> Solution:
    """Solve a problem; see :meth:`Problem.solve`."""
    solution = solve_form(conic_form(problem), problem, settings)
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


def solve_form(
    form: ConicForm,
    problem: Problem,
    settings: Mapping[str, Any],
    columns: NDArray[np.float64] | None = None,
    rows: NDArray[np.float64] | None = None,
) -> Solution:
    """Run Clarabel on a conic form and name the results."""
    raw = _run(form, settings)
    x, z = np.asarray(raw.x), np.asarray(raw.z)
    status = str(raw.status)
    return Solution(
        values=form.unpack(x if columns is None else x * columns, problem),
        status=status,
        solved=status == "Solved",
        infeasible=status == "PrimalInfeasible",
        objective=form.sign * raw.obj_val + form.constant,
        gap=abs(raw.obj_val - raw.obj_val_dual) / max(1.0, abs(raw.obj_val)),
        solver="Clarabel",
        solve_time=raw.solve_time,
        iterations=raw.iterations,
        duals=_duals(form, z if rows is None else z * rows, problem),
    )


def _run(form: ConicForm, settings: Mapping[str, Any]) -> Any:
    import clarabel
    from scipy import sparse

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


def _duals(
    form: ConicForm, z: NDArray[np.float64], problem: Problem
) -> dict[str, NDArray[np.float64]]:
    """Dual of every block in the shape of its expression."""
    duals = {}
    for cone in form.cones:
        duals[cone.block] = _dual(cone, z[cone.rows], problem)
    return duals


def _dual(cone: Cone, z: NDArray[np.float64], problem: Problem) -> NDArray[np.float64]:
    shape = problem.blocks[cone.block].expression.constant.shape
    if cone.kind == "psd":
        return unstack_triangles(z, cone.n, cone.count).reshape(shape)
    if cone.kind == "exponential":
        return z.reshape(shape)
    return np.swapaxes(z.reshape((*shape[:-2], shape[-1], shape[-2])), -1, -2)
