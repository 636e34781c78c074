"""Between exact numbers of SymPy and doubles: rounding with a proven bound."""

import math
import sys
from collections.abc import Mapping
from fractions import Fraction

import sympy as sp

from obsynth.derive.errors import DerivationError
from obsynth.derive.rigour.rounding import smallest_above

_DIGITS = 60
_LARGEST = sp.Integer(int(sys.float_info.max))


def rational(value: float) -> sp.Rational:
    """Return the rational number that a double is."""
    fraction = Fraction(float(value))
    return sp.Rational(fraction.numerator, fraction.denominator)


def substitute(expression: sp.Expr, values: Mapping[sp.Symbol, sp.Expr]) -> sp.Expr:
    """Put exact numbers in place of symbols; floats of the user become the rational they are."""
    result = sp.sympify(expression)
    if present := {s: values[s] for s in result.free_symbols if s in values}:
        result = result.subs(present)
    floats = {number: rational(float(number)) for number in result.atoms(sp.Float)}
    return result.xreplace(floats) if floats else result


def round_number(number: sp.Expr) -> tuple[float, float]:
    """Round an exact real number to a double, with a bound of the rounding error."""
    number = sp.sympify(number)
    approximation = number if number.is_Rational else number.evalf(_DIGITS)
    if not (number.is_Rational or approximation.is_Float) or not approximation.is_finite:
        raise DerivationError(f"{number} is not a finite real number", expression=number)
    if abs(approximation) > _LARGEST:
        raise DerivationError(f"{number} is too large for a double", expression=number)
    if number.is_Rational:
        exact = Fraction(int(number.p), int(number.q))
        value = float(exact)
        return value, smallest_above(abs(exact - Fraction(value)))
    value = float(approximation)
    distance = abs(approximation - sp.Float(rational(value), 2 * _DIGITS))
    margin = sp.Float(10, _DIGITS) ** (10 - _DIGITS) * abs(approximation)
    return value, math.nextafter(float(distance + margin), math.inf)


def enclose_number(number: sp.Expr) -> tuple[float, float]:
    """Enclose an exact real number between doubles."""
    value, error = round_number(number)
    if error == 0.0:
        return value, value
    return math.nextafter(value, -math.inf), math.nextafter(value, math.inf)
