"""Intervals, one step of rounding to the named side, and doubles around SymPy's real numbers.

An interval is a pair ``(lo, hi)`` of arrays of equal or broadcastable shape, one element per box of
a batch, its ends one ``nextafter`` outside the exact result. Zeros that are exact stay exact, since
a lower end of ``-5e-324`` in place of 0 would leave the domain of a square root. ``nan`` in either
end stands for "nothing is known" and propagates until whoever reads the result makes the whole line
of it; it comes from operands outside a domain and from divisions by an interval with zero inside.
An infinite end stands for numbers without limit, never for infinity itself.

`raised` and `lowered` rest on the error n u / (1 - n u) of a sum of n products in any order, with
or without fused multiply-adds (N. J. Higham, Accuracy and Stability, section 3.1).
"""

import math
import sys
from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import Any

import numpy as np
import sympy as sp

from obsynth.derive.errors import DerivationError
from obsynth.derive.rigour.walks import once, replaced
from obsynth.symbolic.arrays import BoolArray, FloatArray

UNIT_ROUNDOFF = 2.0**-53
UNIT: Mapping[str, float] = {"double": UNIT_ROUNDOFF, "single": 2.0**-24}
"""Unit roundoff of a precision."""

# Above the underflow of fewer than 2^40 operations, whether or not it is flushed to zero.
TINY = 2.0**-980


def down(value: FloatArray | float) -> FloatArray:
    """Step to the next double towards minus infinity."""
    return np.nextafter(value, -np.inf)


def up(value: FloatArray | float) -> FloatArray:
    """Step to the next double towards plus infinity; the counterpart of `down`."""
    return np.nextafter(value, np.inf)


def smallest_above(value: Fraction) -> float:
    """Return the smallest double that is not below a rational number."""
    nearest = float(value)
    return nearest if Fraction(nearest) >= value else math.nextafter(nearest, math.inf)


def middle_and_radius(low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Split intervals so that middle +- radius holds them; no radius where both ends are equal.

    Intervals that are not finite get the middle 0 and an infinite radius.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        middle = 0.5 * low + 0.5 * high
        radius = np.maximum(high - middle, middle - low)
    known = np.isfinite(middle) & np.isfinite(radius)
    outward = np.where(radius > 0.0, up(radius), 0.0)
    return np.where(known, middle, 0.0), np.where(known, outward, np.inf)


def gamma_bound(n: int) -> float:
    """Upper bound of n u / (1 - n u), the relative error of n roundings."""
    return n * UNIT_ROUNDOFF * (1.0 + 2.0**-10)


def raised(value: FloatArray, roundings: int) -> FloatArray:
    """Return an upper bound of a nonnegative expression evaluated in doubles."""
    # three more: the factor, the product with it and the sum are rounded themselves
    return np.asarray(value * (1.0 + 2.0 * gamma_bound(roundings + 3)) + TINY)


def lowered(value: FloatArray, roundings: int) -> FloatArray:
    """Return a lower bound, not below zero, of such an expression."""
    return np.maximum(value * (1.0 - 2.0 * gamma_bound(roundings + 3)) - TINY, 0.0)


def add_up(*terms: FloatArray) -> FloatArray:
    """Return an upper bound of a sum of nonnegative arrays of one shape."""
    return raised(np.sum(np.stack(terms), axis=0), len(terms))


def product_up(left: FloatArray, right: FloatArray) -> FloatArray:
    """Return an upper bound of the product of nonnegative matrices."""
    return raised(left @ right, left.shape[-1] + 1)


def allowance(precision: str, n: int, product: float = 0.0) -> float:
    """Return what the rounding of one step may be, relative to the sum of the sizes of its terms.

    A term takes at most 24 roundings one after the other; every factor Q = I + M / mu of a
    transition over h 16 for its entries and n for the product, and terms with j factors have the
    weight of a Poisson variable with mean h mu, the `product`. Twice that, and 2^-42 in double
    precision.
    """
    count = 2.0 * (24.0 + (16.0 + n) * (1.0 + product))
    return max(count * UNIT[precision], 2.0**-42)


def outward(box: FloatArray, precision: str) -> FloatArray:
    """Return a box, shape (n, 2), whose ends are numbers of the precision and that holds it."""
    if precision == "double":
        return np.array(box, dtype=float)
    with np.errstate(over="ignore"):
        single = np.asarray(box, dtype=np.float32)
    low = np.where(single[:, 0] > box[:, 0], np.nextafter(single[:, 0], -np.inf), single[:, 0])
    high = np.where(single[:, 1] < box[:, 1], np.nextafter(single[:, 1], np.inf), single[:, 1])
    return np.column_stack([low, high]).astype(float)


def inward(box: FloatArray, precision: str) -> FloatArray:
    """Return a box, shape (n, 2), whose ends are numbers of the precision and that lies in it."""
    wide = outward(box, precision)
    if precision == "double":
        return wide
    low, high = wide.astype(np.float32).T
    near = np.column_stack([np.nextafter(low, np.inf), np.nextafter(high, -np.inf)])
    return np.asarray(np.where(wide == box, wide, near))


_DIGITS = 60
_BITS = 400
_CIRCULAR = ("sin", "cos", "tan", "asin", "acos", "atan")
_ANALYTIC = (*_CIRCULAR, *(f"{name}h" for name in _CIRCULAR), "exp", "log", "erf")
_LARGEST = sp.Integer(int(sys.float_info.max))


def rational(value: float) -> sp.Rational:
    """Return the rational number that a double is."""
    if not math.isfinite(value):
        raise DerivationError(f"{value} is no rational number: it is not finite", value=value)
    fraction = Fraction(float(value))
    return sp.Rational(fraction.numerator, fraction.denominator)


def exact(expression: sp.Expr) -> sp.Expr:
    """Write floats as the rationals they are; arithmetic with floats would round and overflow."""
    floats = {n: sp.Rational(n) for n in once(expression) if isinstance(n, sp.Float)}
    return replaced(expression, floats) if floats else expression


def substitute(expression: sp.Expr, values: Mapping[sp.Symbol, sp.Expr]) -> sp.Expr:
    """Put exact numbers in place of symbols; floats of the user become the rationals they are."""
    result = exact(sp.sympify(expression))
    present = {s: exact(values[s]) for s in once(result) if s in values}
    return replaced(result, present) if present else result


def round_number(number: sp.Expr) -> tuple[float, float]:
    """Round an exact real number to a double, with a bound of the rounding error."""
    number = sp.sympify(number)
    middle, radius = (number, Fraction(0)) if number.is_Rational else _decimal(number)
    if not middle.is_Rational:
        raise DerivationError(f"{number} is not a finite real number", expression=number)
    if abs(middle) > _LARGEST:
        raise DerivationError(f"{number} is too large for a double", expression=number)
    exact = Fraction(int(middle.p), int(middle.q))
    value = 0.0 if abs(exact) <= radius else float(exact)
    return value, smallest_above(abs(exact - Fraction(value)) + radius)


def enclose_number(number: sp.Expr) -> tuple[float, float]:
    """Enclose an exact real number between doubles."""
    value, error = round_number(number)
    if error == 0.0:
        return value, value
    lo, hi = math.nextafter(value, -math.inf), math.nextafter(value, math.inf)
    return min(lo, float(down(value - error))), max(hi, float(up(value + error)))


def _decimal(number: sp.Expr) -> tuple[sp.Expr, Fraction]:
    """Return a rational near a real number and a bound of their distance; nan where it is none.

    SymPy's `evalf` gives up on an exact zero after some digits, with a number that is not zero.
    """
    import flint

    if number.is_number:
        with flint.ctx.workprec(_BITS):
            ball = _ball(number)
            if ball.is_finite():
                middle, radius = (_dyadic(part) for part in (ball.mid(), ball.rad().upper()))
                return sp.Rational(middle.numerator, middle.denominator), radius
    approximation = number.evalf(_DIGITS)
    if not approximation.is_Float or approximation._prec < 3 * _DIGITS:
        return sp.nan, Fraction(0)
    middle = sp.Rational(approximation)
    return middle, abs(Fraction(int(middle.p), int(middle.q))) * Fraction(10) ** (10 - _DIGITS)


def _dyadic(number: Any) -> Fraction:
    mantissa, exponent = number.man_exp()
    return Fraction(int(mantissa)) * Fraction(2) ** int(exponent)


def _ball(number: sp.Expr) -> Any:
    """Enclose a real number of SymPy by a ball; not finite where that fails."""
    import flint

    if number.is_Rational or number.is_Float:
        exact = sp.Rational(number)
        return flint.arb(flint.fmpq(int(exact.p), int(exact.q)))
    if number in (sp.pi, sp.E):
        return flint.arb.pi() if number == sp.pi else flint.arb.const_e()
    parts = [_ball(part) for part in number.args]
    if number.is_Add:
        return sum(parts, flint.arb(0))
    if number.is_Mul:
        return math.prod(parts, start=flint.arb(1))
    if number.is_Pow:
        twice = 2 * number.exp
        if twice.is_Integer:
            return parts[0] ** int(number.exp) if twice % 2 == 0 else parts[0].sqrt() ** int(twice)
        return parts[0] ** parts[1]
    name = number.func.__name__
    return getattr(parts[0], name)() if name in _ANALYTIC else flint.arb.nan()


Interval = tuple[FloatArray, FloatArray]

_INF = np.inf
_EPS = float(np.finfo(float).eps)
_MOST = float(np.finfo(float).max)


def point(value: float) -> Interval:
    """Make the degenerate interval of a number that is meant as the double it is."""
    array = np.array([value], dtype=float)
    return array, array


def widen(a: Interval, ulps: int) -> Interval:
    """Push both ends outwards by a number of units in the last place; what overflows is large."""
    lo, hi = np.minimum(a[0], _MOST), np.maximum(a[1], -_MOST)
    return down(lo - ulps * _EPS * np.abs(lo)), up(hi + ulps * _EPS * np.abs(hi))


def hull(a: Interval, b: Interval) -> Interval:
    """Return the smallest interval that holds both."""
    return np.minimum(a[0], b[0]), np.maximum(a[1], b[1])


def _keep_zero(
    raw: FloatArray, rounded: FloatArray, possible: Callable[[], BoolArray]
) -> FloatArray:
    """Undo the rounding of an exact zero, unless the zero may come from underflow."""
    zero = raw == 0.0
    if not zero.any():
        return rounded
    return np.where(zero & ~possible(), 0.0, rounded)


def negate(a: Interval) -> Interval:
    """Return -a, exact."""
    return -a[1], -a[0]


def _sum(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Sum and the sign of what rounding took from it, exactly (Knuth); not a number on overflow."""
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


def add(a: Interval, b: Interval) -> Interval:
    """Return a + b; a sum that is a double is left as it is."""
    lo, below = _sum(a[0], b[0])
    hi, above = _sum(a[1], b[1])
    return np.where(below >= 0.0, lo, down(lo)), np.where(above <= 0.0, hi, up(hi))


def subtract(a: Interval, b: Interval) -> Interval:
    """Return a - b for independent operands."""
    return add(a, (-b[1], -b[0]))


def twice(a: Interval) -> Interval:
    """Return 2 a, exact apart from overflow."""
    return np.minimum(2.0 * a[0], _MOST), np.maximum(2.0 * a[1], -_MOST)


def _corners(operation: Callable[..., FloatArray], a: Interval, b: Interval) -> Interval:
    """Smallest and largest of what an operation makes of the ends; 0 inf and inf / inf count as 0.

    The one is the limit of zeros, the other lies between the values at the remaining ends.
    """
    corners = [operation(x, y) for x in a for y in b]
    lo, hi = (end(end(*corners[:2]), end(*corners[2:])) for end in (np.minimum, np.maximum))
    unclear = np.isnan(lo)
    if unclear.any():
        unclear &= ~(np.isnan(a[0]) | np.isnan(a[1]) | np.isnan(b[0]) | np.isnan(b[1]))
        corners = [np.where(unclear & np.isnan(c), 0.0, c) for c in corners]
        lo, hi = (end(end(*corners[:2]), end(*corners[2:])) for end in (np.minimum, np.maximum))
    return lo, hi


def _rounded_corners(operation: Callable[..., FloatArray], a: Interval, b: Interval) -> Interval:
    """Step the corners outwards, but for zeros that no signs of the operands leave."""
    (al, ah), (bl, bh) = a, b
    lo, hi = _corners(operation, a, b)
    return (
        _keep_zero(lo, down(lo), lambda: ((al < 0) & (bh > 0)) | ((ah > 0) & (bl < 0))),
        _keep_zero(hi, up(hi), lambda: ((ah > 0) & (bh > 0)) | ((al < 0) & (bl < 0))),
    )


def multiply(a: Interval, b: Interval) -> Interval:
    """Return a * b for independent operands."""
    return _rounded_corners(np.multiply, a, b)


def divide(a: Interval, b: Interval) -> Interval:
    """Return a / b; a divisor with zero at one end gives a half line, with zero inside nothing."""
    (al, ah), (bl, bh) = np.broadcast_arrays(*a), np.broadcast_arrays(*b)
    lo, hi = _rounded_corners(np.divide, (al, ah), (bl, bh))
    singular = (bl <= 0.0) & (bh >= 0.0)
    if not singular.any():
        return lo, hi
    positive, negative = singular & (bl == 0) & (bh > 0), singular & (bh == 0) & (bl < 0)
    lo, hi = np.where(singular, np.nan, lo), np.where(singular, np.nan, hi)
    for divisor, end, sign in ((positive, bh, 1.0), (negative, bl, -1.0)):
        # sign * a over sign * b, a divisor in [0, end]
        top_lo, top_hi = (al, ah) if sign > 0 else (-ah, -al)
        width = sign * end
        above, below = divisor & (top_lo >= 0), divisor & (top_hi <= 0)
        lo = np.where(above, np.maximum(down(top_lo / width), 0.0), np.where(below, -_INF, lo))
        hi = np.where(above, _INF, np.where(below, np.minimum(up(top_hi / width), 0.0), hi))
    return lo, hi


def power_int(a: Interval, n: int) -> Interval:
    """Return a**n for an integer n >= 2; a square is no product of two unknowns."""
    lo, hi = a
    if n == 2:
        big = np.maximum(np.abs(lo), np.abs(hi))
        small = np.where((lo <= 0) & (hi >= 0), 0.0, np.minimum(np.abs(lo), np.abs(hi)))
        least, most = small * small, big * big
        return (
            np.where(_squares_exactly(small), least, np.maximum(down(least), 0.0)),
            np.where(_squares_exactly(big), most, up(most)),
        )
    if n % 2 == 0:
        base_lo, base_hi = absolute(a)
        ends = _powers(base_lo, base_hi, n)
        return np.maximum(ends[0], 0.0), np.where(base_hi == 0.0, 0.0, ends[1])
    ends = _powers(lo, hi, n)
    return np.where(lo == 0.0, 0.0, ends[0]), np.where(hi == 0.0, 0.0, ends[1])


def _squares_exactly(value: FloatArray) -> BoolArray:
    """Whether a square needs no rounding: up to 24 significant bits, far from under- and overflow.

    1 - x**2 has to be 0 at x = 1 for a root of it to be defined.
    """
    with np.errstate(over="ignore"):
        short = value.astype(np.float32) == value
    return np.asarray(short & ((value == 0.0) | (np.abs(value) > 1e-30)))


def _powers(lo: FloatArray, hi: FloatArray, n: int) -> Interval:
    # pow of the C library is good to an ulp; eight leave room for vectorised versions of it
    return widen((np.power(lo, n), np.power(hi, n)), 8)


def sqrt(a: Interval) -> Interval:
    """Take the square root; an operand that reaches below zero gives nothing."""
    lo, hi = np.sqrt(a[0]), np.sqrt(a[1])
    lower, upper = np.where(lo == 0.0, 0.0, down(lo)), np.where(hi == 0.0, 0.0, up(hi))
    undefined = a[0] < 0.0
    if undefined.any():
        lower, upper = np.where(undefined, np.nan, lower), np.where(undefined, np.nan, upper)
    return lower, upper


def nonnegative(a: Interval) -> Interval:
    """Return a where it is >= 0, nothing where it reaches below: the domain of sqrt(a)**2."""
    undefined = a[0] < 0.0
    return np.where(undefined, np.nan, a[0]), np.where(undefined, np.nan, a[1])


def absolute(a: Interval) -> Interval:
    """Return |a|, exact."""
    lo, hi = a
    big = np.maximum(np.abs(lo), np.abs(hi))
    small = np.where((lo <= 0) & (hi >= 0), 0.0, np.minimum(np.abs(lo), np.abs(hi)))
    return np.where(np.isnan(big), np.nan, small), big


def minimum(a: Interval, b: Interval) -> Interval:
    """Return min(a, b), exact."""
    return np.minimum(a[0], b[0]), np.minimum(a[1], b[1])


def maximum(a: Interval, b: Interval) -> Interval:
    """Return max(a, b), exact."""
    return np.maximum(a[0], b[0]), np.maximum(a[1], b[1])


def meet(a: Interval, b: Interval) -> Interval:
    """Return what two enclosures of the same value have in common; one may be unknown."""
    return np.fmax(a[0], b[0]), np.fmin(a[1], b[1])


def with_zero(a: Interval) -> Interval:
    """Return the smallest interval that holds a and zero."""
    return np.minimum(a[0], 0.0), np.maximum(a[1], 0.0)
