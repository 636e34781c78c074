"""Quasi-linear forms f(x, u) = A(x, u) x + B(x, u) u + r by a rule for every term."""

from collections.abc import Sequence
from dataclasses import dataclass

import sympy as sp

__all__ = ["Factorisation", "expand_terms", "factorise"]


@dataclass(frozen=True, eq=False)
class Factorisation:
    """f = A x + B u + offset with matrices that depend on x and u.

    Attributes
    ----------
    A : sympy.Matrix, shape (n, n)
        State coefficients.
    B : sympy.Matrix, shape (n, n_u)
        Input coefficients.
    offset : sympy.Matrix, shape (n, 1)
        Terms in which neither a state nor an input can be factored out.
    linear_A, linear_B : sympy.Matrix
        The part of A and B that comes from terms with a constant coefficient.
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

    Parameters
    ----------
    expression : sympy.Expr
        Any expression.

    Returns
    -------
    list of sympy.Expr
        Their sum is the expression.

    Examples
    --------
    >>> x, y = sp.symbols("x y", real=True)
    >>> sorted(map(str, expand_terms(x * (y + sp.sin(x + y)) + 1)))
    ['1', 'x*sin(x + y)', 'x*y']
    """
    known: dict[sp.Expr, sp.Dummy] = {}
    expanded = sp.expand(_opaque(sp.sympify(expression), known))
    back = {dummy: original for original, dummy in known.items()}
    return [term.xreplace(back) for term in sp.Add.make_args(expanded) if term != 0]


def _divisors(term: sp.Expr, symbols: Sequence[sp.Symbol]) -> list[int]:
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


def _linear_form(
    term: sp.Expr, states: Sequence[sp.Symbol]
) -> tuple[list[tuple[int, sp.Expr]], sp.Expr] | None:
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
                return coefficients, form
    return None


def factorise(
    rows: sp.Matrix, states: Sequence[sp.Symbol], inputs: Sequence[sp.Symbol]
) -> Factorisation:
    """Write every row as A(x, u) x + B(x, u) u + offset.

    The rules, term by term, first match: a state that is a factor (the row's own state before
    others); an input that is a factor; a term in one state that vanishes where the state does,
    divided by that state (sqrt(h) = (sqrt(h)/h) h); a term that depends on the states through one
    homogeneous linear form and vanishes with it (two columns for phi(x1 - x3)); otherwise offset.

    Parameters
    ----------
    rows : sympy.Matrix, shape (n, 1)
        f(x, u).
    states, inputs : sequence of sympy.Symbol
        x and u.

    Returns
    -------
    Factorisation
        The sum A x + B u + offset equals the rows identically.

    Examples
    --------
    >>> h, v = sp.symbols("h v", real=True)
    >>> form = factorise(sp.Matrix([h - sp.sqrt(h) + 2 * v]), [h], [v])
    >>> form.A, form.B
    (Matrix([[1 - 1/sqrt(h)]]), Matrix([[2]]))
    """
    n, n_u = len(states), len(inputs)
    A, B = sp.zeros(n, n), sp.zeros(n, n_u)
    linear_A, linear_B, offset = sp.zeros(n, n), sp.zeros(n, n_u), sp.zeros(n, 1)
    signals = [*states, *inputs]
    for i, row in enumerate(rows):
        for term in expand_terms(row):
            if not term.has(*signals):
                offset[i] += term
                continue
            columns = _divisors(term, states)
            if columns:
                j = i if i in columns else columns[0]
                A[i, j] += term / states[j]
                if not (term / states[j]).has(*signals):
                    linear_A[i, j] += term / states[j]
                continue
            columns = _divisors(term, inputs)
            if columns:
                B[i, columns[0]] += term / inputs[columns[0]]
                if not (term / inputs[columns[0]]).has(*signals):
                    linear_B[i, columns[0]] += term / inputs[columns[0]]
                continue
            present = [k for k, s in enumerate(states) if term.has(s)]
            if len(present) == 1 and _vanishes(term, states[present[0]]):
                A[i, present[0]] += term / states[present[0]]
                continue
            found = _linear_form(term, states) if len(present) > 1 else None
            if found is None:
                offset[i] += term
                continue
            coefficients, form = found
            for k, coefficient in coefficients:
                A[i, k] += coefficient * term / form
    return Factorisation(A, B, offset, linear_A, linear_B)
