"""Intervals of code, and how their rounded ends step outwards in a precision (docs/step.md).

There are no infinities: among numbers `FAR` stands for them, in code `Rounding.far` for signals and
`Rounding.largest` for nodes.
"""

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from obsynth.derive.rigour.interval import UNIT, outward
from obsynth.designs.core.limits import FAR, LIMITS, Limits


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
