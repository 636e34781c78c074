"""Expressions as a reader wants them."""

import sympy as sp

_DIGITS = 6
_LONG = 10**6


def short(expression: sp.Expr) -> sp.Expr:
    """Write the numbers of an expression with six digits, small integers and fractions as is."""
    if expression.is_number:
        plain = expression.is_Rational and abs(expression.p) < _LONG and expression.q < 1000
        return expression if plain else sp.Float(expression.evalf(_DIGITS), _DIGITS)
    if expression.is_Pow:
        exponent = expression.exp if expression.exp.is_Rational else short(expression.exp)
        return sp.Pow(short(expression.base), exponent, evaluate=expression.base.is_Symbol)
    if not expression.args:
        return expression
    if expression.is_Mul or expression.is_Add:
        numbers = [a for a in expression.args if a.is_number]
        rest = [short(a) for a in expression.args if not a.is_number]
        joined = [short(expression.func(*numbers))] if numbers else []
        return expression.func(*joined, *rest)
    return expression.func(*[short(a) if isinstance(a, sp.Expr) else a for a in expression.args])
