"""Many vertices: solve with a few, check all, add the worst, until none is violated."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from obsynth.designs.core.errors import SolverTrouble
from obsynth.designs.lmi.family import Family
from obsynth.designs.lmi.problem import Problem
from obsynth.designs.lmi.retry import solve_with_retries
from obsynth.designs.lmi.solution import Solution

IntArray = NDArray[np.intp]

# A family with no more vertices is stated whole.
_FEW = 24

# Before all vertices are looked at, so many are tried at random.
_SAMPLE = 4096

_ROUNDS = 60


@dataclass(frozen=True, eq=False)
class LazySolution:
    """A solution found with some vertices and checked at all.

    solution: of the last round
    problem: as it was stated in the last round
    chosen: vertices that were stated, by family; start from them when solving a similar problem
    rounds: number of solves
    """

    solution: Solution
    problem: Problem
    chosen: Mapping[str, IntArray]
    rounds: int


def solve_lazily(
    problem: Problem,
    families: Sequence[Family] = (),
    *,
    start: Mapping[str, IntArray] | None = None,
    add: int = 6,
    floor: float | Callable[[Problem, Solution], float] = 0.0,
    solve: Callable[[Problem], Solution] = solve_with_retries,
) -> LazySolution:
    """Solve a problem whose families have many vertices."""
    every = {family.name: family for family in (*_large_blocks(problem), *families)}
    chosen = {
        name: _first_choice(family, None if start is None else start.get(name))
        for name, family in every.items()
    }
    for count in range(1, _ROUNDS + 1):
        stated = _with_vertices(problem, families, chosen)
        solution = solve(stated)
        least = floor(stated, solution) if callable(floor) else floor
        fresh = {
            name: _to_add(family, solution, chosen[name], least, add)
            for name, family in every.items()
        }
        if not any(len(new) for new in fresh.values()):
            return LazySolution(solution, stated, chosen, count)
        chosen = {name: np.union1d(chosen[name], fresh[name]) for name in every}
    raise SolverTrouble(
        f"{problem.name}: vertices are still violated after {_ROUNDS} rounds",
        [f"{name}: {len(c)} of {every[name].count} vertices stated" for name, c in chosen.items()],
        chosen=chosen,
    )


def _large_blocks(problem: Problem) -> list[Family]:
    return [
        Family.of_block(item)
        for item in problem.blocks.values()
        if item.cone == "psd" and (item.expression.members or 1) > _FEW
    ]


def _first_choice(family: Family, given: IntArray | None) -> IntArray:
    if given is not None and len(given):
        return np.unique(given)
    if family.count <= _FEW:
        return np.arange(family.count)
    drawn = np.random.default_rng(0).choice(family.count, 6, replace=False)
    return np.union1d(drawn, [0, family.count - 1])


def _with_vertices(
    problem: Problem, families: Sequence[Family], chosen: Mapping[str, IntArray]
) -> Problem:
    stated = problem.blocks
    part = problem.members({name: index for name, index in chosen.items() if name in stated})
    for family in families:
        expression = family.expression(chosen[family.name])
        part.add_lmi(family.name, expression, ">>", strict=family.strict)
    return part


def _to_add(
    family: Family, solution: Solution, stated: IntArray, floor: float, add: int
) -> IntArray:
    if len(stated) == family.count or floor == -np.inf:
        return np.zeros(0, dtype=np.intp)
    if family.count > 4 * _SAMPLE:
        sample = np.random.default_rng(len(stated)).choice(family.count, _SAMPLE, replace=False)
        found = family.violations(solution.values, floor, sample)
        new = np.setdiff1d(found.spread(add), stated)
        if len(new):
            return new
    found = family.violations(solution.values, floor)
    new = np.setdiff1d(found.spread(add), stated)
    if len(found.vertices) and not len(new):
        raise SolverTrouble(
            f"{family.name}: vertex {found.vertices[0]} is stated and still has the smallest "
            f"eigenvalue {found.eigenvalues[0]:.3g}, below {floor:.3g}",
            ["the solver's accuracy is the limit: ask for a wider margin"],
            vertex=int(found.vertices[0]),
            eigenvalue=float(found.eigenvalues[0]),
        )
    return new
