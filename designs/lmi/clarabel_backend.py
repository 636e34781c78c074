"""Clarabel, called without a modelling language in between."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.designs.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.lmi.cones import Cone, ConicForm, conic_form, unstack_triangles
from obsynth.designs.lmi.problem import Problem
from obsynth.designs.lmi.solution import Solution

__all__ = ["solve"]


def solve(problem: Problem, *, accept_inaccurate: bool = False, **settings: Any) -> Solution:
    """Solve a problem; see :meth:`Problem.solve`.

    Parameters
    ----------
    problem : Problem
        What to solve.
    accept_inaccurate : bool
        Return any outcome flagged instead of raising.
    **settings
        Fields of Clarabel's settings.

    Examples
    --------
    >>> from obsynth.designs.lmi import Problem, scalar
    >>> problem = Problem("smallest number above two")
    >>> t = scalar("t")
    >>> problem.add("floor", t >= 2.0)
    >>> problem.minimise(t)
    >>> round(solve(problem).objective, 6)
    2.0
    """
    form = conic_form(problem)
    raw = _run(form, settings)
    status = str(raw.status)
    values = form.unpack(np.asarray(raw.x), problem)
    solution = Solution(
        values=values,
        status=status,
        solved=status == "Solved",
        objective=form.sign * raw.obj_val + form.constant,
        solver="Clarabel",
        solve_time=raw.solve_time,
        iterations=raw.iterations,
        duals=_duals(form, np.asarray(raw.z), problem),
    )
    if solution.solved or accept_inaccurate:
        return solution
    if status == "PrimalInfeasible":
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
        f"{problem.name}: Clarabel ended with {status} after {raw.iterations} iterations",
        [remedy, f"constraints: {', '.join(problem.blocks)}"],
        solution=solution,
        **solution.facts(),
    )


def _run(form: ConicForm, settings: dict[str, Any]) -> Any:
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
