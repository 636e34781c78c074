"""Second derivatives over batches of boxes, and what they say about a largest value.

Where an expression is twice differentiable all over a box, an enclosure H of its second derivatives
gives two things that values and gradients do not: a gradient enclosure that is better by one order
(the mean-value form of every partial derivative), and a bound of second order,
f(x) <= f(c) + f'(c) (x - c) + sup (x - c)' H (x - c) / 2.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from obsynth.derive.intervals.program import Program
from obsynth.derive.intervals.rules import JUMPS
from obsynth.derive.intervals.search.batch import Entries, Source, radius_about
from obsynth.derive.rigour import Interval, down, up
from obsynth.symbolic.arrays import BoolArray, FloatArray, IntArray

# Kinks, jumps and choices: CasADi's second derivative leaves out what happens at the switch. Of
# quotients with a removable singularity it knows nothing at the singularity.
_NOT_SMOOTH = (JUMPS - {"arctangent2"}) | {
    *("absolute", "minimum", "maximum", "meet", "select", "if_else_zero"),
    *("logical_not", "conjunction", "disjunction"),
}
_ULP = 2.3e-16
_TINY = 1e-300


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
