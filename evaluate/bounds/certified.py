"""Least bounds from both sides: a trajectory attains them, below a certified number none do."""

from collections.abc import Callable
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
APART = 0.05
"""Distance from the attained cost, relative, from which on the first states are cut as well."""
MOST_CUTS = 8
"""Times that they are at most."""
LONGEST = 400
"""Instants of a linear program; what it takes grows faster than with their number."""


@dataclass(frozen=True, eq=False)
class Least:
    """The least ``weights'bounds`` with which a record can be explained.

    upper: of a trajectory, which needs its bounds itself; infinite where none was found
    lower: certified, at most the upper; infinite: proved that nothing explains the record
    problem: with the intervals of parameters that are left
    begin: instant at which the window begins that the linear program is of
    """

    problem: Problem
    weights: FloatArray
    trajectory: Trajectory
    lower: float
    linear: Linear | None = field(repr=False)
    solution: Solution | None = field(repr=False)
    begin: int = 0

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
    progress: Callable[[str, float], None] | None = None,
) -> Least:
    """Look for the least ``weights'bounds``; bounds with weight zero up to the largest."""
    if progress is not None:
        progress("looking for a trajectory", 0.0)
    found = explain(problem, weights, largest, start)
    upper = _cost(weights, found)
    cost = upper * (1.0 + ROOM)
    with np.errstate(divide="ignore", invalid="ignore"):
        top = np.where(weights > 0.0, cost / weights, np.inf)
    top = np.minimum(top, np.inf if largest is None else largest * (1.0 + ROOM))
    side = below(problem, weights, top, cost, contractions, progress)
    problem, lower, linear, solution, begin = side
    lower = max(min(lower, upper), 0.0)
    return Least(problem, weights, found, lower, linear, solution, begin)


def _cost(weights: FloatArray, found: Trajectory) -> float:
    counted = weights > 0.0
    return float(weights[counted] @ found.bounds[counted])


def below(
    problem: Problem,
    weights: FloatArray,
    top: FloatArray,
    cost: float,
    contractions: int = CONTRACTIONS,
    progress: Callable[[str, float], None] | None = None,
) -> tuple[Problem, float, Linear | None, Solution | None, int]:
    """Return the certified side among bounds up to the largest and costs up to one.

    No window of a record needs more than all of it: long ones are certified by windows.
    """
    best: tuple[float, Linear | None, Solution | None, int] = -np.inf, None, None, 0
    for begin in range(0, len(problem), LONGEST):
        if progress is not None:
            progress("certifying", 0.2 + 0.8 * begin / len(problem))
        window = problem.window(begin, begin + LONGEST)
        after, linear, solution = _window(window, weights, top, cost, contractions)
        problem = replace(problem, box=after.box)
        lower = np.inf if solution is None else solution.certified
        if lower > best[0]:
            best = lower, linear, solution, begin
    return problem, *best


def _window(
    problem: Problem, weights: FloatArray, top: FloatArray, cost: float, contractions: int
) -> tuple[Problem, Linear | None, Solution | None]:
    for _ in range(contractions if problem.still.any() else 0):
        after = narrowed(problem, top, weights, cost)
        if after is None:
            return problem, None, None
        before, problem = problem, after
        width = np.ptp(before.box[before.still], axis=1)
        if (np.ptp(after.box[after.still], axis=1) > (1.0 - STALLED) * width).all():
            break
    for left in reversed(range(MOST_CUTS if contractions else 1)):
        boxes = enclose(problem, top)
        if boxes.empty is not None:
            return problem, None, None
        linear = assemble(problem, boxes, top)
        solution = linear.minimise(linear.cost(weights))
        if not left or solution.certified >= (1.0 - APART) * cost:
            break
        width = np.ptp(boxes.ends[0, : problem.n], axis=1)
        after = narrowed(problem, top, weights, cost, states=True)
        if after is None:
            return problem, None, None
        problem = after
        if (np.ptp(np.asarray(problem.first), axis=1) > (1.0 - STALLED) * width).all():
            break
    return problem, linear, solution


def narrowed(
    problem: Problem,
    top: FloatArray,
    weights: FloatArray | None = None,
    cost: float = np.inf,
    states: bool = False,
) -> Problem | None:
    """Cut the intervals of what stands still once, and of the first states if they are asked for.

    None where nothing is left.
    """
    boxes: Boxes = enclose(problem, top)
    if boxes.empty is not None:
        return None
    linear = assemble(problem, boxes, top)
    if weights is not None and np.isfinite(cost):
        linear = linear.limited(weights, cost)
    box, first = problem.box.copy(), boxes.ends[0].copy()
    for j in np.flatnonzero(np.ptp(first, axis=1) > 0.0):
        still = bool(problem.still[j])
        if linear.shared[0, j] >= 0 and (still or (states and j < problem.n)):
            ends = linear.range_of(int(linear.shared[0, j]))
            if ends[0] > ends[1]:
                return None
            (box if still else first)[j] = ends
    return replace(problem, box=box, first=first[: problem.n] if states else problem.first)
