"""Boxes and intervals of code, whose rounded ends step outwards in a precision (docs/step.md).

There are no infinities: among numbers `FAR` stands for them, in code `Rounding.far` for signals and
`Rounding.largest` for nodes.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import NamedTuple

import casadi as ca
import numpy as np

from obsynth.derive.rigour import Interval, outward
from obsynth.derive.rigour.interval import UNIT
from obsynth.symbolic.arrays import FloatArray

FAR = 1e100
"""Numbers from which on a signal is not bounded at all, whatever the precision of code."""
_NUMBER = 2.0**120
"""Estimates beyond count as no number, in either precision."""


class Limits(NamedTuple):
    """Numbers that a precision has room for, each small enough for products of three of the next.

    tiny: above what underflow takes
    far: ends of signals that are not bounded; the truth is not beyond
    finite: what is larger counts as no number; CasADi folds ``y == y`` to 1, so size is what tells
    huge: widths of sets from which on they say nothing; declared ranges are within
    largest: ends of nodes that are not bounded
    angle: from which on sine and cosine are not followed; functions of single precision give no
        number beyond
    """

    tiny: float
    far: float
    finite: float
    huge: float
    largest: float
    angle: float


LIMITS = {
    "double": Limits(2.0**-1021, FAR, 1e90, 1e50, FAR, 1e8),
    "single": Limits(2.0**-125, 2.0**40, 2.0**39, 2.0**36, 2.0**120, 6433.0),
}


@dataclass(frozen=True, eq=False)
class Lifted:
    """An interval of code: lower and upper end, and the numbers low and high that hold both."""

    lower: ca.SX
    upper: ca.SX
    low: float = -FAR
    high: float = FAR

    @classmethod
    def number(cls, low: float, high: float | None = None) -> "Lifted":
        """Return a constant interval."""
        high = low if high is None else high
        return cls(ca.SX(low), ca.SX(high), low, high)

    @classmethod
    def point(cls, value: ca.SX, low: float = -FAR, high: float = FAR) -> "Lifted":
        """Return the interval of one value."""
        return cls(value, value, low, high)

    @property
    def magnitude(self) -> ca.SX:
        """The largest absolute value."""
        if self.low >= 0.0:
            return self.upper
        return -self.lower if self.high <= 0.0 else ca.fmax(-self.lower, self.upper)


@dataclass(frozen=True)
class Rounding:
    """How results step outwards in a precision."""

    precision: str = "double"

    @property
    def limits(self) -> Limits:
        """Numbers that stand for what has no bound."""
        return LIMITS[self.precision]

    @property
    def step(self) -> float:
        """Relative step over one rounding, 2 u."""
        return 2.0 * UNIT[self.precision]

    @property
    def tiny(self) -> float:
        """Above what underflow takes."""
        return self.limits.tiny

    def number(self, low: float, high: float, far: float | None = None) -> Lifted:
        """Return a constant interval with ends of the precision, `far` for what has no bound."""
        far = self.limits.largest if far is None else far
        ends = np.where(
            np.abs([low, high]) < min(FAR, self.limits.largest), [low, high], [-far, far]
        )
        lower, upper = self.around(*ends.tolist())
        return Lifted(ca.SX(lower), ca.SX(upper), low, high)

    def around(self, low: float, high: float) -> tuple[float, float]:
        """Return numbers of the precision around an interval of numbers."""
        lower, upper = outward(np.array([[low, high]]), self.precision)[0].tolist()
        return lower, upper

    def signal(self, value: Lifted) -> Lifted:
        """Return a variable; one between numbers has ends of the precision."""
        if not (value.lower.is_constant() and value.upper.is_constant()):
            return value
        ends = self.number(float(value.lower), float(value.upper), self.limits.far)
        return replace(ends, low=value.low, high=value.high)

    def down(self, value: ca.SX, units: float = 1.0, tiny: bool = False) -> ca.SX:
        """Return a number below a value whose rounding error is at most that many half units."""
        stepped = value - (units * self.step) * ca.fabs(value)
        return stepped - self.tiny if tiny else stepped

    def up(self, value: ca.SX, units: float = 1.0, tiny: bool = False) -> ca.SX:
        """Return a number above such a value."""
        stepped = value + (units * self.step) * ca.fabs(value)
        return stepped + self.tiny if tiny else stepped

    def interval(
        self,
        lower: ca.SX,
        upper: ca.SX,
        low: float,
        high: float,
        units: float = 1.0,
        tiny: bool = True,
    ) -> Lifted:
        """Return the interval around rounded ends; ends below zero by rounding alone are zero."""
        share, least = units * self.step, self.tiny if tiny else 0.0
        below, above = self.down(lower, units, tiny), self.up(upper, units, tiny)
        if low >= 0.0 or high <= 0.0:  # one factor where the sign is known
            sides = (1.0 - share, 1.0 + share)[:: 1 if low >= 0.0 else -1]
            below, above = sides[0] * lower - least, sides[1] * upper + least
        if low == 0.0:
            below = ca.fmax(below, 0.0)
        if high == 0.0:
            above = ca.fmin(above, 0.0)
        return Lifted(below, above, low, high)


def cut_box(
    box: FloatArray, cells: int, along: Sequence[int] | None = None, most: int = 16
) -> Interval:
    """Cut sides of a box, (n, 2), into about so many cells in all: ends (n, N), `most` per side."""
    sides = [*range(len(box))] if along is None else [*along]
    pieces = max(1, min(most, int(cells ** (1.0 / max(len(sides), 1)))))
    edges = np.linspace(box[sides, 0], box[sides, 1], pieces + 1)
    edges[-1] = box[sides, 1]
    count, rows = pieces ** len(sides), np.arange(len(sides))[:, None]
    index = np.indices((pieces,) * len(sides)).reshape(len(sides), count)
    lower, upper = (np.repeat(box[:, [side]], count, axis=1) for side in (0, 1))
    lower[sides], upper[sides] = edges[index, rows], edges[index + 1, rows]
    return lower, upper


def every(conditions: Iterable[ca.SX]) -> ca.SX:
    """Return 1 where all conditions hold, else 0."""
    return reduce(ca.logic_and, conditions, ca.SX(1))


def some(conditions: Iterable[ca.SX]) -> ca.SX:
    """Return 1 where a condition holds, else 0."""
    return reduce(ca.logic_or, conditions, ca.SX(0))


def column(entries: Iterable[ca.SX]) -> ca.SX:
    """Return a column of entries, of which there may be none."""
    given = [*entries]
    return ca.vertcat(*given) if given else ca.SX(0, 1)


def select(condition: ca.SX, then: ca.SX, otherwise: ca.SX) -> ca.SX:
    """Return one of two vectors, entry by entry, without letting infinities of the other one in."""
    return column(ca.if_else(condition, then[i], otherwise[i]) for i in range(then.numel()))


def near_box(box: FloatArray, precision: str) -> FloatArray:
    """Return a box, (n, 2), with what stands for no bound in code in place of such ends."""
    near: FloatArray = np.clip(box, -LIMITS[precision].far, LIMITS[precision].far)
    return near


@dataclass(frozen=True, eq=False)
class Ends:
    """A box of code: lower and upper ends, columns."""

    lower: ca.SX
    upper: ca.SX

    @classmethod
    def of(cls, box: FloatArray, precision: str = "double") -> "Ends":
        """Return a box of numbers, shape (n, 2), its ends outside in the precision."""
        near = outward(near_box(box, precision), precision)
        return cls(ca.SX(ca.DM(near[:, 0])), ca.SX(ca.DM(near[:, 1])))

    @classmethod
    def unbounded(cls, n: int, precision: str = "double") -> "Ends":
        """Return a box that holds everything."""
        return cls.of(np.full((n, 2), [-np.inf, np.inf]), precision)

    def middle(self, precision: str = "double") -> ca.SX:
        """Return the middle, rounded to any side; zero where there is no bound."""
        middle, width = 0.5 * self.lower + 0.5 * self.upper, self.upper - self.lower
        far = LIMITS[precision].far
        return column(ca.if_else(width[i] < far, middle[i], 0.0) for i in range(middle.numel()))

    def meet(self, other: "Ends") -> "Ends":
        """Cut with another box; an end of it that is not a number cuts nothing."""
        return Ends(_larger(self.lower, other.lower), _smaller(self.upper, other.upper))

    def empty(self) -> ca.SX:
        """Return 1 where some coordinate has nothing left, or is not a number."""
        rows = range(self.lower.numel())
        return some(ca.logic_not(self.lower[i] <= self.upper[i]) for i in rows)

    def nearest(self, value: ca.SX) -> ca.SX:
        """Return the nearest point of the box; of zero for what is not a number."""
        rows = range(value.numel())
        numbers = [ca.if_else(ca.fabs(value[i]) <= _NUMBER, value[i], 0.0) for i in rows]
        return column(ca.fmin(ca.fmax(numbers[i], self.lower[i]), self.upper[i]) for i in rows)

    def where(self, condition: ca.SX, other: "Ends") -> "Ends":
        """Return this box where a condition holds, the other elsewhere."""
        return Ends(
            select(condition, self.lower, other.lower), select(condition, self.upper, other.upper)
        )


def _larger(a: ca.SX, b: ca.SX) -> ca.SX:
    return ca.vertcat(*(ca.if_else(b[i] > a[i], b[i], a[i]) for i in range(a.numel())))


def _smaller(a: ca.SX, b: ca.SX) -> ca.SX:
    return ca.vertcat(*(ca.if_else(b[i] < a[i], b[i], a[i]) for i in range(a.numel())))
