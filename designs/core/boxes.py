"""Boxes: cut into cells, and those of code, columns of lower and upper ends with conditions."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import reduce

import casadi as ca
import numpy as np

from obsynth.derive.rigour import Interval, outward
from obsynth.designs.core.limits import LIMITS
from obsynth.symbolic.arrays import FloatArray

_NUMBER = 2.0**120
"""Estimates beyond count as no number, in either precision."""


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
