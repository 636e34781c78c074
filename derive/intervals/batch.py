"""Rows of boxes, each with the goal it serves, and what one evaluation says about them."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from obsynth.derive.intervals.arithmetic import Array, Mask, up
from obsynth.derive.intervals.evaluate import enclose
from obsynth.derive.intervals.program import Program

__all__ = ["Problem", "RowRanges", "Rows", "Source", "enclose_rows", "mean_value_terms", "shrink"]

Indices = NDArray[np.int64]

# Cost of one operation on a batch, in microseconds: a fixed part and a part per box. Their ratio
# decides whether a sweep runs the shared program once or the parts of it one by one.
_COST_FIXED, _COST_PER_BOX = 12.0, 0.05


@dataclass(frozen=True, eq=False)
class Source:
    """CasADi expressions behind a program.

    Attributes
    ----------
    column : casadi.SX, shape (m, 1)
        The expressions.
    variables, extra : casadi.SX
        Symbols of the box and of the constants.
    constant_box : list of (float, float)
        Enclosures of the constants.
    """

    column: ca.SX
    variables: ca.SX
    extra: ca.SX
    constant_box: list[tuple[float, float]]


@dataclass(frozen=True, eq=False)
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
    source : Source or None
        Where it comes from, for those who need more derivatives or other variables.
    """

    program: Program
    gradient: Indices
    relevant: Mask
    affine: Mask
    lower: Array
    upper: Array
    source: Source | None = None


@dataclass(frozen=True, eq=False)
class Rows:
    """A batch of boxes.

    Attributes
    ----------
    goal : ndarray of int, shape (N,)
        2 e for the smallest value of the expression e, 2 e + 1 for the largest.
    lower, upper : ndarray, shape (v, N)
        The boxes.
    bound : ndarray, shape (N,)
        Upper bound of the goal's expression over the box, so far.
    """

    goal: Indices
    lower: Array
    upper: Array
    bound: Array

    def take(self, which: Mask | Indices) -> "Rows":
        """Return some of the rows."""
        return Rows(self.goal[which], self.lower[:, which], self.upper[:, which], self.bound[which])

    def join(self, other: "Rows") -> "Rows":
        """Return these rows and others."""
        return Rows(
            np.concatenate([self.goal, other.goal]),
            np.concatenate([self.lower, other.lower], axis=1),
            np.concatenate([self.upper, other.upper], axis=1),
            np.concatenate([self.bound, other.bound]),
        )

    def put(self, which: Indices, other: "Rows") -> "Rows":
        """Return these rows with some of them replaced."""
        lower, upper, bound = self.lower.copy(), self.upper.copy(), self.bound.copy()
        lower[:, which], upper[:, which], bound[which] = other.lower, other.upper, other.bound
        return Rows(self.goal, lower, upper, bound)

    @property
    def count(self) -> int:
        """Number of rows."""
        return len(self.goal)


@dataclass(frozen=True, eq=False)
class RowRanges:
    """Value and gradient of every row's goal: of the expression or of its negative.

    Attributes
    ----------
    lower, upper : ndarray, shape (N,)
        Natural enclosure of the value.
    slope_lower, slope_upper : ndarray, shape (v, N)
        Enclosure of the gradient; the whole line where the expression may jump or be undefined
        in the box, zero where no gradient was asked for.
    rough : ndarray of bool, shape (N,)
        Where the expression may jump or be undefined in the box.
    """

    lower: Array
    upper: Array
    slope_lower: Array
    slope_upper: Array
    rough: Mask


def _batches(
    problem: Problem, entry: Indices, slopes: bool
) -> list[tuple[list[int], Indices, list[int]]]:
    """Group rows so that one sweep costs least: all with the shared program, or one by one."""
    entries, counts = np.unique(entry, return_counts=True)

    def outputs(some: Indices) -> list[int]:
        chosen = [int(e) for e in some]
        if slopes:
            chosen += sorted({k for k in problem.gradient[some].ravel().tolist() if k >= 0})
        return chosen

    def cost(chosen: list[int], rows: int) -> float:
        return len(problem.program.live(chosen)) * (_COST_FIXED + _COST_PER_BOX * rows)

    shared = outputs(entries)
    parts = [outputs(np.array([e])) for e in entries]
    one_by_one = sum(cost(p, int(c)) for p, c in zip(parts, counts, strict=True))
    if cost(shared, len(entry)) <= one_by_one:
        return [(shared, np.arange(len(entry)), entries.tolist())]
    return [(p, np.flatnonzero(entry == e), [int(e)]) for p, e in zip(parts, entries, strict=True)]


def enclose_rows(problem: Problem, rows: Rows, slopes: bool) -> RowRanges:
    """Enclose value and, where asked, gradient for every row.

    Parameters
    ----------
    problem : Problem
        The expressions.
    rows : Rows
        Boxes and goals.
    slopes : bool
        Whether the gradient is needed.

    Returns
    -------
    RowRanges
        In the sign of the goals, so that every row asks for a largest value.
    """
    v, n = rows.lower.shape
    entry = rows.goal // 2
    lo, hi = np.empty(n), np.empty(n)
    slope_lo, slope_hi = np.zeros((v, n)), np.zeros((v, n))
    rough = np.zeros(n, dtype=bool)
    for chosen, index, entries in _batches(problem, entry, slopes):
        found = enclose(
            problem.program,
            rows.lower[:, index],
            rows.upper[:, index],
            chosen,
            len(entries),
        )
        position = {k: row for row, k in enumerate(chosen)}
        for e in entries:
            row = position[e]
            inside = np.flatnonzero(entry[index] == e)
            target = index[inside]
            lo[target], hi[target] = found.lower[row, inside], found.upper[row, inside]
            rough[target] = found.rough[row, inside]
            if not slopes:
                continue
            for j, k in enumerate(problem.gradient[e].tolist()):
                if k >= 0:
                    slope_lo[j, target] = found.lower[position[k], inside]
                    slope_hi[j, target] = found.upper[position[k], inside]
            touched = np.ix_(problem.relevant[e], target[rough[target]])
            slope_lo[touched], slope_hi[touched] = -np.inf, np.inf
    low = rows.goal % 2 == 0
    return RowRanges(
        np.where(low, -hi, lo),
        np.where(low, -lo, hi),
        np.where(low, -slope_hi, slope_lo),
        np.where(low, -slope_lo, slope_hi),
        rough,
    )


def shrink(rows: Rows, slope_lower: Array, slope_upper: Array) -> tuple[Array, Array]:
    """Reduce boxes to the facet where a monotone goal has its largest value.

    Parameters
    ----------
    rows : Rows
        Boxes.
    slope_lower, slope_upper : ndarray, shape (v, N)
        Enclosure of the gradient over them.

    Returns
    -------
    (ndarray, ndarray), shape (v, N)
        Lower and upper ends: the upper facet in variables in which the goal rises, the lower one
        where it falls or does not change.
    """
    falls = slope_upper <= 0.0
    rises = (slope_lower >= 0.0) & ~falls
    return np.where(rises, rows.upper, rows.lower), np.where(falls, rows.lower, rows.upper)


def mean_value_terms(
    lower: Array, upper: Array, centre: Array, slope_lower: Array, slope_upper: Array
) -> Array:
    """Bound |gradient| times distance from the centre, variable by variable.

    Parameters
    ----------
    lower, upper, centre : ndarray, shape (v, N)
        Boxes and a point in each.
    slope_lower, slope_upper : ndarray, shape (v, N)
        Enclosure of the gradient over the boxes.

    Returns
    -------
    ndarray, shape (v, N)
        Rounded up; zero for variables without width, infinite where the gradient is unknown.
    """
    radius = np.where(upper > lower, up(np.maximum(upper - centre, centre - lower)), 0.0)
    size = np.maximum(np.abs(slope_lower), np.abs(slope_upper))
    with np.errstate(invalid="ignore", over="ignore"):
        return np.where(radius > 0.0, up(size * radius), 0.0)
