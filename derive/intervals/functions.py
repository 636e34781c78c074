"""Ranges of elementary functions over batches of intervals.

Extrema and poles are asked for with a margin that errs on the wide side. What the mathematics
library returns is pushed outwards by `ULPS` units in the last place: C libraries are good to one or
two, NumPy's vectorised versions to four.
"""

from collections.abc import Callable
from functools import reduce

import numpy as np

from obsynth.derive.rigour import Interval, up
from obsynth.derive.rigour.interval import absolute, hull, negate, widen
from obsynth.symbolic.arrays import BoolArray, FloatArray

ULPS = 8
_HALF_PI = 0.5 * np.pi
_TWO_PI = 2.0 * np.pi
_LARGE_ANGLE = 1e8


def increasing(
    function: Callable[[FloatArray], FloatArray],
    bottom: float = -np.inf,
    top: float = np.inf,
    domain: tuple[float, float] = (-np.inf, np.inf),
) -> Callable[[Interval], Interval]:
    """Make the range rule of an increasing function. Shapes: domain (float, float)."""

    def rule(a: Interval) -> Interval:
        lo, hi = widen((function(a[0]), function(a[1])), ULPS)
        lo, hi = np.fmax(lo, bottom), np.fmin(hi, top)
        if domain != (-np.inf, np.inf):
            outside = (a[0] < domain[0]) | (a[1] > domain[1])
            lo, hi = np.where(outside, np.nan, lo), np.where(outside, np.nan, hi)
        return lo, hi

    return rule


def _crossings(a: Interval, phase: float, period: float) -> BoolArray:
    """Tell whether some phase + k period may lie inside; true rather than wrong."""
    margin = 1e-15 * (np.abs(a[0]) + np.abs(a[1]) + 4.0)
    first = np.ceil((a[0] - phase - margin) / period)
    return np.asarray(first * period <= a[1] - phase + margin)


def _wave(
    function: Callable[[FloatArray], FloatArray], a: Interval, crest: float, trough: float
) -> Interval:
    left, right = function(a[0]), function(a[1])
    lo, hi = widen((np.minimum(left, right), np.maximum(left, right)), ULPS)
    unknown = ~(np.maximum(np.abs(a[0]), np.abs(a[1])) < _LARGE_ANGLE)
    hi = np.where(_crossings(a, crest, _TWO_PI) | unknown, 1.0, np.minimum(hi, 1.0))
    lo = np.where(_crossings(a, trough, _TWO_PI) | unknown, -1.0, np.maximum(lo, -1.0))
    return lo, hi


def sine(a: Interval) -> Interval:
    """Enclose sin."""
    return _wave(np.sin, a, _HALF_PI, -_HALF_PI)


def cosine(a: Interval) -> Interval:
    """Enclose cos."""
    return _wave(np.cos, a, 0.0, np.pi)


def tangent(a: Interval) -> Interval:
    """Enclose tan; an interval that may hold a pole gives nothing."""
    lo, hi = widen((np.tan(a[0]), np.tan(a[1])), ULPS)
    pole = _crossings(a, _HALF_PI, np.pi) | ~(np.maximum(np.abs(a[0]), np.abs(a[1])) < _LARGE_ANGLE)
    return np.where(pole, np.nan, lo), np.where(pole, np.nan, hi)


def cosh(a: Interval) -> Interval:
    """Enclose cosh."""
    small, big = absolute(a)
    lo, hi = widen((np.cosh(small), np.cosh(big)), ULPS)
    return np.maximum(lo, 1.0), hi


def power_const(a: Interval, exponent: Interval) -> Interval:
    """Enclose a**p for a constant p that is no integer; defined for a >= 0 (> 0 when p < 0)."""
    base_lo, base_hi = a
    p_lo, p_hi = exponent
    corners = [np.power(base, p) for base in (base_lo, base_hi) for p in (p_lo, p_hi)]
    lo, hi = widen((reduce(np.minimum, corners), reduce(np.maximum, corners)), ULPS)
    outside = base_lo < 0.0
    return np.where(outside, np.nan, np.maximum(lo, 0.0)), np.where(outside, np.nan, hi)


def power(a: Interval, b: Interval) -> Interval:
    """Enclose a**b with both unknown, for a > 0: extreme at the corners."""
    lo, hi = power_const(a, b)
    outside = a[0] <= 0.0
    return np.where(outside, np.nan, lo), np.where(outside, np.nan, hi)


def arctangent2(y: Interval, x: Interval) -> Interval:
    """Enclose atan2(y, x); the whole circle when the box meets the cut behind the origin."""
    corners = [np.arctan2(v, h) for v in y for h in x]
    lo, hi = widen((reduce(np.minimum, corners), reduce(np.maximum, corners)), ULPS)
    cut = ~((x[0] > 0.0) | (y[0] > 0.0) | (y[1] < 0.0))
    circle = float(up(np.array(np.pi)))
    return np.where(cut, -circle, lo), np.where(cut, circle, hi)


def hypotenuse(a: Interval, b: Interval) -> Interval:
    """Enclose sqrt(a**2 + b**2), increasing in |a| and |b|."""
    (al, ah), (bl, bh) = absolute(a), absolute(b)
    lo, hi = widen((np.hypot(al, bl), np.hypot(ah, bh)), ULPS)
    return np.maximum(lo, 0.0), hi


def remainder(a: Interval, b: Interval) -> Interval:
    """Enclose fmod(a, b): the sign of a, smaller than |b| and no larger than |a|."""
    limit = np.minimum(absolute(a)[1], absolute(b)[1])
    nothing = absolute(b)[0] == 0.0
    lo, hi = np.where(a[0] < 0, -limit, 0.0), np.where(a[1] > 0, limit, 0.0)
    return np.where(nothing, np.nan, lo), np.where(nothing, np.nan, hi)


def copysign(a: Interval, b: Interval) -> Interval:
    """Enclose |a| with the sign of b; both signs where b may be zero, since zero has two."""
    size = absolute(a)
    plus, minus = b[0] > 0.0, b[1] < 0.0
    other = negate(size)
    lo = np.where(plus, size[0], other[0])
    hi = np.where(minus, other[1], size[1])
    return lo, hi


def less(a: Interval, b: Interval) -> Interval:
    """Return the truth value of a < b as an interval in [0, 1]."""
    return np.where(a[1] < b[0], 1.0, 0.0), np.where(a[0] >= b[1], 0.0, 1.0)


def less_equal(a: Interval, b: Interval) -> Interval:
    """Return the truth value of a <= b as an interval in [0, 1]."""
    return np.where(a[1] <= b[0], 1.0, 0.0), np.where(a[0] > b[1], 0.0, 1.0)


def equal(a: Interval, b: Interval) -> Interval:
    """Return the truth value of a == b as an interval in [0, 1]."""
    same = (a[0] == a[1]) & (b[0] == b[1]) & (a[0] == b[0])
    apart = (a[1] < b[0]) | (b[1] < a[0])
    return np.where(same, 1.0, 0.0), np.where(apart, 0.0, 1.0)


def boundary_weight(a: Interval, b: Interval) -> Interval:
    """Share of a in the derivative of min(a, b): 1 where a < b, 0 where a > b, any at a tie."""
    return less(a, b)[0], less_equal(a, b)[1]


def logical_not(a: Interval) -> Interval:
    """Negate a truth value."""
    return np.where(a[1] == 0.0, 1.0, 0.0), np.where(a[0] > 0.0, 0.0, 1.0)


def select(condition: Interval, a: Interval, b: Interval) -> Interval:
    """Return a where the condition holds, b elsewhere; the hull of both where it is open."""
    true, false = condition[0] > 0.0, condition[1] == 0.0
    either = hull(a, b)
    lo = np.where(true, a[0], np.where(false, b[0], either[0]))
    hi = np.where(true, a[1], np.where(false, b[1], either[1]))
    return lo, hi
