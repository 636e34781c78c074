"""Quasi-linear forms f(x, u) = A(x, u) x + B(x, u) u + r by a rule for every term."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import sympy as sp


@dataclass(frozen=True, eq=False)
class Divisor:
    """A homogeneous linear form by which a term is divided.

    form: the form: one signal, or a combination of several
    weights: position of every signal among states, then inputs, and its coefficient in the form.
        The term is (term / form) times the sum of weight times signal
    """

    form: sp.Expr
    weights: tuple[tuple[int, sp.Expr], ...]


@dataclass(frozen=True, eq=False)
class Factorisation:
    """f = A x + B u + offset with matrices that depend on x and u.

    A: state coefficients
    B: input coefficients
    offset: terms in which neither a state nor an input can be factored out
    linear_A, linear_B: the part of A and B that comes from terms with a constant coefficient
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
    """List the additive terms of an expression; functions, roots and denominators stay whole."""
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
            replaced = sp.simplify(term.subs(states[first], (z - rest) / slope))
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

    Every term goes to the first of its `divisors`: a state that is a factor (the row's own state
    before others); an input that is a factor; the state in which it vanishes, for a term in one
    state (sqrt(h) = (sqrt(h)/h) h); the homogeneous linear form through which alone it depends on
    the states (two columns for phi(x1 - x3)); otherwise to the offset. `quasi_lpv` weighs all
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
