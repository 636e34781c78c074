"""Functions that IEEE 754 does not define to the last bit, made of operations that it does.

Arguments are reduced without error, or with the error carried along; polynomials interpolate at
Chebyshev nodes, coefficients rounded; powers of two are found by halving. `ULPS` bounds the errors
that ``tools/ulps.py`` found, see docs/c.md. Below the normal numbers the unit is the smallest one.
Zeros have no sign; what is not defined is a NaN, and so are sine, cosine and tangent beyond
`FARTHEST`.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from fractions import Fraction
from functools import cache

import casadi as ca
import numpy as np

from obsynth.designs.core.boxes import LIMITS

FARTHEST = LIMITS["single"].angle
"""Largest angle, below 2^12 quarter turns."""

_PI = Fraction(31415926535897932384626433832795028841971693993751, 10**49)
_LN2 = Fraction(693147180559945309417232121458176568075500134360255, 10**51)
_SINE = (-0.16666667, 0.008333332, -0.00019840083, 2.7249314e-06)
_COSINE = (0.041666668, -0.0013888888, 2.4800596e-05, -2.7300447e-07)
_EXP = (0.5, 0.16666667, 0.041666463, 0.008333311, 0.0013933738, 0.00019890344)
_LOG = (0.6666667, 0.40000123, 0.28550816, 0.233306)
_ARC = (
    *(-0.3333333, 0.1999974, -0.14278568, 0.11033763, -0.08656877),
    *(0.06250163, -0.035871476, 0.013507735, -0.0023869888),
)
_ERF = (0.12837915, -0.37612554, 0.11282497, -0.026792947, 0.005034371, -0.0006214585)
_ERFC = (
    *(0.00031515415, -1.1302189, -0.63184243, -0.110071845, 0.026420016, -0.004760286),
    *(0.0005971515, -4.611923e-05, 1.6411144e-06),
)
_BITS = (64, 32, 16, 8, 4, 2, 1)
_INF = float("inf")
_NAN = float("nan")


def _float(number: float) -> float:
    return float(np.float32(number))


def _parts(number: Fraction, bits: Sequence[int]) -> list[float]:
    """Split a number into floats of so many bits, and the float of what is left."""
    found, place = [], 0
    while Fraction(2) ** place <= number:
        place += 1
    for count in bits:
        place -= count
        part = number * Fraction(2) ** -place // 1 * Fraction(2) ** place
        found.append(float(part))
        number -= part
    return [*found, _float(float(number))]


def _sum(x: ca.SX, coefficients: Sequence[float]) -> ca.SX:
    total = ca.SX(_float(coefficients[-1]))
    for coefficient in coefficients[-2::-1]:
        total = _float(coefficient) + x * total
    return total


def _angle(x: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Return the quarter turn next to an angle, 0 to 3, and sine and cosine of the rest."""
    turns = ca.floor(x * _float(float(2 / _PI)) + 0.5)
    c = _parts(_PI / 2, (12, 12, 12, 12))
    high, low = (x - turns * c[0]) - turns * c[1], ca.SX(0)
    for part in c[2:4]:
        step = turns * part - low
        before, high = high, high - step
        low = (before - high) - step
    low = low - turns * c[4]
    z = high * high
    half = 0.5 * z
    sine = high + (high * (z * _sum(z, _SINE)) + low * (1.0 - half))
    near = 1.0 - half
    cosine = near + (((1.0 - near) - half) + (z * (z * _sum(z, _COSINE)) - high * low))
    return turns - 4.0 * ca.floor(0.25 * turns), sine, cosine


def _turned(x: ca.SX, ahead: int) -> ca.SX:
    """Return the sine of an angle and so many quarter turns more, 0 or 1."""
    turn, sine, cosine = _angle(x)
    odd = _any(turn == 1.0, turn == 3.0)
    value = ca.if_else(odd, sine, cosine) if ahead else ca.if_else(odd, cosine, sine)
    negative = _any(turn == 1.0, turn == 2.0) if ahead else turn >= 2.0
    return _defined(ca.if_else(negative, -value, value), ca.fabs(x) <= FARTHEST)


def _tan(x: ca.SX) -> ca.SX:
    turn, sine, cosine = _angle(x)
    odd = _any(turn == 1.0, turn == 3.0)
    value = ca.if_else(odd, -cosine, sine) / ca.if_else(odd, sine, cosine)
    return _defined(value, ca.fabs(x) <= FARTHEST)


def _any(one: ca.SX, other: ca.SX) -> ca.SX:
    return ca.logic_or(one, other)


def _defined(value: ca.SX, where: ca.SX) -> ca.SX:
    return ca.if_else(where, value, _NAN)


def _power_of_two(k: ca.SX) -> ca.SX:
    """Return 2^k for whole numbers up to 127 either way."""
    left, value = ca.fabs(k), ca.SX(1.0)
    for bit in _BITS:
        some = left >= bit
        value = value * ca.if_else(some, 2.0**bit, 1.0)
        left = left - ca.if_else(some, float(bit), 0.0)
    return ca.if_else(k < 0.0, 1.0 / value, value)


def _scaled(value: ca.SX, k: ca.SX) -> ca.SX:
    """Return value 2^k, rounded once."""
    half = ca.floor(0.5 * k)
    power = _power_of_two(half)
    return (value * power) * (power * ca.if_else(k == 2.0 * half, 1.0, 2.0))


def _split_exp(x: ca.SX, more: ca.SX | float = 0.0) -> tuple[ca.SX, ca.SX]:
    """Return k and e^r - 1 with x + more = k log 2 + r."""
    k = ca.floor(x * _float(float(1 / _LN2)) + 0.5)
    c = _parts(_LN2, (14,))
    high, low = x - k * c[0], k * c[1] - more
    r = high - low
    return k, r + ((r * r) * _sum(r, _EXP) + ((high - r) - low))


def _exp(x: ca.SX, more: ca.SX | float = 0.0) -> ca.SX:
    """Return the exponential of x + more, where that is small."""
    k, rest = _split_exp(x, more)
    value = ca.if_else(x < -104.0, 0.0, _scaled(1.0 + rest, k))
    return ca.if_else(x > 89.0, _INF, value)


def _expm1(x: ca.SX) -> ca.SX:
    k, rest = _split_exp(x)
    value = ca.if_else(x < -18.0, -1.0, _scaled(rest + (1.0 - _power_of_two(-k)), k))
    return ca.if_else(x > 89.0, _INF, value)


def _mantissa(x: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return m and k with x = m 2^k, m from half a root of two to a root of two."""
    small = x < 2.0**-126
    m, k = ca.if_else(small, x * 2.0**24, x), ca.if_else(small, -24.0, 0.0)
    for bit in _BITS:
        some = m >= 2.0**bit
        m, k = m * ca.if_else(some, 2.0**-bit, 1.0), k + ca.if_else(some, float(bit), 0.0)
    for bit in _BITS:
        some = m < 2.0 ** (1 - bit)
        m, k = m * ca.if_else(some, 2.0**bit, 1.0), k - ca.if_else(some, float(bit), 0.0)
    some = m > _float(1.4142135)
    return m * ca.if_else(some, 0.5, 1.0), k + ca.if_else(some, 1.0, 0.0)


def _log(x: ca.SX, more: ca.SX | float = 0.0) -> ca.SX:
    """Return log x + more, where that is small."""
    m, k = _mantissa(x)
    f = m - 1.0
    c = _parts(_LN2, (16,))
    s = f / (2.0 + f)
    z, half = s * s, (0.5 * f) * f
    inner = s * (half + z * _sum(z, _LOG)) + (k * c[1] + more)
    value = k * c[0] - ((half - inner) - f)
    zero = _defined(ca.SX(-_INF), x == 0.0)
    return ca.if_else(x > 0.0, ca.if_else(x < _INF, value, x), zero)


def _rest(x: ca.SX, y: ca.SX, product: ca.SX) -> ca.SX:
    """Return x y - product without rounding, both below 2^100 (Dekker)."""
    a, b = (v * 4097.0 - (v * 4097.0 - v) for v in (x, y))
    c, d = x - a, y - b
    return c * d - (((product - a * b) - c * b) - a * d)


def _pow(x: ca.SX, y: ca.SX) -> ca.SX:
    """Return x^y, log x in two floats: it is multiplied by what is as large as 88 / log x."""
    a, most = ca.fabs(x), 2.0**40
    m, k = _mantissa(a)
    f, d = m - 1.0, m + 1.0
    s, c = f / d, _parts(_LN2, (16,))
    left = ((f - s * d) - _rest(s, d, s * d) - s * (m - (d - 1.0))) / d
    z, first = s * s, k * c[0] + 2.0 * s
    second = (2.0 * s - (first - k * c[0])) + (2.0 * left + (s * (z * _sum(z, _LOG)) + k * c[1]))
    high = first + second
    low = second - (high - first)
    times = ca.if_else(y > most, most, ca.if_else(y < -most, -most, y))
    product = times * high
    value = _exp(product, _rest(times, high, product) + times * low)
    far = _any(a == 0.0, a == _INF)
    value = ca.if_else(far, ca.if_else((a > 1.0) == (y > 0.0), _INF, 0.0), value)
    odd = y - 2.0 * ca.floor(0.5 * y) == 1.0
    signed = _defined(ca.if_else(odd, -value, value), _any(far, ca.floor(y) == y))
    value = ca.if_else(x < 0.0, signed, value)
    value = _defined(value, ca.logic_and(a <= _INF, ca.fabs(y) <= _INF))
    return ca.if_else(_any(x == 1.0, y == 0.0), 1.0, value)


def _log1p(x: ca.SX) -> ca.SX:
    u = 1.0 + x
    return _log(u, (x - (u - 1.0)) / u)


def _arc(y: ca.SX, x: ca.SX) -> ca.SX:
    """Return the angle of (x, y)."""
    a, b = ca.fabs(y), ca.fabs(x)
    steep = a > b
    least, most = ca.if_else(steep, b, a), ca.if_else(steep, a, b)
    t = ca.if_else(least == most, ca.if_else(most == 0.0, 0.0, 1.0), least / most)
    z = t * t
    tail, quarters, sign = t * (z * _sum(z, _ARC)), ca.SX(0.0), ca.SX(1.0)
    for other, back in ((steep, 1.0), (x < 0.0, 2.0)):
        quarters = ca.if_else(other, back - quarters, quarters)
        sign = ca.if_else(other, -sign, sign)
    c = _parts(_PI / 2, (20,))
    value = quarters * c[0] + (sign * t + (sign * tail + quarters * c[1]))
    return _defined(ca.if_else(y < 0.0, -value, value), ca.logic_and(a <= _INF, b <= _INF))


def _odd(function: Callable[[ca.SX], ca.SX]) -> Callable[[ca.SX], ca.SX]:
    def whole(x: ca.SX) -> ca.SX:
        value = function(ca.fabs(x))
        return ca.if_else(x < 0.0, -value, value)

    return whole


def _tanh(a: ca.SX) -> ca.SX:
    t = _expm1(2.0 * a)
    value = ca.if_else(a < 0.5, t / (t + 2.0), 1.0 - 2.0 / (t + 2.0))
    return ca.if_else(a > 10.0, 1.0, value)


def _sinh(a: ca.SX) -> ca.SX:
    t, far = _expm1(a), _exp(0.5 * a)
    return ca.if_else(a > 88.0, (0.5 * far) * far, 0.5 * (t + t / (t + 1.0)))


def _erf(a: ca.SX) -> ca.SX:
    """Return a polynomial in a^2 times a, or what the exponential of one in a leaves of 1."""
    value = ca.if_else(a < 0.875, a + a * _sum(a * a, _ERF), 1.0 - _exp(_sum(a, _ERFC)))
    return ca.if_else(a > 4.0, 1.0, value)


def _cosh(x: ca.SX) -> ca.SX:
    a = ca.fabs(x)
    near, far = _exp(a), _exp(0.5 * a)
    return ca.if_else(a > 88.0, (0.5 * far) * far, 0.5 * near + 0.5 / near)


def _of_large(a: ca.SX, z: ca.SX) -> ca.SX:
    """Return log(1 + z), or log(2 a) where a is so large that this is the same."""
    far, u = a > 1e9, 1.0 + z
    more = ca.if_else(far, 0.0, (z - (u - 1.0)) / u)
    return _log(ca.if_else(far, a, u), more) + ca.if_else(far, _float(float(_LN2)), 0.0)


def _asinh(a: ca.SX) -> ca.SX:
    square = a * a
    return _of_large(a, a + square / (1.0 + ca.sqrt(1.0 + square)))


def _acosh(x: ca.SX) -> ca.SX:
    t = x - 1.0
    return _defined(_of_large(x, t + ca.sqrt(2.0 * t + t * t)), x >= 1.0)


def _hypot(x: ca.SX, y: ca.SX) -> ca.SX:
    a, b = ca.fabs(x), ca.fabs(y)
    steep = a > b
    least, most = ca.if_else(steep, b, a), ca.if_else(steep, a, b)
    ratio = least / most
    value = ca.if_else(most == 0.0, most, most * ca.sqrt(1.0 + ratio * ratio))
    value = _defined(value, ca.logic_and(a <= _INF, b <= _INF))
    return ca.if_else(_any(a == _INF, b == _INF), _INF, value)


_MADE: Mapping[str, Callable[..., ca.SX]] = {
    "sin": lambda x: _turned(x, 0),
    "cos": lambda x: _turned(x, 1),
    "tan": _tan,
    "exp": _exp,
    "expm1": _expm1,
    "log": _log,
    "log1p": _log1p,
    "atan": lambda x: _arc(x, ca.SX(1.0)),
    "atan2": _arc,
    "asin": lambda x: _arc(x, ca.sqrt((1.0 - x) * (1.0 + x))),
    "acos": lambda x: 2.0 * _arc(ca.sqrt(1.0 - x), ca.sqrt(1.0 + x)),
    "sinh": _odd(_sinh),
    "cosh": _cosh,
    "tanh": _odd(_tanh),
    "erf": _odd(_erf),
    "asinh": _odd(_asinh),
    "acosh": _acosh,
    "atanh": _odd(lambda a: 0.5 * _log1p(2.0 * a / (1.0 - a))),
    "hypot": _hypot,
    "pow": _pow,
}

ULPS: Mapping[str, float] = {
    **{"sin": 0.9, "cos": 0.9, "tan": 2.5, "exp": 0.9, "expm1": 1.5, "log": 0.9, "log1p": 1.0},
    **{"atan": 1.5, "atan2": 1.7, "asin": 2.6, "acos": 3.0, "sinh": 2.6, "cosh": 2.6, "tanh": 2.6},
    **{"asinh": 2.2, "acosh": 2.2, "atanh": 2.2, "hypot": 2.2, "pow": 5.5},
    "erf": 1.3,
}
"""Largest error in units in the last place, by name."""


@contextmanager
def _as_written() -> Iterator[None]:
    """Keep CasADi from simplifying: (1 + x) - 1 is what rounding leaves of x."""
    before = ca.GlobalOptions.getSimplificationOnTheFly()
    ca.GlobalOptions.setSimplificationOnTheFly(False)
    try:
        yield
    finally:
        ca.GlobalOptions.setSimplificationOnTheFly(before)


@cache
def own_function(name: str) -> ca.Function:
    """Return a function of our own, of scalars, as operations of IEEE 754 alone."""
    count = 2 if name in {"atan2", "hypot", "pow"} else 1
    variables = [ca.SX.sym("xy"[i]) for i in range(count)]
    with _as_written():
        return ca.Function(name, variables, [_MADE[name](*variables)])
