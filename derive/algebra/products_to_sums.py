"""Products of sines and cosines as sums, before anything is bounded.

cos(a) cos(a + b) + sin(a) sin(a + b) is cos(b), but an interval method sees three functions of a
that vary independently. With products written as sums (Fu's rule TR8) what cancels has cancelled,
and variables that do not matter are gone: the equations of a robot arm, as they come out of
Lagrange's method, shrink to a fraction. Every rewritten part is proved equal to what it replaces.
"""

import sympy as sp

_LARGEST = 3000


def products_to_sums(expression: sp.Expr) -> sp.Expr | None:
    """Write products of sines and cosines as sums, in every part where that is possible."""
    if not _has_products(expression) or expression.count_ops() > _LARGEST:
        return None
    result = _rewritten(expression)
    return None if result == expression else result


def _waves(expression: sp.Expr) -> set[sp.Expr]:
    return set(expression.atoms(sp.sin, sp.cos))


def _has_products(expression: sp.Expr) -> bool:
    """Whether some product or power holds two sines or cosines, in one factor or in two."""
    for node in sp.preorder_traversal(expression):
        if isinstance(node, sp.Mul) and sum(bool(_waves(factor)) for factor in node.args) > 1:
            return True
        if isinstance(node, sp.Pow) and isinstance(node.base, sp.sin | sp.cos):
            return True
    return False


def _is_polynomial(expression: sp.Expr) -> bool:
    """Whether sines and cosines stand in sums, products and natural powers only."""
    if not _waves(expression):
        return True
    if isinstance(expression, sp.sin | sp.cos):
        return not _waves(expression.args[0])
    if isinstance(expression, sp.Add | sp.Mul):
        return all(_is_polynomial(part) for part in expression.args)
    if isinstance(expression, sp.Pow):
        whole = expression.exp.is_Integer and expression.exp.is_positive
        return bool(whole) and _is_polynomial(expression.base)
    return False


def _rewritten(expression: sp.Expr) -> sp.Expr:
    if not _waves(expression) or not expression.args:
        return expression
    if _is_polynomial(expression):
        return _as_sum(expression)
    if isinstance(expression, sp.Mul | sp.Add):
        # what can be expanded is expanded together, so that it can cancel
        plain = [part for part in expression.args if _is_polynomial(part)]
        others = [_rewritten(part) for part in expression.args if not _is_polynomial(part)]
        return expression.func(_rewritten(expression.func(*plain)), *others)
    return expression.func(*(_rewritten(part) for part in expression.args))


def _as_sum(expression: sp.Expr) -> sp.Expr:
    from sympy.simplify.fu import TR8

    if not _has_products(expression):
        return expression
    flat = sp.expand(TR8(sp.expand(expression)))
    waves = sorted(_waves(flat), key=sp.default_sort_key)
    parts = sp.collect(flat, waves, evaluate=False, exact=True)
    total = sp.Add(*(sp.factor_terms(_short(factor)) * wave for wave, factor in parts.items()))
    return total if same_waves(expression, total) else expression


def _short(factor: sp.Expr) -> sp.Expr:
    """Factor a coefficient where that makes it shorter, such as the square of a sum of rates."""
    if factor.is_polynomial() and factor.count_ops() < 100:
        candidate = sp.factor(factor)
        return min((candidate, factor), key=lambda e: e.count_ops())
    return factor


def same_waves(one: sp.Expr, other: sp.Expr) -> bool:
    """Prove that two polynomials in sines and cosines are the same function."""
    waves = {wave: _exponentials(wave) for wave in _waves(one) | _waves(other)}
    return bool(sp.expand(one.xreplace(waves) - other.xreplace(waves)) == 0)


def _exponentials(wave: sp.Expr) -> sp.Expr:
    forwards, backwards = sp.Integer(1), sp.Integer(1)
    for term in sp.Add.make_args(sp.expand(wave.args[0])):
        forwards *= sp.exp(sp.I * term)
        backwards *= sp.exp(-sp.I * term)
    if isinstance(wave, sp.sin):
        return (forwards - backwards) / (2 * sp.I)
    return (forwards + backwards) / 2
