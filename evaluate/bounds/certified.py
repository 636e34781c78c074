"""Least bounds from both sides: a trajectory attains them, below a certified number none do."""

from dataclasses import dataclass, field, replace

import numpy as np

from obsynth.evaluate.bounds.boxes import Boxes, enclose
from obsynth.evaluate.bounds.linear import Linear, Solution, assemble
from obsynth.evaluate.bounds.problem import Problem
from obsynth.evaluate.bounds.trajectory import Trajectory, explain
from obsynth.symbolic.arrays import FloatArray

ROOM = 1e-5
"""By how much the least cost is looked for above that of the trajectory, relative: what misses the
equations by nothing that counts may cost less than whatever meets them."""
CONTRACTIONS = 2
"""Times at most that the intervals of parameters are cut before the bound is taken."""
STALLED = 0.05
"""Share of an interval below which another cut is not worth its programs."""


@dataclass(frozen=True, eq=False)
class Least:
    """The least ``weights'bounds`` with which a record can be explained.

    upper: of a trajectory, which needs its bounds itself; infinite where none was found
    lower: certified, at most the upper; infinite: proved that nothing explains the record
    problem: with the intervals of parameters that are left
    """

    problem: Problem
    weights: FloatArray
    trajectory: Trajectory
    lower: float
    linear: Linear | None = field(repr=False)
    solution: Solution | None = field(repr=False)

    @property
    def upper(self) -> float:
        """Cost of the trajectory."""
        return _cost(self.weights, self.trajectory)


def least(
    problem: Problem,
    weights: FloatArray,
    largest: FloatArray | None = None,
    start: FloatArray | None = None,
    contractions: int = CONTRACTIONS,
) -> Least:
    """Look for the least ``weights'bounds``; bounds with weight zero up to the largest."""
    found = explain(problem, weights, largest, start)
    upper = _cost(weights, found)
    cost = upper * (1.0 + ROOM)
    with np.errstate(divide="ignore", invalid="ignore"):
        top = np.where(weights > 0.0, cost / weights, np.inf)
    top = np.minimum(top, np.inf if largest is None else largest * (1.0 + ROOM))
    narrowed, linear, solution = below(problem, weights, top, cost, contractions)
    proved = np.inf if solution is None else max(solution.certified, 0.0)
    return Least(narrowed, weights, found, min(proved, upper), linear, solution)


def _cost(weights: FloatArray, found: Trajectory) -> float:
    counted = weights > 0.0
    return float(weights[counted] @ found.bounds[counted])


def below(
    problem: Problem, weights: FloatArray, top: FloatArray, cost: float, contractions: int
) -> tuple[Problem, Linear | None, Solution | None]:
    """Return the certified side among bounds up to the largest and costs up to one."""
    for _ in range(contractions if problem.still.any() else 0):
        after = narrowed(problem, top, weights, cost)
        if after is None:
            return problem, None, None
        before, problem = problem, after
        width = np.ptp(before.box[before.still], axis=1)
        if (np.ptp(after.box[after.still], axis=1) > (1.0 - STALLED) * width).all():
            break
    boxes = enclose(problem, top)
    if boxes.empty is not None:
        return problem, None, None
    linear = assemble(problem, boxes, top)
    solution = linear.minimise(linear.cost(weights))
    return problem, linear, solution


def narrowed(
    problem: Problem, top: FloatArray, weights: FloatArray | None = None, cost: float = np.inf
) -> Problem | None:
    """Cut the intervals of the parameters that stand still once; None where nothing is left."""
    boxes: Boxes = enclose(problem, top)
    if boxes.empty is not None:
        return None
    linear = assemble(problem, boxes, top)
    if weights is not None and np.isfinite(cost):
        linear = linear.limited(weights, cost)
    box = problem.box.copy()
    for j in np.flatnonzero(problem.still & (np.ptp(problem.box, axis=1) > 0.0)):
        if linear.shared[0, j] >= 0:
            box[j] = linear.range_of(int(linear.shared[0, j]))
            if box[j, 0] > box[j, 1]:
                return None
    return replace(problem, box=box)
