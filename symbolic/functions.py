"""The functions that equations may use: their name, their SymPy and their CasADi form."""

from collections.abc import Callable
from dataclasses import dataclass
from math import factorial
from typing import Any

import casadi as ca
import sympy as sp

# Inside |x| < 1/8 a quotient by x is replaced by its Taylor polynomial, whose first term
# left out is below 1e-16 there. A constant patch would have a wrong derivative, and a
# division by x itself would have no bound on an interval that contains zero.
_PATCH = 1.0 / 8.0
_SINC = tuple((-1) ** k / factorial(2 * k + 1) for k in range(6))
_PHI1 = tuple(1.0 / factorial(k + 1) for k in range(11))
_TANHC = (
    1.0,
    -1.0 / 3.0,
    2.0 / 15.0,
    -17.0 / 315.0,
    62.0 / 2835.0,
    -1382.0 / 155925.0,
    21844.0 / 6081075.0,
    -929569.0 / 638512875.0,
)


class _Quotient(sp.Function):  # type: ignore[misc]
    """What a numerator over x is continued to; ``numerator`` is a function of x."""

    nargs = 1

    def _eval_is_extended_real(self) -> bool | None:
        return True if self.args[0].is_extended_real else None

    def _eval_evalf(self, prec: int) -> sp.Expr | None:
        x = self.args[0]._eval_evalf(prec + 60)
        if x is None or not x.is_number:
            return None
        return (self.numerator(x) / x)._eval_evalf(prec)


class phi1(_Quotient):
    """(exp(x) - 1)/x, continued by 1 at x = 0.

    Examples
    --------
    >>> phi1(sp.Integer(0))
    1
    """

    @staticmethod
    def numerator(x: sp.Expr) -> sp.Expr:
        """Return exp(x) - 1."""
        return sp.exp(x) - 1

    @classmethod
    def eval(cls, x: sp.Expr) -> sp.Expr | None:
        """Return the value at zero; keep everything else as it is."""
        return sp.Integer(1) if x.is_zero else None

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        """Return the derivative, as a quotient away from zero."""
        x = self.args[0]
        return sp.Piecewise(((sp.exp(x) - phi1(x)) / x, sp.Ne(x, 0)), (sp.Rational(1, 2), True))


class tanhc(_Quotient):
    """tanh(x)/x, continued by 1 at x = 0.

    Examples
    --------
    >>> tanhc(sp.Integer(0))
    1
    """

    numerator = sp.tanh

    @classmethod
    def eval(cls, x: sp.Expr) -> sp.Expr | None:
        """Return the value at zero; an even function drops its argument's sign."""
        if x.is_zero:
            return sp.Integer(1)
        return cls(-x) if x.could_extract_minus_sign() else None

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        """Return the derivative, as a quotient away from zero."""
        x = self.args[0]
        slope = (1 - sp.tanh(x) ** 2 - tanhc(x)) / x
        return sp.Piecewise((slope, sp.Ne(x, 0)), (0, True))


def _patched(
    numerator: Callable[[ca.SX], ca.SX], coefficients: tuple[float, ...], even: bool = True
) -> Callable[[ca.SX], ca.SX]:
    """Return numerator/x as a function of x, near zero the polynomial in x^2, or in x."""

    def build(x: ca.SX) -> ca.SX:
        variable = x * x if even else x
        polynomial = ca.SX(coefficients[-1])
        for coefficient in reversed(coefficients[:-1]):
            polynomial = polynomial * variable + coefficient
        quotient = x * numerator(x) / ca.fmax(x * x, _PATCH**2)
        return ca.if_else(ca.fabs(x) < _PATCH, polynomial, quotient)

    return build


def _heaviside(x: ca.SX, at_zero: ca.SX | None = None) -> ca.SX:
    middle = ca.SX(0.5) if at_zero is None else at_zero
    return ca.if_else(x > 0, 1.0, ca.if_else(x < 0, 0.0, middle))


def _fold(binary: Callable[[Any, Any], Any]) -> Callable[..., Any]:
    def folded(*items: Any) -> Any:
        result = items[0]
        for item in items[1:]:
            result = binary(result, item)
        return result

    return folded


@dataclass(frozen=True)
class NamedFunction:
    """A function by its name in text, its SymPy constructor and its CasADi builder.

    least, most: how many arguments it takes; ``most=None`` is any number
    """

    name: str
    sympy: Callable[..., Any]
    casadi: Callable[..., Any]
    least: int = 1
    most: int | None = 1


_NAMED = "sqrt exp log sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh sign floor erf"
_TABLE = (
    *(NamedFunction(name, getattr(sp, name), getattr(ca, name)) for name in _NAMED.split()),
    NamedFunction("atan2", sp.atan2, ca.atan2, 2, 2),
    NamedFunction("Abs", sp.Abs, ca.fabs),
    NamedFunction("ceiling", sp.ceiling, ca.ceil),
    NamedFunction("Max", sp.Max, _fold(ca.fmax), 1, None),
    NamedFunction("Min", sp.Min, _fold(ca.fmin), 1, None),
    NamedFunction("Heaviside", sp.Heaviside, _heaviside, 1, 2),
    NamedFunction("sinc", sp.sinc, _patched(ca.sin, _SINC)),
    NamedFunction("phi1", phi1, _patched(ca.expm1, _PHI1, even=False)),
    NamedFunction("tanhc", tanhc, _patched(ca.tanh, _TANHC)),
)

BY_NAME = {function.name: function for function in _TABLE}
"""Every supported function under the name it has in text."""

BY_CLASS = {function.sympy: function for function in _TABLE if isinstance(function.sympy, type)}
"""The same under the SymPy class; ``sqrt`` is a power there and has none."""

ALIASES = {"abs": "Abs", "max": "Max", "min": "Min", "ln": "log", "fabs": "Abs", "ceil": "ceiling"}
"""Other spellings the reader of text accepts."""
