"""Between exact numbers and doubles: rounding with a proven bound, zero tests."""

import math
from collections.abc import Mapping
from fractions import Fraction

import sympy as sp

from obsynth.derive.errors import DerivationError

__all__ = ["enclose_number", "is_zero", "rational", "round_number", "substitute"]

_DIGITS = 60


def rational(value: float) -> sp.Rational:
    """Return the rational number that a double is.

    Parameters
    ----------
    value : float
        A finite double.

    Returns
    -------
    sympy.Rational
        Exactly the same number.

    Examples
    --------
    >>> rational(0.75)
    3/4
    """
    fraction = Fraction(float(value))
    return sp.Rational(fraction.numerator, fraction.denominator)


def substitute(expression: sp.Expr, values: Mapping[sp.Symbol, sp.Expr]) -> sp.Expr:
    """Put exact numbers in place of symbols; floats of the user become the rational they are.

    Parameters
    ----------
    expression : sympy.Expr
        Any expression.
    values : mapping
        Exact values by symbol.

    Returns
    -------
    sympy.Expr
        Free of the symbols and of floating-point numbers.
    """
    result = sp.sympify(expression)
    if present := {s: values[s] for s in result.free_symbols if s in values}:
        result = result.subs(present)
    floats = {number: rational(float(number)) for number in result.atoms(sp.Float)}
    return result.xreplace(floats) if floats else result


def round_number(number: sp.Expr) -> tuple[float, float]:
    """Round an exact real number to a double, with a bound of the rounding error.

    Parameters
    ----------
    number : sympy.Expr
        A real number: rational, algebraic or built from elementary functions.

    Returns
    -------
    (float, float)
        The double and an upper bound of its distance to the number; 0 when they are equal.

    Raises
    ------
    DerivationError
        The expression is not a finite real number.

    Examples
    --------
    >>> round_number(sp.Rational(1, 4))
    (0.25, 0.0)
    >>> value, error = round_number(sp.sqrt(2))
    >>> value, 0 < error < 2.3e-16
    (1.4142135623730951, True)
    """
    number = sp.sympify(number)
    if number.is_Rational:
        exact = Fraction(int(number.p), int(number.q))
        value = float(exact)
        return value, _upper(abs(exact - Fraction(value)))
    approximation = number.evalf(_DIGITS)
    if not approximation.is_Float or not approximation.is_finite:
        raise DerivationError(f"{number} is not a finite real number", expression=number)
    value = float(approximation)
    distance = abs(approximation - sp.Float(rational(value), 2 * _DIGITS))
    margin = sp.Float(10, _DIGITS) ** (10 - _DIGITS) * abs(approximation)
    return value, math.nextafter(float(distance + margin), math.inf)


def enclose_number(number: sp.Expr) -> tuple[float, float]:
    """Enclose an exact real number between doubles.

    Parameters
    ----------
    number : sympy.Expr
        A real number.

    Returns
    -------
    (float, float)
        Equal ends when the number is a double, neighbours otherwise.

    Examples
    --------
    >>> lo, hi = enclose_number(sp.Rational(1, 10))
    >>> rational(lo) < sp.Rational(1, 10) < rational(hi)
    True
    """
    value, error = round_number(number)
    if error == 0.0:
        return value, value
    return math.nextafter(value, -math.inf), math.nextafter(value, math.inf)


def _upper(distance: Fraction) -> float:
    if distance == 0:
        return 0.0
    value = float(distance)
    return value if Fraction(value) >= distance else math.nextafter(value, math.inf)


def is_zero(expression: sp.Expr) -> str:
    """Prove that an expression is identically zero.

    Parameters
    ----------
    expression : sympy.Expr
        Exact expression, without floating-point numbers.

    Returns
    -------
    str
        How it was proved: ``"syntactic"``, ``"expand"``, ``"cancel"`` or ``"simplify"``; empty when
        no proof was found.

    Examples
    --------
    >>> x = sp.Symbol("x", real=True)
    >>> is_zero((x + 1) ** 2 - x**2 - 2 * x - 1)
    'expand'
    >>> is_zero(x - 1)
    ''
    """
    expression = sp.sympify(expression)
    if expression == 0:
        return "syntactic"
    expression = sp.expand(expression)
    if expression == 0:
        return "expand"
    if expression.is_number and abs(expression.evalf(30)) > sp.Float("1e-20"):
        return ""
    for name, attempt in (("cancel", sp.cancel), ("simplify", sp.simplify)):
        try:
            if attempt(expression) == 0:
                return name
        except (sp.PolynomialError, NotImplementedError):
            continue
    return ""
