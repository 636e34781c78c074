"""Half widths that a core carries from call to call, and when they have settled.

``s+ = decay s + offset``, all nonnegative, and half widths ``reach s + add``. The map is monotone:
from an s that it maps below itself nothing that follows exceeds what that s says.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import casadi as ca
import numpy as np

from obsynth.designs.core.outwards import Rounding
from obsynth.symbolic.arrays import FloatArray

ROUND_UP = 1.0 + 2.0**-50
# Of an estimate, in doubles: covers the rounding of estimate - half and estimate + half.
ULPS = 2.0**-50
# Above the relative rounding error of the few dozen operations of each formula here, in doubles.
UP = 1.0 + 2.0**-44
# Far below the rounding of estimates in either precision, which half widths count.
UNDERFLOW = 2.0**-900
SETTLED = 0.01
"""Half widths have settled where they stay within this share of their limits."""
MOST_CALLS = 100_000


def above(precision: str, terms: int) -> float:
    """Return a factor above what rounding numbers of nonnegative terms that often takes in code."""
    return max(UP, 1.0 + (terms + 8) * Rounding(precision).step)


def shaken(gamma: float, rho: float) -> tuple[float, float]:
    """Return decay and offset of V where ``sqrt V+ <= sqrt((1 - gamma) V + gamma) + rho``.

    With W = (1 - gamma) V + gamma, ``2 rho sqrt(W) <= rho (W / a + a)`` for every a, exact where V
    stands still for the a taken.
    """
    kept = 1.0 - gamma
    a = (kept * rho + float(np.hypot(kept * rho, np.sqrt(gamma * (kept * rho**2 + gamma))))) / gamma
    grown = 1.0 + rho / a
    return kept * grown * UP, (gamma * grown + rho * a + rho**2) * UP


@dataclass(frozen=True, eq=False)
class Running:
    """One recursion of s (k,): decay (k, k), offset (k,), reach (N, k), add (N,).

    root: the half widths are ``sqrt(reach s) + add``, for ellipsoids, where s bounds V
    """

    decay: FloatArray
    offset: FloatArray
    reach: FloatArray
    add: FloatArray
    root: bool
    precision: str = "double"

    @property
    def more(self) -> float:
        """A factor above what rounding takes of these in code; 1 in doubles: they have it."""
        return 1.0 if self.precision == "double" else above(self.precision, len(self.decay))

    @property
    def limit(self) -> FloatArray:
        """What s goes to, (k,)."""
        decay, offset = self.decay * self.more**2, self.offset * self.more**2
        return np.asarray(np.linalg.solve(np.eye(len(decay)) - decay, offset))

    @property
    def steady(self) -> FloatArray:
        """The half widths after long, (N,)."""
        return self.half_widths(self.limit)

    def half_widths(self, s: FloatArray) -> FloatArray:
        """Return the half widths that belong to a value of s."""
        inner = self.reach @ s * self.more**2
        inner = np.sqrt(inner) if self.root else inner
        return np.asarray(inner * ROUND_UP + self.add * self.more**2)

    def falls(self, s: FloatArray) -> bool:
        """Whether s is mapped below itself, however that is rounded; underflow does not count."""
        return bool(np.all(self.next(s) <= s + UNDERFLOW))

    def next(self, s: FloatArray) -> FloatArray:
        """Return what is not below the next s of the code."""
        return np.asarray((self.decay @ s + self.offset) * (UP * self.more**2))


def all_around(bounds: Sequence[Running], s: ca.SX, estimate: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return the smallest half widths of bounds that all hold, and their next s, stacked."""
    ends = np.cumsum([0, *(len(bound.offset) for bound in bounds)]).tolist()
    halves, moved, precision = [], [], bounds[0].precision
    for bound, part in zip(bounds, ca.vertsplit(s, ends), strict=True):
        numbers = (bound.reach, bound.decay, bound.add[:, None], bound.offset[:, None])
        reach, decay, add, offset = (ca.sparsify(ca.DM(part * bound.more)) for part in numbers)
        inner = reach @ part
        halves.append((ca.sqrt(inner) if bound.root else inner) * ROUND_UP + ca.densify(add))
        moved.append(decay @ part + offset if bound.offset.any() else decay @ part)
    ulps = ULPS * Rounding(precision).step / Rounding().step
    return reduce(ca.fmin, halves) + ulps * ca.fabs(estimate), ca.vertcat(*moved)


def all_steady(bounds: Sequence[Running]) -> FloatArray:
    """Return the half widths after long, the smallest of bounds that all hold, (N,)."""
    return _least(bounds, [bound.limit for bound in bounds])


def settle(
    bounds: Sequence[Running], first: FloatArray, calls: int | None
) -> tuple[int, FloatArray]:
    """Return after how many calls half widths stay within 1 % of limits, and the largest then.

    They are the smallest of bounds that all hold, begun from `first`, stacked. With `calls` given,
    the largest from so many on. Infinite where it is not shown that they stay below anything.
    """
    s = np.split(first, np.cumsum([len(bound.offset) for bound in bounds])[:-1])
    limits = [bound.limit * (1.0 + 2.0**-20) for bound in bounds]
    near = all_steady(bounds) * (1.0 + SETTLED)
    since, largest = 0, np.zeros(len(near))
    for k in range(MOST_CALLS + 1):
        tops = [np.maximum(*pair) for pair in zip(s, limits, strict=True)]
        now = _least(bounds, tops)
        if k < MOST_CALLS and (np.any(now > near) if calls is None else k < calls):
            since = k + 1
        else:
            largest = np.maximum(largest, now)
            if all(bound.falls(top) for bound, top in zip(bounds, tops, strict=True)):
                return since, largest * (1.0 + 2.0**-30)
        pairs = zip(bounds, s, strict=True)
        s = [bound.next(part) for bound, part in pairs]
    return since, np.full(len(near), np.inf)


def _least(bounds: Sequence[Running], s: Sequence[FloatArray]) -> FloatArray:
    pairs = zip(bounds, s, strict=True)
    return np.asarray(np.min([bound.half_widths(part) for bound, part in pairs], axis=0))
