"""Branch and bound over batches of boxes, breadth first, for many expressions at once.

Every expression has two goals, its largest value and (as the largest value of its negative) its
smallest one. A row of the batch is a box that belongs to one goal. What a sweep does with it, to
first and to second order, is told in docs/derivations.md.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from obsynth.derive.intervals.search.batch import (
    Problem,
    RowRanges,
    Rows,
    enclose_rows,
    mean_value_terms,
    shrink,
)
from obsynth.derive.intervals.search.curvature import (
    Curvatures,
    sharpened_slopes,
    taylor_spread,
)
from obsynth.derive.rigour import Interval, up
from obsynth.symbolic.arrays import BoolArray, FloatArray

if TYPE_CHECKING:
    from rich.status import Status


_PATIENCE = 2.0


@contextmanager
def patience() -> Iterator[Callable[[str], None]]:
    """Yield what shows a long search in a line; silent before two seconds and off a terminal."""
    since = time.monotonic()
    shown: list[Status | None] = []

    def tell(text: str) -> None:
        if not shown and time.monotonic() - since >= _PATIENCE:
            from rich.console import Console

            console = Console(stderr=True)
            shown.append(console.status(text) if console.is_terminal else None)
            if shown[0] is not None:
                shown[0].start()
        elif shown and shown[0] is not None:
            shown[0].update(text)

    try:
        yield tell
    finally:
        if shown and shown[0] is not None:
            shown[0].stop()


_CHUNK = 8192
# Second derivatives are worth their price only where the first few sweeps leave something open;
# their matrices limit the size of a chunk.
_FIRST_ORDER_SWEEPS = 5
# A sweep over a few boxes costs as much as one over some hundreds.
_SMALL_BATCH = 400
_MATRIX_NUMBERS = 1_000_000
# One small box without a bound settles its goal: follow a few rows down to it, not all of them.
_SINGULAR_ROWS = 8
_SINGULAR_WIDTH = 2.0**-20
# Nodes of a program from which on fewer boxes are looked at, and without second derivatives.
_LONG_PROGRAM = 2_000
_LONGEST_CURVED = 10_000
_TINY = 1e-300


@dataclass(frozen=True)
class Budget:
    """How much work may be spent: boxes in all, and sweeps."""

    boxes: int
    sweeps: int

    def for_nodes(self, nodes: int) -> Budget:
        """Return what is left where a program is so long that every box costs more.

        It has more derivatives to bound as well, and each of them is longer.
        """
        nodes = max(nodes, _LONG_PROGRAM)
        return Budget(max(1, self.boxes * _LONG_PROGRAM**2 // nodes**2), self.sweeps)


@dataclass(frozen=True, eq=False)
class Outcome:
    """What was found for every goal (2 e: minus the expression e, 2 e + 1: the expression).

    bound, attained: guaranteed upper bounds, and guaranteed lower bounds of the value at ``points``
    noise: largest width of the enclosure of a value at a single point: what rounding alone costs
    finished: false where the budget ran out
    singular: goals without a finite bound, with a sub-box where that happens
    """

    bound: FloatArray
    attained: FloatArray
    points: FloatArray
    noise: FloatArray
    finished: BoolArray
    singular: dict[int, Interval]
    boxes: int
    sweeps: int


class Search:
    """A search that can be taken up again; rtol is relative to the width of the attained range."""

    def __init__(self, problem: Problem, rtol: float) -> None:
        goals = 2 * len(problem.gradient)
        self.problem, self.rtol = problem, rtol
        limited = np.isfinite(problem.lower) & np.isfinite(problem.upper)
        low = np.where(limited, problem.lower, 0.0)
        high = np.where(limited, problem.upper, 0.0)
        middle = np.clip(0.5 * low + 0.5 * high, problem.lower, problem.upper)
        self.middle = np.where(np.isfinite(middle), middle, 0.0)
        self.root_width = np.where(high > low, high - low, 1.0)
        self.best = np.full(goals, -np.inf)
        self.points = np.tile(self.middle, (goals, 1))
        self.closed = np.full(goals, -np.inf)
        self.noise = np.zeros(goals)
        self.singular: dict[int, Interval] = {}
        self.boxes = self.sweeps = 0
        source = problem.source
        long = len(problem.program.nodes) > _LONGEST_CURVED
        self.curvatures = None if source is None or long else Curvatures(source, problem.program)
        self.open = self.without_limits(self.initial())

    def initial(self) -> Rows:
        """Put the whole box up once for every goal, without the variables that do not matter."""
        problem = self.problem
        goal = np.arange(2 * len(problem.gradient))
        relevant = problem.relevant[goal // 2].T
        return Rows(
            goal,
            np.where(relevant, problem.lower[:, None], self.middle[:, None]),
            np.where(relevant, problem.upper[:, None], self.middle[:, None]),
            np.full(len(goal), np.inf),
        )

    # -- attained values ---------------------------------------------------------

    def record(self, rows: Rows, slopes: bool = False) -> RowRanges:
        """Evaluate at points (boxes without width), remember the best of every goal."""
        found = enclose_rows(self.problem, rows, slopes=slopes)
        usable = np.isfinite(found.lower) & np.isfinite(found.upper)
        # at a tie or a jump the width is the hull of several values, not what rounding costs
        smooth = usable & ~found.rough
        np.maximum.at(self.noise, rows.goal[smooth], (found.upper - found.lower)[smooth])
        order = np.flatnonzero(usable)[np.argsort(found.lower[usable], kind="stable")]
        # later assignments win, so the largest value of every goal is the one that stays
        better = order[found.lower[order] > self.best[rows.goal[order]]]
        self.points[rows.goal[better]] = rows.lower[:, better].T
        self.best[rows.goal[better]] = found.lower[better]
        return found

    def tolerance(self) -> FloatArray:
        """Return the gap that is good enough, goal by goal."""
        width = self.best[0::2] + self.best[1::2]
        share = 0.5 * self.rtol * np.where(np.isfinite(width), np.maximum(width, 0.0), 0.0)
        return np.maximum(np.repeat(share, 2), 4.0 * self.noise) + _TINY

    # -- one sweep ---------------------------------------------------------------

    def sweep(self, rows: Rows) -> Rows:
        """Bound rows, close what can be closed, return the halves of the others."""
        self.boxes += rows.count
        self.sweeps += 1
        found = enclose_rows(self.problem, rows, slopes=True)
        slopes = found.slope_lower, found.slope_upper
        curvatures = self.curvatures if self.sweeps > _FIRST_ORDER_SWEEPS else None
        rest, terms, at_centre = self.first_order(rows, found.upper, slopes, curvatures is not None)
        facets = self.problem.affine[rest.goal // 2].T.copy()
        if curvatures is not None:
            index = np.flatnonzero(self.is_open(rest) & ~found.rough)
            if len(index):
                some = slopes[0][:, index], slopes[1][:, index]
                better, terms[:, index], convex = self.second_order(
                    rest.take(index), some, at_centre.take(index), curvatures
                )
                facets[:, index] |= convex
                rest = rest.put(index, better)
        width = (rest.upper - rest.lower) / self.root_width[:, None]
        endless = ~np.isfinite(rest.bound) & (width.max(axis=0) < _SINGULAR_WIDTH)
        for k in np.flatnonzero(endless):
            self.singular.setdefault(int(rows.goal[k]), (rows.lower[:, k], rows.upper[:, k]))
        is_point = np.asarray((rest.upper <= rest.lower).all(axis=0))
        keep = self.close(rest, is_point)
        return self.split(rest.take(keep), terms[:, keep], width[:, keep], facets[:, keep])

    def first_order(
        self,
        rows: Rows,
        natural: FloatArray,
        slopes: Interval,
        with_slopes: bool,
    ) -> tuple[Rows, FloatArray, RowRanges]:
        """Shrink rows to facets and bound them by values and gradients.

        Also returns what was found at the centres, with gradients where they are asked for.
        """
        lower, upper = shrink(rows, *slopes)
        centre = np.clip(0.5 * (lower + upper), lower, upper)
        bound = np.fmin(rows.bound, natural)
        at_centre = self.record(Rows(rows.goal, centre, centre, bound), with_slopes)
        terms = mean_value_terms(lower, upper, centre, *slopes)
        bound = np.fmin(bound, _mean_value_bound(at_centre.upper, terms))
        return Rows(rows.goal, lower, upper, bound), terms, at_centre

    def second_order(
        self,
        rows: Rows,
        slopes: Interval,
        at: RowRanges,
        curvatures: Curvatures,
    ) -> tuple[Rows, FloatArray, BoolArray]:
        """Shrink and bound rows by second derivatives; tell in which variables goals bend up."""
        hessians = curvatures.enclose(rows.goal, rows.lower, rows.upper)
        centre = np.clip(0.5 * (rows.lower + rows.upper), rows.lower, rows.upper)
        ends = at.slope_lower, at.slope_upper
        slopes = sharpened_slopes(rows.lower, rows.upper, centre, ends, slopes, hessians)
        lower, upper = shrink(rows, *slopes)
        if (lower != rows.lower).any() or (upper != rows.upper).any():
            centre = np.clip(0.5 * (lower + upper), lower, upper)
            at = self.record(Rows(rows.goal, centre, centre, rows.bound), slopes=True)
            ends = at.slope_lower, at.slope_upper
        terms = mean_value_terms(lower, upper, centre, *slopes)
        bound = np.fmin(rows.bound, _mean_value_bound(at.upper, terms))
        bound = np.fmin(bound, up(at.upper + taylor_spread(lower, upper, centre, ends, hessians)))
        convex = (np.einsum("nii->in", hessians.lower) >= 0.0) & hessians.usable
        return Rows(rows.goal, lower, upper, bound), terms, convex

    def is_open(self, rows: Rows) -> BoolArray:
        """Where a row may still hold more than the best value of its goal."""
        return np.asarray(rows.bound > self.best[rows.goal] + self.tolerance()[rows.goal])

    def close(self, rows: Rows, settled: BoolArray | None = None) -> BoolArray:
        """Close rows that cannot improve their goal; tell which ones stay open."""
        done = ~self.is_open(rows)
        if settled is not None:
            done |= settled
        given_up = np.isin(rows.goal, list(self.singular))
        np.maximum.at(self.closed, rows.goal[done & ~given_up], rows.bound[done & ~given_up])
        return np.asarray(~(done | given_up))

    def split(self, rows: Rows, terms: FloatArray, width: FloatArray, to_facets: BoolArray) -> Rows:
        """Cut every row in two where its mean-value form loses most, a small batch in four."""
        if rows.count == 0:
            return rows
        rows, terms, width = self.cut(rows, terms, width, to_facets)
        if rows.count <= _SMALL_BATCH:
            rows, terms, width = self.cut(rows, terms, width, np.tile(to_facets, (1, 2)))
        return rows

    def cut(
        self, rows: Rows, terms: FloatArray, width: FloatArray, to_facets: BoolArray
    ) -> tuple[Rows, FloatArray, FloatArray]:
        """Cut rows in two; tell what is left of the terms and widths the cut went by."""
        usable = np.isfinite(terms).all(axis=0) & np.isfinite(rows.bound)
        score = np.where(usable, terms, width)
        axis = np.argmax(np.where(rows.upper > rows.lower, score, -1.0), axis=0)
        columns = np.arange(rows.count)
        facets = to_facets[axis, columns] & usable
        left = np.ones_like(width)
        left[axis, columns] = np.where(facets, 0.0, 0.5)
        with np.errstate(invalid="ignore"):
            terms, width = terms * left, width * left
        return rows.halves(axis, facets), np.tile(terms, (1, 2)), np.tile(width, (1, 2))

    # -- the loop ----------------------------------------------------------------

    def choose(self, rows: Rows) -> BoolArray:
        """Select the rows of the next sweep."""
        now = np.ones(rows.count, dtype=bool)
        singular = ~np.isfinite(rows.bound)
        if self.sweeps and singular.any():
            size = ((rows.upper - rows.lower) / self.root_width[:, None]).max(axis=0)
            now = ~np.isin(rows.goal, rows.goal[singular])
            for goal in np.unique(rows.goal[singular]):
                index = np.flatnonzero(singular & (rows.goal == goal))
                now[index[np.argsort(size[index], kind="stable")[:_SINGULAR_ROWS]]] = True
        index = np.flatnonzero(now)
        chunk = _CHUNK
        if self.sweeps >= _FIRST_ORDER_SWEEPS:
            chunk = min(chunk, max(256, _MATRIX_NUMBERS // len(rows.lower) ** 2))
        if len(index) > chunk:
            # in units of what each goal is asked for, or the goal of largest size gets everything
            excess = ((rows.bound - self.best[rows.goal]) / self.tolerance()[rows.goal])[index]
            now = np.zeros(rows.count, dtype=bool)
            now[index[np.argsort(-excess, kind="stable")[:chunk]]] = True
        return now

    def run(self, budget: Budget, expressions: Sequence[int] | None = None) -> Outcome:
        """Go on until all goals are settled or the budget, counted from the beginning, is spent."""
        some = range(len(self.problem.gradient)) if expressions is None else list(expressions)
        wanted = np.isin(self.open.goal // 2, some)
        rows, others = self.open.take(wanted), self.open.take(~wanted)
        with patience() as tell:
            while rows.count and self.boxes < budget.boxes and self.sweeps < budget.sweeps:
                now = self.choose(rows)
                rows = self.sweep(rows.take(now)).join(rows.take(~now))
                rows = rows.take(self.close(rows))
                tell(f"bounding: {self.boxes} boxes done, {rows.count} open")
        self.open = rows.join(others)
        return self.outcome()

    def outcome(self) -> Outcome:
        """Say what is known so far."""
        rows, bound = self.open, self.closed.copy()
        np.maximum.at(bound, rows.goal, rows.bound)
        bound[list(self.singular)] = np.inf
        finished = np.ones(len(bound), dtype=bool)
        finished[rows.goal] = False
        singular = dict(self.singular)
        for goal in np.flatnonzero(~np.isfinite(bound)).tolist():
            index = np.flatnonzero((rows.goal == goal) & ~np.isfinite(rows.bound))
            if len(index) and goal not in singular:
                size = ((rows.upper - rows.lower) / self.root_width[:, None])[:, index].max(axis=0)
                k = index[np.argmin(size)]
                singular[goal] = (rows.lower[:, k], rows.upper[:, k])
        return Outcome(
            bound,
            self.best.copy(),
            self.points.copy(),
            self.noise.copy(),
            finished,
            singular,
            self.boxes,
            self.sweeps,
        )

    def without_limits(self, rows: Rows) -> Rows:
        """Settle goals over an unbounded box by the natural extension, which is all there is."""
        endless = ~np.isfinite(rows.lower) | ~np.isfinite(rows.upper)
        endless = np.asarray(endless.any(axis=0))
        some = rows.take(endless)
        if some.count:
            at = np.tile(self.middle[:, None], some.count)
            self.record(replace(some, lower=at, upper=at))
            upper = enclose_rows(self.problem, some, slopes=False).upper
            for k, goal in enumerate(some.goal.tolist()):
                if np.isfinite(upper[k]):
                    self.closed[goal] = upper[k]
                else:
                    self.singular[goal] = (some.lower[:, k], some.upper[:, k])
        return rows.take(~endless)


def _mean_value_bound(at_centre: FloatArray, terms: FloatArray) -> FloatArray:
    with np.errstate(invalid="ignore", over="ignore"):
        # the sum of v nonnegative terms is off by less than v units in the last place
        spread = up(terms.sum(axis=0) * (1.0 + (len(terms) + 2) * 2.3e-16))
        return up(at_centre + spread)


def maximise(problem: Problem, rtol: float, budget: Budget) -> Outcome:
    """Bound every expression of a problem from both sides."""
    return Search(problem, rtol).run(budget)
