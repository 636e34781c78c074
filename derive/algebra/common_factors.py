"""Common factors of numerators and denominators, cancelled where a denominator may be zero.

(x**2 - y**2)/(x - y) is x + y, but an interval method sees a division by an interval that contains
zero, and no quotient in one variable either. Where the denominator has no zero in the box, rows
stay as they were typed.
"""

from collections.abc import Callable

import sympy as sp

_LARGEST = 200


def cancel_common_factors(
    expression: sp.Expr, may_vanish: Callable[[sp.Expr], bool]
) -> sp.Expr | None:
    """Cancel what numerators have in common with denominators that may be zero."""
    found = _cancelled(expression, may_vanish)
    return None if found == expression else found


def _cancelled(expression: sp.Expr, may_vanish: Callable[[sp.Expr], bool]) -> sp.Expr:
    if not expression.args or not any(p.exp.is_negative for p in expression.atoms(sp.Pow)):
        return expression
    parts = [_cancelled(part, may_vanish) for part in expression.args]
    result = expression.func(*parts)
    if not isinstance(result, sp.Mul):
        return result
    numerator, denominator = sp.fraction(result)
    sums = [f for f in sp.Mul.make_args(denominator) if f.atoms(sp.Add)]
    if not sums or result.count_ops() > _LARGEST or not any(map(may_vanish, sums)):
        return result
    shorter = sp.cancel(result)
    left, below = sp.fraction(shorter)
    if below.count_ops() >= denominator.count_ops():
        return result
    # numbers aside, the new denominator divides the old one and the products agree
    return shorter if sp.expand(left * denominator - numerator * below) == 0 else result
