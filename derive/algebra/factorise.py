"""Exact rewriting of expressions: common factors, factors over a field, sums of angles.

(x**2 - y**2)/(x - y) is x + y, but an interval method sees a division by an interval that contains
zero; where the denominator has no zero in the box, rows stay as they were typed. cos(a) cos(a + b)
+ sin(a) sin(a + b) is cos(b), but an interval method sees three functions of a that vary
independently: with products written as sums (Fu's rule TR8) what cancels has cancelled. Every part
that is rewritten so is proved equal to what it replaces.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import sympy as sp

from obsynth.derive.algebra.sizes import LARGEST_ROW, is_short, simplified, size
from obsynth.derive.algebra.zero_test import varies

_LARGEST_SUM = 200
# The stages of a Runge-Kutta step stand in it many times over.
_once = lru_cache(maxsize=4096)


def cancel_common_factors(
    expression: sp.Expr, may_vanish: Callable[[sp.Expr], bool]
) -> sp.Expr | None:
    """Cancel what numerators have in common with denominators that may be zero."""
    if size(expression) > LARGEST_ROW:
        return None
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
    if not sums or result.count_ops() > _LARGEST_SUM or not any(map(may_vanish, sums)):
        return result
    shorter = sp.cancel(result)
    left, below = sp.fraction(shorter)
    if below.count_ops() >= denominator.count_ops():
        return result
    # numbers aside, the new denominator divides the old one and the products agree
    return shorter if sp.expand(left * denominator - numerator * below) == 0 else result


@dataclass(frozen=True, eq=False)
class Divisor:
    """A homogeneous linear form by which a term is divided.

    weights: position of every signal among states, then inputs, and its coefficient in the form.
        The term is (term / form) times the sum of weight times signal
    """

    form: sp.Expr
    weights: tuple[tuple[int, sp.Expr], ...]


@dataclass(frozen=True, eq=False)
class Factorisation:
    """f = A x + B u + offset with matrices that depend on x and u.

    ``linear_A`` and ``linear_B`` are what comes from terms with a constant coefficient.
    """

    A: sp.Matrix
    B: sp.Matrix
    offset: sp.Matrix
    linear_A: sp.Matrix
    linear_B: sp.Matrix


def _opaque(expression: sp.Expr, known: dict[sp.Expr, sp.Dummy]) -> sp.Expr:
    """Replace everything that is no polynomial in symbols by place-holders."""
    if expression.is_Add or expression.is_Mul:
        return expression.func(*[_opaque(a, known) for a in expression.args])
    if expression.is_Pow and expression.exp.is_Integer:
        if expression.exp > 0:
            return _opaque(expression.base, known) ** expression.exp
        if expression.base.is_Symbol:
            return expression
    if expression.is_Symbol or expression.is_number:
        return expression
    if expression not in known:
        known[expression] = sp.Dummy(real=True)
    return known[expression]


def expand_terms(expression: sp.Expr) -> list[sp.Expr]:
    """List the additive terms of an expression; functions, roots and denominators stay whole.

    What would be too long when it is multiplied out stays as it is.
    """
    if not is_short(expression):
        return list(sp.Add.make_args(expression))
    known: dict[sp.Expr, sp.Dummy] = {}
    expanded = sp.expand(_opaque(sp.sympify(expression), known))
    back = {dummy: original for original, dummy in known.items()}
    return [term.xreplace(back) for term in sp.Add.make_args(expanded) if term != 0]


def _factors(term: sp.Expr, symbols: Sequence[sp.Symbol]) -> list[int]:
    """List the indices of symbols that the term contains as a factor."""
    found = set()
    for factor in sp.Mul.make_args(term):
        base, exponent = factor.as_base_exp()
        if base in symbols and exponent.is_number and exponent >= 1:
            found.add(list(symbols).index(base))
    return sorted(found)


def _vanishes(term: sp.Expr, symbol: sp.Symbol) -> bool:
    """Tell whether the term is zero where the symbol is."""
    value = term.subs(symbol, 0)
    return bool(value == 0)


def _linear_form(term: sp.Expr, states: Sequence[sp.Symbol]) -> Divisor | None:
    """Find the homogeneous linear form through which alone a term depends on the states."""
    if size(term) > LARGEST_ROW:
        return None
    present = [k for k, s in enumerate(states) if term.has(s)]
    for atom in sorted(term.atoms(sp.Function, sp.Pow), key=sp.default_sort_key):
        for argument in atom.args:
            if not all(argument.has(states[k]) for k in present):
                continue
            coefficients = [(k, sp.diff(argument, states[k])) for k in present]
            if any(c.has(*states) for _, c in coefficients):
                continue
            form = sum((c * states[k] for k, c in coefficients), sp.Integer(0))
            if sp.expand(argument - form) != 0:
                continue
            z = sp.Dummy(real=True)
            first, slope = coefficients[0]
            rest = form - slope * states[first]
            replaced = term.subs(states[first], (z - rest) / slope)
            if varies(replaced, {states[k] for k in present}):
                continue
            replaced = simplified(replaced)
            if not replaced.has(*states) and _vanishes(replaced, z):
                return Divisor(form, tuple(coefficients))
    return None


def divisors(
    term: sp.Expr, own: int, states: Sequence[sp.Symbol], inputs: Sequence[sp.Symbol]
) -> Iterator[Divisor]:
    """List what a term can be divided by without a new singularity, the preferred one first."""
    one = sp.Integer(1)
    factors = _factors(term, states)
    for j in sorted(factors, key=lambda k: k != own):
        yield Divisor(states[j], ((j, one),))
    taken = _factors(term, inputs)
    for j in taken:
        yield Divisor(inputs[j], ((len(states) + j, one),))
    if factors or taken:
        return
    present = [k for k, s in enumerate(states) if term.has(s)]
    if len(present) == 1 and _vanishes(term, states[present[0]]):
        yield Divisor(states[present[0]], ((present[0], one),))
        return
    found = _linear_form(term, states) if len(present) > 1 else None
    if found is not None:
        yield found


def factorise(
    rows: sp.Matrix, states: Sequence[sp.Symbol], inputs: Sequence[sp.Symbol]
) -> Factorisation:
    """Write every row as A(x, u) x + B(x, u) u + offset.

    Every term goes to the first of its `divisors`, else to the offset; `quasi_lpv` weighs all
    choices against each other.
    """
    n, n_u = len(states), len(inputs)
    columns, linear = sp.zeros(n, n + n_u), sp.zeros(n, n + n_u)
    offset = sp.zeros(n, 1)
    signals = [*states, *inputs]
    for i, row in enumerate(rows):
        for term in expand_terms(row):
            divisor = None
            if term.has(*signals):
                divisor = next(divisors(term, i, states, inputs), None)
            if divisor is None:
                offset[i] += term
                continue
            for j, weight in divisor.weights:
                coefficient = weight * term / divisor.form
                columns[i, j] += coefficient
                if divisor.form == signals[j] and not coefficient.has(*signals):
                    linear[i, j] += coefficient
    return Factorisation(columns[:, :n], columns[:, n:], offset, linear[:, :n], linear[:, n:])


def products_to_sums(expression: sp.Expr) -> sp.Expr | None:
    """Write products of sines and cosines as sums, in every part where that is possible."""
    if size(expression) > LARGEST_ROW or not _has_products(expression):
        return None
    result = _rewritten(expression)
    return None if result == expression else result


@_once
def _waves(expression: sp.Expr) -> frozenset[sp.Expr]:
    return frozenset(expression.atoms(sp.sin, sp.cos))


def _has_products(expression: sp.Expr) -> bool:
    """Whether some product or power holds two sines or cosines, in one factor or in two."""
    for node in sp.preorder_traversal(expression):
        if isinstance(node, sp.Mul) and sum(bool(_waves(factor)) for factor in node.args) > 1:
            return True
        if isinstance(node, sp.Pow) and isinstance(node.base, sp.sin | sp.cos):
            return True
    return False


@_once
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


@_once
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
