"""Branch and bound over batches of boxes, breadth first, for many expressions at once.

Every expression has two goals, its largest value and (as the largest value of its negative) its
smallest one. A row of the batch is a box that belongs to one goal. In every sweep a row is bounded
by the natural extension and by the mean-value form, shrunk to a facet in every variable in which
the expression is monotone, used to look for a better attained value, and then closed or split. A
variable that enters affinely is split into its two facets, never in the middle.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from obsynth.derive.intervals.arithmetic import Array, up
from obsynth.derive.intervals.evaluate import enclose
from obsynth.derive.intervals.program import Program

__all__ = ["Budget", "Outcome", "Problem", "maximise"]

# Cost of one operation on a batch, in microseconds: a fixed part and a part per box. Their ratio
# decides whether a sweep runs the shared program once or the parts of it one by one.
_COST_FIXED, _COST_PER_BOX = 12.0, 0.05
_CHUNK = 8192
_SINGULAR_ROWS = 8
_SINGULAR_WIDTH = 2.0**-20
_SAMPLES = 48
_TINY = 1e-300


@dataclass(frozen=True)
class Problem:
    """Expressions with their gradients over one box.

    Attributes
    ----------
    program : Program
        Outputs: first the expressions, then the structurally nonzero partial derivatives.
    gradient : ndarray of int, shape (m, v)
        Position of a partial derivative among the outputs; -1 where it is zero.
    relevant : ndarray of bool, shape (m, v)
        Whether an expression depends on a variable.
    affine : ndarray of bool, shape (m, v)
        Whether an expression is affine in a variable with the others held.
    lower, upper : ndarray, shape (v,)
        The box.
    """

    program: Program
    gradient: NDArray[np.int64]
    relevant: NDArray[np.bool_]
    affine: NDArray[np.bool_]
    lower: Array
    upper: Array


@dataclass(frozen=True)
class Budget:
    """How much work may be spent: boxes in all, and sweeps."""

    boxes: int
    sweeps: int


@dataclass
class Outcome:
    """What was found for every goal (2 e: minus the expression e, 2 e + 1: the expression).

    Attributes
    ----------
    bound : ndarray, shape (2 m,)
        Guaranteed upper bounds.
    attained : ndarray, shape (2 m,)
        Guaranteed lower bounds of the value at ``points``.
    points : ndarray, shape (2 m, v)
        Where these values are attained.
    noise : ndarray, shape (2 m,)
        Largest width of the enclosure of a value at a single point: what rounding alone costs.
    finished : ndarray of bool, shape (2 m,)
        False where the budget ran out.
    singular : dict of int to (ndarray, ndarray)
        Goals without a finite bound, with a sub-box where that happens.
    boxes, sweeps : int
        Work done.
    """

    bound: Array
    attained: Array
    points: Array
    noise: Array
    finished: NDArray[np.bool_]
    singular: dict[int, tuple[Array, Array]] = field(default_factory=dict)
    boxes: int = 0
    sweeps: int = 0


@dataclass
class _Rows:
    goal: NDArray[np.int64]
    lower: Array  # (v, N)
    upper: Array
    bound: Array  # (N,)

    def take(self, which: NDArray[np.bool_] | NDArray[np.int64]) -> "_Rows":
        return _Rows(
            self.goal[which], self.lower[:, which], self.upper[:, which], self.bound[which]
        )

    @staticmethod
    def join(parts: "list[_Rows]") -> "_Rows":
        return _Rows(
            np.concatenate([p.goal for p in parts]),
            np.concatenate([p.lower for p in parts], axis=1),
            np.concatenate([p.upper for p in parts], axis=1),
            np.concatenate([p.bound for p in parts]),
        )

    @property
    def count(self) -> int:
        return len(self.goal)


@dataclass(frozen=True)
class _Ranges:
    """Value and gradient of the goal's expression for every row, in the goal's sign."""

    lower: Array  # (N,)
    upper: Array
    slope_lower: Array  # (v, N); infinite where the row is rough
    slope_upper: Array


def _enclose_rows(problem: Problem, rows: _Rows, slopes: bool) -> _Ranges:
    v, n = rows.lower.shape
    entry = rows.goal // 2
    lo, hi = np.empty(n), np.empty(n)
    slope_lo, slope_hi = np.zeros((v, n)), np.zeros((v, n))
    entries, counts = np.unique(entry, return_counts=True)

    def outputs(some: NDArray[np.int64]) -> list[int]:
        chosen = [int(e) for e in some]
        if slopes:
            chosen += sorted({int(k) for k in problem.gradient[some].ravel() if k >= 0})
        return chosen

    shared = outputs(entries)
    parts = [outputs(np.array([e])) for e in entries]
    live = problem.program.live
    cost_shared = len(live(shared)) * (_COST_FIXED + _COST_PER_BOX * n)
    cost_parts = sum(
        len(live(p)) * (_COST_FIXED + _COST_PER_BOX * c) for p, c in zip(parts, counts, strict=True)
    )
    if cost_shared <= cost_parts:
        batches = [(shared, np.arange(n), entries)]
    else:
        batches = [
            (p, np.flatnonzero(entry == e), np.array([e]))
            for p, e in zip(parts, entries, strict=True)
        ]
    for chosen, index, some in batches:
        found = enclose(
            problem.program,
            rows.lower[:, index],
            rows.upper[:, index],
            chosen,
            len(some) if slopes else 0,
        )
        where = {k: row for row, k in enumerate(chosen)}
        for e in some:
            inside = np.flatnonzero(entry[index] == e)
            target = index[inside]
            lo[target] = found.lower[where[int(e)], inside]
            hi[target] = found.upper[where[int(e)], inside]
            if slopes:
                for j, k in enumerate(problem.gradient[e]):
                    if k >= 0:
                        slope_lo[j, target] = found.lower[where[int(k)], inside]
                        slope_hi[j, target] = found.upper[where[int(k)], inside]
                rough = target[found.rough[where[int(e)], inside]]
                touched = np.ix_(problem.relevant[e], rough)
                slope_lo[touched], slope_hi[touched] = -np.inf, np.inf
    falling = rows.goal % 2 == 0
    lo, hi = np.where(falling, -hi, lo), np.where(falling, -lo, hi)
    if slopes:
        slope_lo, slope_hi = (
            np.where(falling, -slope_hi, slope_lo),
            np.where(falling, -slope_lo, slope_hi),
        )
    return _Ranges(lo, hi, slope_lo, slope_hi)


class _Search:
    """State of one run; `maximise` is the way in."""

    def __init__(self, problem: Problem, rtol: float, budget: Budget) -> None:
        m = len(problem.gradient)
        self.problem, self.rtol, self.budget = problem, rtol, budget
        self.best = np.full(2 * m, -np.inf)
        self.points = np.tile(0.5 * (problem.lower + problem.upper), (2 * m, 1))
        self.closed = np.full(2 * m, -np.inf)
        self.noise = np.zeros(2 * m)
        self.singular: dict[int, tuple[Array, Array]] = {}
        self.boxes = self.sweeps = 0
        self.root_width = np.where(
            problem.upper > problem.lower, problem.upper - problem.lower, 1.0
        )

    def initial(self) -> _Rows:
        problem = self.problem
        m = len(problem.gradient)
        goal = np.arange(2 * m)
        relevant = problem.relevant[goal // 2].T
        middle = 0.5 * (problem.lower + problem.upper)[:, None]
        return _Rows(
            goal,
            np.where(relevant, problem.lower[:, None], middle),
            np.where(relevant, problem.upper[:, None], middle),
            np.full(2 * m, np.inf),
        )

    # -- attained values ---------------------------------------------------------

    def record(self, rows: _Rows) -> tuple[Array, Array]:
        """Evaluate at points (boxes without width), remember the best of every goal."""
        found = _enclose_rows(self.problem, rows, slopes=False)
        lo, hi = found.lower, found.upper
        usable = np.isfinite(lo) & np.isfinite(hi)
        np.maximum.at(self.noise, rows.goal[usable], (hi - lo)[usable])
        order = np.flatnonzero(usable)[np.argsort(lo[usable], kind="stable")]
        # later assignments win, so the largest value of every goal is the one that stays
        better = order[lo[order] > self.best[rows.goal[order]]]
        self.points[rows.goal[better]] = rows.lower[:, better].T
        self.best[rows.goal[better]] = lo[better]
        return lo, hi

    def sample(self, goals: NDArray[np.int64]) -> None:
        """Try points of a fixed pattern and the corners of the box for unsettled goals."""
        problem = self.problem
        v = len(problem.lower)
        rng = np.random.default_rng(0)
        share = rng.random((v, _SAMPLES))
        share[:, : _SAMPLES // 3] = rng.integers(0, 2, (v, _SAMPLES // 3))
        where = problem.lower[:, None] + share * (problem.upper - problem.lower)[:, None]
        where = np.clip(where, problem.lower[:, None], problem.upper[:, None])
        goal = np.repeat(goals, _SAMPLES)
        at = np.tile(where, (1, len(goals)))
        self.record(_Rows(goal, at, at, np.zeros(len(goal))))

    def tolerance(self) -> Array:
        width = self.best[0::2] + self.best[1::2]
        share = 0.5 * self.rtol * np.where(np.isfinite(width), np.maximum(width, 0.0), 0.0)
        return np.maximum(np.repeat(share, 2), 4.0 * self.noise) + _TINY

    # -- one sweep ---------------------------------------------------------------

    def sweep(self, rows: _Rows) -> _Rows:
        """Bound rows, close what can be closed, return the halves of the others."""
        self.boxes += rows.count
        self.sweeps += 1
        problem = self.problem
        found = _enclose_rows(problem, rows, slopes=True)
        slope_lo, slope_hi = found.slope_lower, found.slope_upper
        bound = np.fmin(rows.bound, found.upper)
        rising, falling = slope_lo >= 0.0, slope_hi <= 0.0
        lower = np.where(rising & ~falling, rows.upper, rows.lower)
        upper = np.where(falling, lower, rows.upper)
        centre = np.clip(0.5 * (lower + upper), lower, upper)
        _, centre_hi = self.record(_Rows(rows.goal, centre, centre, bound))
        radius = np.where(upper > lower, up(np.maximum(upper - centre, centre - lower)), 0.0)
        size = np.maximum(np.abs(slope_lo), np.abs(slope_hi))
        with np.errstate(invalid="ignore", over="ignore"):
            terms = np.where(radius > 0.0, up(size * radius), 0.0)
            spread = terms.sum(axis=0)
            # the sum of v nonnegative terms is off by less than v + 1 units in the last place
            spread = up(spread * (1.0 + (len(lower) + 2) * 2.3e-16))
            bound = np.fmin(bound, up(centre_hi + spread))
        singular = ~np.isfinite(bound)
        width = (upper - lower) / self.root_width[:, None]
        deep = singular & (width.max(axis=0) < _SINGULAR_WIDTH)
        for k in np.flatnonzero(deep):
            self.singular.setdefault(int(rows.goal[k]), (rows.lower[:, k], rows.upper[:, k]))
        gone = np.isin(rows.goal, list(self.singular))
        done = bound <= self.best[rows.goal] + self.tolerance()[rows.goal]
        is_point = ~(upper > lower).any(axis=0)
        finished = (done | is_point) & ~gone
        np.maximum.at(self.closed, rows.goal[finished], bound[finished])
        left = ~(finished | gone)
        rest = _Rows(rows.goal, lower, upper, bound).take(left)
        return self.split(rest, terms[:, left], width[:, left])

    def split(self, rows: _Rows, terms: Array, width: Array) -> _Rows:
        if rows.count == 0:
            return rows
        usable = np.isfinite(terms).all(axis=0) & np.isfinite(rows.bound)
        score = np.where(usable, terms, width)
        score = np.where(rows.upper > rows.lower, score, -1.0)
        axis = np.argmax(score, axis=0)
        columns = np.arange(rows.count)
        lo, hi = rows.lower[axis, columns], rows.upper[axis, columns]
        flat = self.problem.affine[rows.goal // 2, axis] & usable
        middle = 0.5 * (lo + hi)
        first = _Rows(rows.goal, rows.lower.copy(), rows.upper.copy(), rows.bound)
        second = _Rows(rows.goal, rows.lower.copy(), rows.upper.copy(), rows.bound)
        first.upper[axis, columns] = np.where(flat, lo, middle)
        second.lower[axis, columns] = np.where(flat, hi, middle)
        return _Rows.join([first, second])

    # -- the loop ----------------------------------------------------------------

    def choose(self, rows: _Rows) -> tuple[_Rows, _Rows]:
        """Rows for the next sweep and rows that wait."""
        singular = ~np.isfinite(rows.bound)
        if self.sweeps and singular.any():
            # one small box without a bound settles its goal: follow a few rows down to it
            now = np.zeros(rows.count, dtype=bool)
            size = ((rows.upper - rows.lower) / self.root_width[:, None]).max(axis=0)
            for goal in np.unique(rows.goal[singular]):
                index = np.flatnonzero(singular & (rows.goal == goal))
                now[index[np.argsort(size[index], kind="stable")[:_SINGULAR_ROWS]]] = True
            now |= ~np.isin(rows.goal, rows.goal[singular])
        else:
            now = np.ones(rows.count, dtype=bool)
        index = np.flatnonzero(now)
        if len(index) > _CHUNK:
            excess = (rows.bound - self.best[rows.goal])[index]
            now = np.zeros(rows.count, dtype=bool)
            now[index[np.argsort(-excess, kind="stable")[:_CHUNK]]] = True
        return rows.take(now), rows.take(~now)

    def run(self) -> Outcome:
        rows = self.initial()
        unlimited = np.asarray(~np.isfinite(rows.lower + rows.upper).all(axis=0))
        if unlimited.any():
            rows = self.without_limits(rows, unlimited)
        while rows.count and self.boxes < self.budget.boxes and self.sweeps < self.budget.sweeps:
            now, wait = self.choose(rows)
            rows = _Rows.join([self.sweep(now), wait])
            if self.sweeps == 1 and rows.count:
                self.sample(np.unique(rows.goal))
            rows = rows.take(~np.isin(rows.goal, list(self.singular)))
            late = rows.bound <= self.best[rows.goal] + self.tolerance()[rows.goal]
            np.maximum.at(self.closed, rows.goal[late], rows.bound[late])
            rows = rows.take(~late)
        bound = self.closed.copy()
        np.maximum.at(bound, rows.goal, rows.bound)
        finished = np.ones(len(bound), dtype=bool)
        finished[rows.goal] = False
        for goal in self.singular:
            bound[goal] = np.inf
        return Outcome(
            bound,
            self.best,
            self.points,
            self.noise,
            finished,
            self.singular,
            self.boxes,
            self.sweeps,
        )

    def without_limits(self, rows: _Rows, unlimited: NDArray[np.bool_]) -> _Rows:
        """Goals over an unbounded box: the natural extension is all there is."""
        some = rows.take(unlimited)
        hi = _enclose_rows(self.problem, some, slopes=False).upper
        for k, goal in enumerate(some.goal):
            if np.isfinite(hi[k]):
                self.closed[goal] = hi[k]
            else:
                self.singular[int(goal)] = (some.lower[:, k], some.upper[:, k])
        return rows.take(~unlimited)


def maximise(problem: Problem, rtol: float, budget: Budget) -> Outcome:
    """Bound every expression of a problem from both sides.

    Parameters
    ----------
    problem : Problem
        Expressions, gradients and box.
    rtol : float
        Wanted gap between guaranteed and attained range, relative to the attained width.
    budget : Budget
        Where to stop; what is left open then keeps its valid, looser bound.

    Returns
    -------
    Outcome
        Bounds, attained values and points per goal.
    """
    return _Search(problem, rtol, budget).run()
