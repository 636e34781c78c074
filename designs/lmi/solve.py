"""How a stated problem is solved again: scaled, by other solvers, and with more of its vertices.

A family with many vertices is stated with few, all are checked, and the worst are added.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from obsynth.derive.rigour import prove_positive_definite
from obsynth.designs.core.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.lmi.conic import Solution, conic_form, rescaled, solve_form
from obsynth.designs.lmi.cvxpy_backend import solve_with_cvxpy
from obsynth.designs.lmi.expression import IntArray
from obsynth.designs.lmi.problem import Problem
from obsynth.designs.lmi.proof import excluded_size

SECOND_SOLVERS = ("SDPA", "SCS")

# A problem counts as infeasible where all values below this size are excluded.
SHOWN = 1e3

# A family with no more vertices is stated whole.
_FEW = 24

# So many vertices are stated at first, and so many added in every round.
_FIRST, _ADDED = 6, 6

_ROUNDS = 60

# Before all vertices are looked at, so many are tried at random.
_SAMPLE = 4096

# Eigenvalues are computed for no more than so many failing vertices of a family.
_EXAMINED = 2048

# Entries of the matrices looked at a time.
_CHUNK_ENTRIES = 2**21

# Two violations are alike when their eigenvectors have this cosine.
_ALIKE = 0.9


def solve_with_retries(
    problem: Problem,
    second_solvers: Sequence[str] = SECOND_SOLVERS,
    good_enough: Callable[[Solution], bool] | None = None,
) -> Solution:
    """Solve by Clarabel, scaled, by others; infeasible is what exact arithmetic shows."""
    attempts: list[str] = []
    status = ""
    for outcome in _attempts(problem, second_solvers):
        if isinstance(outcome, str):
            attempts.append(outcome)
            continue
        status = outcome.status
        attempts.append(f"{outcome.solver}: {status}")
        excluded = excluded_size(problem, outcome) if outcome.infeasible else 0.0
        if excluded > SHOWN:
            raise InfeasibleDesign(
                f"{problem.name}: no values below {excluded:.3g} in size satisfy all constraints",
                ["shown in exact arithmetic from the solver's dual solution", *attempts],
                excluded=excluded,
                duals=outcome.duals,
                attempts=tuple(attempts),
                **outcome.facts(),
            )
        if outcome.solved or (good_enough is not None and good_enough(outcome)):
            return replace(outcome, attempts=tuple(attempts))
    raise SolverTrouble(
        f"{problem.name}: no solver solved it",
        [*attempts, "widen the margins or bound the variables"],
        attempts=tuple(attempts),
        status=status,
    )


def _attempts(problem: Problem, second_solvers: Sequence[str]) -> Iterator[Solution | str]:
    """One way to solve after the other; a sentence where one is not there or fails."""
    statement = problem.statement
    form = conic_form(statement)
    yield solve_form(form, {})
    yield replace(solve_form(rescaled(form), {}), solver="Clarabel, scaled")
    if not second_solvers:
        return
    import cvxpy as cp

    installed = cp.installed_solvers()
    for name in second_solvers:
        if name not in installed:
            yield f"{name}: not installed"
            continue
        try:
            outcome: Solution | str = solve_with_cvxpy(statement, name)
        except SolverTrouble as trouble:
            outcome = str(trouble)
        yield outcome


@dataclass(frozen=True, eq=False)
class LazySolution:
    """A solution found with some vertices by family, as stated last, and checked at all."""

    solution: Solution
    problem: Problem
    chosen: Mapping[str, IntArray]
    rounds: int


def solve_lazily(
    problem: Problem,
    *,
    start: Mapping[str, IntArray] | None = None,
    floor: float | Callable[[Problem, Solution], float] = 0.0,
    solve: Callable[[Problem], Solution] = solve_with_retries,
) -> LazySolution:
    """Solve a problem with many vertices, from some of a start, none left below the floor."""
    families = {
        item.name: item.expression
        for item in problem.blocks.values()
        if item.cone == "psd" and (item.expression.members or 1) > _FEW
    }
    chosen = {
        name: (start or {}).get(name, _first_choice(family.members or 1))
        for name, family in families.items()
    }
    for count in range(1, _ROUNDS + 1):
        stated = problem.members(chosen)
        solution = solve(stated)
        least = floor(stated, solution) if callable(floor) else floor
        fresh = {
            name: _to_add(name, _symmetric(solution.value(family)), chosen[name], least)
            for name, family in families.items()
        }
        if not any(len(new) for new in fresh.values()):
            return LazySolution(solution, stated, chosen, count)
        chosen = {name: np.union1d(chosen[name], fresh[name]) for name in families}
    raise SolverTrouble(
        f"{problem.name}: vertices are still violated after {_ROUNDS} rounds",
        [f"{name}: {len(c)} of {families[name].members} stated" for name, c in chosen.items()],
        chosen=chosen,
    )


def solve_reliably(problem: Problem, *, floor: float, gap: float) -> Solution:
    """Solve lazily, with retries; what has a small duality gap serves, as a proof follows."""

    def solve(stated: Problem) -> Solution:
        return solve_with_retries(stated, (), lambda found: 0 <= found.gap < gap)

    return solve_lazily(problem, floor=floor, solve=solve).solution


def _first_choice(count: int) -> IntArray:
    drawn = np.random.default_rng(0).choice(count, _FIRST, replace=False)
    return np.union1d(drawn, [0, count - 1])


def _symmetric(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Symmetric part, which is what is stated: products may round differently on either side."""
    return 0.5 * matrices + 0.5 * np.swapaxes(matrices, -1, -2)


def _to_add(name: str, matrices: NDArray[np.float64], stated: IntArray, floor: float) -> IntArray:
    """Vertices of a family (N, n, n) to be stated next."""
    count = len(matrices)
    if len(stated) == count or floor == -np.inf:
        return np.zeros(0, dtype=np.intp)
    if count > 4 * _SAMPLE:
        sample = np.random.default_rng(len(stated)).choice(count, _SAMPLE, replace=False)
        new = np.setdiff1d(_violated(matrices, floor, sample)[0], stated)
        if len(new):
            return new
    violated, least = _violated(matrices, floor, np.arange(count))
    new = np.setdiff1d(violated, stated)
    if len(violated) and not len(new):
        raise SolverTrouble(
            f"{name}: vertex {violated[0]} is stated and still has the smallest eigenvalue "
            f"{least:.3g}, below {floor:.3g}",
            ["the solver's accuracy is the limit: ask for a wider margin"],
            vertex=int(violated[0]),
            eigenvalue=least,
        )
    return new


def _violated(
    matrices: NDArray[np.float64], floor: float, among: IntArray
) -> tuple[IntArray, float]:
    """Vertices worst below the floor that differ, the worst first, and its eigenvalue."""
    n = matrices.shape[-1]
    lift = floor * np.eye(n)
    step = max(1, _CHUNK_ENTRIES // (n * n))
    parts = [among[start : start + step] for start in range(0, len(among), step)]
    failing = [
        part[~prove_positive_definite(matrices[part] - lift, sharp=False).proved] for part in parts
    ]
    vertices = np.concatenate(failing)
    if len(vertices) > _EXAMINED:
        vertices = np.random.default_rng(0).choice(vertices, _EXAMINED, replace=False)
    if not len(vertices):
        return vertices, np.inf
    eigenvalues, vectors = np.linalg.eigh(matrices[vertices])
    picked: list[int] = []
    for k in np.argsort(eigenvalues[:, 0], kind="stable"):
        overlap = np.abs(vectors[picked, :, 0] @ vectors[k, :, 0])
        if not len(overlap) or overlap.max() < _ALIKE:
            picked.append(int(k))
        if len(picked) == _ADDED:
            break
    return vertices[picked], float(eigenvalues[picked[0], 0])
