"""Rows of boxes, each with the goal it serves, and what one evaluation says about them."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import casadi as ca
import numpy as np

from obsynth.derive.intervals.program import OutputRanges, Program, enclose
from obsynth.derive.rigour import up
from obsynth.symbolic.arrays import BoolArray, FloatArray, IntArray

# Cost of running a program, in microseconds: of the call, per operation, per operation and box. It
# decides whether a sweep runs the shared program once or the parts of it one by one.
_COST_CALL, _COST_NODE, _COST_BOX = 110.0, 2.0, 0.011


@dataclass(frozen=True, eq=False)
class Source:
    """CasADi expressions behind a program, of the symbols of the box and enclosed constants."""

    column: ca.SX
    variables: ca.SX
    extra: ca.SX
    constant_box: list[tuple[float, float]]


class Entries:
    """Several outputs of a program, by position, for every one of many entries; -1 for none."""

    def __init__(self, program: Program, outputs: IntArray) -> None:
        self._program, self._outputs = program, outputs
        self._needs = [sorted({k for k in row if k >= 0}) for row in outputs.tolist()]
        self._alone: dict[int, int] = {}
        self._chosen: dict[tuple[int, ...], tuple[list[int], IntArray]] = {}

    def enclose(
        self, entry: IntArray, lower: FloatArray, upper: FloatArray, judged: bool
    ) -> OutputRanges:
        """Enclose, for every box, the outputs of its entry, zero for none; rough is the first."""
        counts = np.bincount(entry, minlength=len(self._needs))
        some = np.flatnonzero(counts).tolist()
        if self._together(some, counts):
            return self._enclose(tuple(some), entry, lower, upper, judged)
        k, n = self._outputs.shape[1], len(entry)
        result = OutputRanges(np.empty((k, n)), np.empty((k, n)), np.empty(n, dtype=bool))
        for e in some:
            index = np.flatnonzero(entry == e)
            part = self._enclose((e,), entry[index], lower[:, index], upper[:, index], judged)
            result.lower[:, index], result.upper[:, index] = part.lower, part.upper
            result.rough[index] = part.rough
        return result

    def _together(self, some: list[int], counts: IntArray) -> bool:
        """Whether the shared program costs less than the parts of it one by one."""
        rows = int(counts.sum())
        # nothing is gained by parts before the boxes weigh as much as the calls
        if len(some) == 1 or rows * _COST_BOX < _COST_NODE:
            return True
        for e in some:
            if e not in self._alone:
                self._alone[e] = len(self._program.live(self._needs[e]))
        one_by_one = sum(_cost(self._alone[e], int(counts[e])) for e in some)
        return _cost(len(self._program.live(self._choice(tuple(some))[0])), rows) <= one_by_one

    def _choice(self, some: tuple[int, ...]) -> tuple[list[int], IntArray]:
        """List the outputs of some entries, first the first ones, and where they stand."""
        if some not in self._chosen:
            first = list(dict.fromkeys(self._outputs[list(some), 0].tolist()))
            others = {k for e in some for k in self._needs[e]}
            chosen = first + sorted(others.difference(first)) if -1 not in first else sorted(others)
            row = np.zeros(len(self._program.outputs) + 1, dtype=np.int64)
            row[chosen] = np.arange(len(chosen))
            self._chosen[some] = chosen, row
        return self._chosen[some]

    def _enclose(
        self,
        some: tuple[int, ...],
        entry: IntArray,
        lower: FloatArray,
        upper: FloatArray,
        judged: bool,
    ) -> OutputRanges:
        chosen, row = self._choice(some)
        found = enclose(self._program, lower, upper, chosen, len(some) if judged else 0)
        wanted = self._outputs[entry].T
        place, present = (row[wanted], np.arange(len(entry))), wanted >= 0
        return OutputRanges(
            np.where(present, found.lower[place], 0.0),
            np.where(present, found.upper[place], 0.0),
            found.rough[place[0][0], place[1]],
        )


def _cost(nodes: int, rows: int) -> float:
    return _COST_CALL + nodes * (_COST_NODE + _COST_BOX * rows)


@dataclass(frozen=True, eq=False)
class Problem:
    """Expressions with their gradients over one box.

    program: outputs: first the expressions, then the structurally nonzero partial derivatives
    gradient: position of a partial derivative among the outputs; -1 where it is zero
    relevant, affine: whether an expression depends on a variable, and is affine in it with the
        others held
    source: where it comes from, for those who need more derivatives or other variables
    """

    program: Program
    gradient: IntArray
    relevant: BoolArray
    affine: BoolArray
    lower: FloatArray
    upper: FloatArray
    source: Source | None = None

    @cached_property
    def values(self) -> Entries:
        """The expressions alone."""
        return Entries(self.program, np.arange(len(self.gradient))[:, None])

    @cached_property
    def with_slopes(self) -> Entries:
        """The expressions, each followed by its partial derivatives."""
        values = np.arange(len(self.gradient))[:, None]
        return Entries(self.program, np.concatenate([values, self.gradient], axis=1))


class Batch:
    """A dataclass of arrays with one member per element of their last axis."""

    def take(self, which: BoolArray | IntArray) -> Self:
        """Return some of the members."""
        return type(self)(*(array[..., which] for array in vars(self).values()))

    def join(self, other: Self) -> Self:
        """Return these members and others."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return type(self)(*(np.concatenate(pair, axis=-1) for pair in pairs))


@dataclass(frozen=True, eq=False)
class Rows(Batch):
    """A batch of boxes: goal 2 e for the smallest value of expression e, 2 e + 1 for the other."""

    goal: IntArray
    lower: FloatArray
    upper: FloatArray
    bound: FloatArray

    def put(self, which: IntArray, other: "Rows") -> "Rows":
        """Return these rows with some of them replaced."""
        lower, upper, bound = self.lower.copy(), self.upper.copy(), self.bound.copy()
        lower[:, which], upper[:, which], bound[which] = other.lower, other.upper, other.bound
        return Rows(self.goal, lower, upper, bound)

    def halves(self, axis: IntArray, facets: BoolArray | bool = False) -> "Rows":
        """Return every box cut along an axis, the lower parts first; or two facets of it."""
        columns = np.arange(self.count)
        low, high = self.lower[axis, columns], self.upper[axis, columns]
        middle = np.clip(0.5 * low + 0.5 * high, low, high)
        upper, lower = self.upper.copy(), self.lower.copy()
        upper[axis, columns] = np.where(facets, low, middle)
        lower[axis, columns] = np.where(facets, high, middle)
        return replace(self, upper=upper).join(replace(self, lower=lower))

    @property
    def count(self) -> int:
        """Number of rows."""
        return len(self.goal)


@dataclass(frozen=True, eq=False)
class RowRanges(Batch):
    """Value and gradient of every row's goal: of the expression or of its negative.

    The gradient is the whole line where the expression is rough, may jump or be undefined in the
    box, and zero where none was asked for.
    """

    lower: FloatArray
    upper: FloatArray
    slope_lower: FloatArray
    slope_upper: FloatArray
    rough: BoolArray


def enclose_rows(problem: Problem, rows: Rows, slopes: bool) -> RowRanges:
    """Enclose value and, where asked, gradient for every row."""
    entry = rows.goal // 2
    entries = problem.with_slopes if slopes else problem.values
    found = entries.enclose(entry, rows.lower, rows.upper, judged=True)
    low = rows.goal % 2 == 0
    lower, upper = (
        np.where(low, -found.upper, found.lower),
        np.where(low, -found.lower, found.upper),
    )
    slope_lower, slope_upper = lower[1:], upper[1:]
    if not slopes:
        slope_lower, slope_upper = np.zeros_like(rows.lower), np.zeros_like(rows.lower)
    elif found.rough.any():
        touched = problem.relevant[entry].T & found.rough
        slope_lower[touched], slope_upper[touched] = -np.inf, np.inf
    return RowRanges(lower[0], upper[0], slope_lower, slope_upper, found.rough)


def shrink(
    rows: Rows, slope_lower: FloatArray, slope_upper: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Reduce boxes to the facet where a monotone goal has its largest value."""
    falls = slope_upper <= 0.0
    rises = (slope_lower >= 0.0) & ~falls
    return np.where(rises, rows.upper, rows.lower), np.where(falls, rows.lower, rows.upper)


def radius_about(lower: FloatArray, upper: FloatArray, centre: FloatArray) -> FloatArray:
    """Return how far boxes extend from points in them, up."""
    return np.where(upper > lower, up(np.maximum(upper - centre, centre - lower)), 0.0)


def mean_value_terms(
    lower: FloatArray,
    upper: FloatArray,
    centre: FloatArray,
    slope_lower: FloatArray,
    slope_upper: FloatArray,
) -> FloatArray:
    """Bound |gradient| times distance from the centre, variable by variable."""
    radius = radius_about(lower, upper, centre)
    size = np.maximum(np.abs(slope_lower), np.abs(slope_upper))
    with np.errstate(invalid="ignore", over="ignore"):
        return np.where(radius > 0.0, up(size * radius), 0.0)
