"""Second derivatives over batches of boxes, and what they say about a largest value.

Where an expression is twice differentiable all over a box, an enclosure H of its second derivatives
gives three things that values and gradients do not: a gradient enclosure that is better by one
order (the mean-value form of every partial derivative), a bound of second order,
f(x) <= f(c) + f'(c) (x - c) + sup (x - c)' H (x - c) / 2, and, where H is negative definite, the
knowledge that the goal is concave, so that its tangent at any point bounds it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np

from obsynth.derive.intervals.program import Program
from obsynth.derive.intervals.rules import JUMPS
from obsynth.derive.intervals.search.batch import Entries, RowRanges, Rows, Source, radius_about
from obsynth.derive.rigour import Interval, down, up
from obsynth.derive.rigour.interval import divide, multiply, subtract
from obsynth.symbolic.arrays import BoolArray, FloatArray, IntArray

# Kinks, jumps and choices: CasADi's second derivative leaves out what happens at the switch. Of
# quotients with a removable singularity it knows nothing at the singularity.
_NOT_SMOOTH = (JUMPS - {"arctangent2"}) | {
    *("absolute", "minimum", "maximum", "meet", "select", "if_else_zero"),
    *("logical_not", "conjunction", "disjunction"),
}
_ULP = 2.3e-16
_TINY = 1e-300
# Steps of the climb to the top of a concave goal.
_CLIMB = 4


@dataclass(frozen=True, eq=False)
class Hessians:
    """Enclosures of second derivatives in the sign of the goals, symmetric; zero if not usable.

    A usable goal is twice differentiable all over the box, with finite bounds.
    """

    lower: FloatArray
    upper: FloatArray
    usable: BoolArray

    @property
    def size(self) -> FloatArray:
        """Largest magnitudes, shape (N, v, v)."""
        return np.maximum(np.abs(self.lower), np.abs(self.upper))

    def take(self, which: IntArray) -> "Hessians":
        """Return some of the rows."""
        return Hessians(self.lower[which], self.upper[which], self.usable[which])


class Curvatures:
    """Programs of the second derivatives of expressions, made when they are first asked for."""

    def __init__(self, source: Source, program: Program) -> None:
        self._source, self._program = source, program
        self._smooth: dict[int, bool] = {}
        self._made: list[Entries] = []
        self._where: dict[int, int] = {}

    def _is_smooth(self, expression: int) -> bool:
        if expression not in self._smooth:
            program = self._program
            used = {
                program.nodes[k].op
                for k in program.live([expression])
                if k not in program.constants
            }
            self._smooth[expression] = not used & _NOT_SMOOTH
        return self._smooth[expression]

    def _make(self, expressions: list[int]) -> None:
        """Make one program of the second derivatives of several expressions."""
        source = self._source
        m, v = source.column.numel(), source.variables.numel()
        outputs = np.full((m, v, v), -1, dtype=np.int64)
        entries = [ca.SX(0, 1)]
        count = 0
        for e in expressions:
            hessian = ca.triu(ca.hessian(source.column[e], source.variables)[0])
            rows, columns = hessian.sparsity().get_triplet()
            if rows:
                entries.append(ca.SX(hessian.nz[:]))
            for i, j in zip(rows, columns, strict=True):
                outputs[e, i, j] = outputs[e, j, i] = count
                count += 1
            self._where[e] = len(self._made)
        inputs = [source.variables, source.extra]
        function = ca.Function("curvature", inputs, [ca.vertcat(*entries)])
        program = Program.from_casadi(function, {1: source.constant_box})
        self._made.append(Entries(program, outputs.reshape(m, v * v)))

    def enclose(self, goal: IntArray, lower: FloatArray, upper: FloatArray) -> Hessians:
        """Enclose the second derivatives of every row's goal over its box."""
        v, n = lower.shape
        low, high = np.zeros((n, v, v)), np.zeros((n, v, v))
        entry = goal // 2
        smooth = [e for e in np.unique(entry).tolist() if self._is_smooth(e)]
        new = [e for e in smooth if e not in self._where]
        if new:
            self._make(new)
        usable = np.isin(entry, smooth)
        for number in sorted({self._where[e] for e in smooth}):
            here = [e for e in smooth if self._where[e] == number]
            index = np.flatnonzero(np.isin(entry, here))
            boxes = lower[:, index], upper[:, index]
            found = self._made[number].enclose(entry[index], *boxes, judged=False)
            low[index] = found.lower.T.reshape(-1, v, v)
            high[index] = found.upper.T.reshape(-1, v, v)
        usable &= (np.isfinite(low) & np.isfinite(high)).all(axis=(1, 2))
        low[~usable] = high[~usable] = 0.0
        minus = (goal % 2 == 0)[:, None, None]
        return Hessians(np.where(minus, -high, low), np.where(minus, -low, high), usable)


def sharpened_slopes(
    lower: FloatArray,
    upper: FloatArray,
    centre: FloatArray,
    at_centre: Interval,
    slopes: Interval,
    hessians: Hessians,
) -> Interval:
    """Intersect gradients with the mean-value form that starts from the centre.

    Shapes: at_centre, slopes (ndarray, ndarray), shape (v, N).
    """
    reach = np.einsum("nij,jn->in", hessians.size, radius_about(lower, upper, centre))
    reach = up(reach * (1.0 + (len(lower) + 4) * _ULP))
    reach[:, ~hessians.usable] = np.inf
    with np.errstate(invalid="ignore"):
        low, high = down(at_centre[0] - reach), up(at_centre[1] + reach)
    return np.fmax(slopes[0], low), np.fmin(slopes[1], high)


def taylor_spread(
    lower: FloatArray,
    upper: FloatArray,
    centre: FloatArray,
    at_centre: Interval,
    hessians: Hessians,
) -> FloatArray:
    """Bound the rise above the value at the centre by a quadratic, separately in every variable.

    Shapes: at_centre (ndarray, ndarray), shape (v, N).
    """
    radius = radius_about(lower, upper, centre)
    steep = np.maximum(np.abs(at_centre[0]), np.abs(at_centre[1]))
    bend = np.einsum("nii->in", hessians.upper)
    size = hessians.size
    with np.errstate(all="ignore"):
        # where the parabola bends down before the end of the box, its top; else its end, of which
        # the negative part takes away at most half
        top = (bend < 0.0) & (steep < -bend * radius)
        along = np.where(
            top, steep * steep / (-2.0 * bend), steep * radius + 0.5 * bend * radius * radius
        )
    along = np.where(radius > 0.0, np.maximum(along, 0.0), 0.0)
    np.einsum("nii->ni", size)[...] = 0.0
    across = 0.5 * np.einsum("nij,in,jn->n", size, radius, radius)
    total = (along.sum(axis=0) + across) * (1.0 + (len(lower) ** 2 + 64) * _ULP) + _TINY
    return np.where(hessians.usable, total, np.inf)


def is_concave(hessians: Hessians, free: BoolArray) -> BoolArray:
    """Prove goals strictly concave in their free variables, by elimination in intervals."""
    count = int(free.sum(axis=0).max(initial=0))
    order = np.argsort(~free.T, axis=1, kind="stable")[:, :count]
    inside = np.take_along_axis(free.T, order, axis=1)
    pick = np.arange(len(order))[:, None, None], order[:, :, None], order[:, None, :]
    low, high = -hessians.upper[pick], -hessians.lower[pick]
    outside = ~(inside[:, :, None] & inside[:, None, :])
    one = np.broadcast_to(np.eye(count), low.shape)
    low, high = np.where(outside, one, low), np.where(outside, one, high)
    proved = hessians.usable.copy()
    with np.errstate(all="ignore"):
        for k in range(count):
            proved &= low[:, k, k] > 0.0
            if not proved.any():
                break
            pivot = np.where(proved, low[:, k, k], 1.0), np.where(proved, high[:, k, k], 1.0)
            for i in range(k + 1, count):
                factor = divide((low[:, i, k], high[:, i, k]), pivot)
                for j in range(i, count):
                    product = multiply(factor, (low[:, j, k], high[:, j, k]))
                    entry = low[:, j, i], high[:, j, i]
                    low[:, j, i], high[:, j, i] = subtract(entry, product)
    return proved


def tangent_rise(
    lower: FloatArray,
    upper: FloatArray,
    centre: FloatArray,
    at_centre: Interval,
) -> FloatArray:
    """Bound the rise of tangents above their point of contact, over boxes.

    Shapes: at_centre (ndarray, ndarray), shape (v, N).
    """
    with np.errstate(invalid="ignore", over="ignore"):
        forwards = np.where(upper > centre, up(at_centre[1] * up(upper - centre)), 0.0)
        backwards = np.where(lower < centre, up(at_centre[0] * down(lower - centre)), 0.0)
    along = np.maximum(np.maximum(forwards, backwards), 0.0)
    return np.asarray(up(along.sum(axis=0) * (1.0 + (len(lower) + 2) * _ULP)))


def _newton(rows: Rows, hessians: Hessians, at: FloatArray, slope: FloatArray) -> FloatArray:
    """One step of Newton's method inside the boxes, along the variables that may still move."""
    pressed = ((at <= rows.lower) & (slope < 0.0)) | ((at >= rows.upper) & (slope > 0.0))
    still: BoolArray = (pressed | (rows.upper <= rows.lower)).T
    matrix = 0.5 * (hessians.lower + hessians.upper)
    matrix[still[:, :, None] | still[:, None, :]] = 0.0
    diagonal = np.einsum("nii->ni", matrix)
    diagonal[still] = -1.0
    diagonal[...] = np.where(diagonal < 0.0, diagonal, -1.0)
    try:
        step = np.linalg.solve(matrix, -np.where(still, 0.0, slope.T)[:, :, None])[:, :, 0].T
    except np.linalg.LinAlgError:
        return at
    moved = at + np.where(np.isfinite(step), step, 0.0)
    return np.clip(moved, rows.lower, rows.upper)


def concave_bounds(
    rows: Rows,
    hessians: Hessians,
    start: FloatArray,
    slope: FloatArray,
    evaluate: Callable[[Rows], RowRanges],
    is_open: Callable[[Rows], BoolArray],
) -> FloatArray:
    """Bound goals that are concave over their boxes: they lie below every tangent."""
    bound, index = rows.bound.copy(), np.arange(rows.count)
    at = start
    for _ in range(_CLIMB):
        at = _newton(rows, hessians, at, slope)
        found = evaluate(Rows(rows.goal, at, at, rows.bound))
        ends = found.slope_lower, found.slope_upper
        top = up(found.upper + tangent_rise(rows.lower, rows.upper, at, ends))
        bound[index] = np.fmin(bound[index], top)
        rows = Rows(rows.goal, rows.lower, rows.upper, bound[index])
        left = np.flatnonzero(is_open(rows))
        if not len(left):
            break
        slope = 0.5 * (ends[0] + ends[1])[:, left]
        rows, hessians, at, index = rows.take(left), hessians.take(left), at[:, left], index[left]
    return bound
