"""Proof that an expression is zero, evidence at 60 digits or a counterexample; how long it is.

SymPy expands and simplifies for hours where nobody stops it. Lengths do, and no clock does: what is
derived is the same on every machine. A length is found without walking through a part twice, since
a Runge-Kutta step has few different parts and many millions of them when it is written out.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import import_module
from math import comb
from random import Random
from typing import Any

import sympy as sp
from sympy.core.function import AppliedUndef

from obsynth.derive.algebra.secants import quotients
from obsynth.derive.rigour.walks import once, replaced
from obsynth.symbolic.display import short

LARGEST_SIMPLIFY = 300
"""Parts of an expression up to which `sympy.simplify` is asked; its longest proof had 280."""
LARGEST_ROW = 10_000
"""Parts of an expression up to which it is differentiated and rewritten as a whole."""
LARGEST_SUM = 20_000
"""Terms up to which products are multiplied out."""
_ENDLESS = 10**12
_LONGEST = 300
Box = Mapping[sp.Symbol, tuple[float, float]]
NUMERIC = "numerically zero at 60 digits"
_DIGITS = 60
_WORKING = 100
_POINTS = 6
_TRIES = 40
# Beyond these sizes a proof takes minutes, and numbers are the better evidence.
_LARGEST_CANCEL = 6000
_LARGEST_EXPONENTIAL = 2000
_LARGEST_NUMERATOR = 3000
_LARGEST_POWER = 8
_LARGEST_NUMERIC = 100_000
_GRID = 10**6


def size(expression: Any) -> int:
    """Count the parts of an expression written out."""
    known: dict[sp.Basic, int] = {}
    for node in once(expression):
        known[node] = min(_ENDLESS, 1 + sum(known[part] for part in node.args))
    return known[expression]


def symbols(expression: sp.Expr) -> set[sp.Basic]:
    """Collect the symbols of an expression, however long it is."""
    return {node for node in once(expression) if isinstance(node, sp.Symbol)}


def is_short(expression: sp.Expr) -> bool:
    """Tell whether an expression may be expanded and differentiated."""
    return size(expression) <= LARGEST_ROW and expanded_terms(expression) <= LARGEST_SUM


def expanded_terms(expression: sp.Expr) -> int:
    """Estimate, rather too high, into how many terms an expression expands, or a part of it."""
    count: dict[sp.Basic, int] = {}
    degree: dict[sp.Basic, int] = {}
    factors: dict[sp.Basic, frozenset[sp.Basic]] = {}
    largest = 1
    for node in once(expression):
        parts = node.args
        count[node], degree[node] = 1, 0 if node.is_number else 1
        factors[node] = frozenset() if node.is_number else frozenset([node])
        power = node.exp if isinstance(node, sp.Pow) else None
        if isinstance(node, sp.Add | sp.Mul):
            factors[node] = frozenset().union(*(factors[part] for part in parts))
            degrees = [degree[part] for part in parts]
            degree[node] = max(degrees) if isinstance(node, sp.Add) else sum(degrees)
            total = 0 if isinstance(node, sp.Add) else 1
            for part in parts:
                both = total + count[part] if isinstance(node, sp.Add) else total * count[part]
                total = min(_ENDLESS, both)
            count[node] = total
        elif power is not None and power.is_Integer and 1 < power < _ENDLESS:
            base, n = parts[0], int(power)
            factors[node], degree[node] = factors[base], min(_ENDLESS, n * degree[base])
            count[node] = _monomials(n, count[base] - 1)
        # like terms are collected: no more than there are monomials in what is not multiplied out
        count[node] = min(count[node], _monomials(degree[node], len(factors[node])))
        largest = max(largest, count[node])
    return largest


def _monomials(degree: int, variables: int) -> int:
    """Count the monomials up to a degree."""
    small, large = sorted((degree, variables))
    if small > 20 or (small > 1 and large > _ENDLESS):
        return _ENDLESS if small else 1
    return min(_ENDLESS, comb(degree + variables, small))


def expanded(expression: sp.Expr) -> sp.Expr:
    """Expand what does not become too long; leave the rest as it is."""
    return sp.expand(expression) if is_short(expression) else expression


def simplified(expression: sp.Expr) -> sp.Expr:
    """Simplify what is short; leave the rest as it is.

    SymPy tries for seconds to make something of a jump; nothing is to be made of it.
    """
    if size(expression) > LARGEST_SIMPLIFY:
        return expression
    jumps = (sp.sign, sp.Heaviside, sp.floor, sp.ceiling)
    names = {node: sp.Dummy(real=True) for node in once(expression) if isinstance(node, jumps)}
    short = sp.simplify(replaced(expression, names))
    return replaced(short, {name: node for node, name in names.items()})


def text(expression: sp.Expr) -> str:
    """Write what is short, fractions of many digits with six; tell of the rest how long it is."""
    parts = size(expression)
    if parts > _LONGEST:
        return f"(an expression of {parts:,} parts)"
    return str(sp.sstr(short(expression), full_prec=False))


def is_zero(expression: sp.Expr) -> str:
    """Prove that an expression is identically zero; empty where that fails."""
    expression = sp.sympify(expression)
    if expression == 0:
        return "syntactic"
    if not is_short(expression) or expression.has(sp.nan, sp.zoo):
        return ""
    expression = sp.expand(expression)
    if expression == 0:
        return "expand"
    if expression.is_number and abs(expression.evalf(30)) > sp.Float("1e-20"):
        return ""
    found = _prove(expression, exponentials=False)
    return "" if found == NUMERIC else found


def varies(expression: sp.Expr, variables: set[sp.Symbol]) -> bool:
    """Whether numbers show that an expression varies with some of its symbols: a quick refusal.

    SymPy simplifies for minutes what is nearly constant, as of coefficients that are rounded.
    """
    if expression.atoms(AppliedUndef):
        return False
    moved = {symbol: sp.Dummy(symbol.name, real=True) for symbol in variables}
    values = _values([expression, -expression.xreplace(moved)], {})
    return values is not None and not _vanish(values)


@dataclass(frozen=True, eq=False)
class FormProof:
    """Proof that a form is the plant: how each of its rows was proved, or how many digits agree."""

    rows: tuple[str, ...]
    methods: tuple[str, ...]

    @property
    def holds(self) -> bool:
        """True when every row is proved symbolically."""
        return all(method and method != NUMERIC for method in self.methods)

    @property
    def numeric_rows(self) -> tuple[str, ...]:
        """Rows for which numbers are the only evidence."""
        return tuple(r for r, m in zip(self.rows, self.methods, strict=True) if m == NUMERIC)

    def __str__(self) -> str:
        ways = ", ".join(sorted(set(self.methods) - {NUMERIC}))
        if self.holds:
            return f"identity proved in all {len(self.rows)} rows ({ways})"
        others = len(self.rows) - len(self.numeric_rows)
        proved = f"proved in {others} rows ({ways}), " if others else ""
        return f"identity {proved}{NUMERIC} in the rows of {', '.join(self.numeric_rows)}"


def prove_zero(expression: sp.Expr, box: Box) -> str:
    """Prove that an expression is zero, or find that it is not."""
    expression = sp.sympify(expression)
    if expression == 0:
        return "syntactic"
    known: dict[sp.Symbol, sp.Symbol] = {}
    if is_short(expression):
        expression = sp.expand(quotients(expression))
        if expression == 0:
            return "expand"
        known = _positive(expression, box)
        expression = sp.expand(expression.xreplace(known))
        if expression == 0:
            return "expand"
    parts = list(sp.Add.make_args(expression))
    values = _values(parts, {known.get(s, s): bounds for s, bounds in box.items()})
    if values is None or not _vanish(values):
        return ""
    return _prove(expression)


def _prove(expression: sp.Expr, exponentials: bool = True) -> str:
    """Prove that an expanded expression is zero, as far as its length allows."""
    if expression == 0:
        return "expand"
    length = size(expression) if is_short(expression) else _LARGEST_NUMERIC
    for name, attempt, limit in (
        ("cancel", _cancel, _LARGEST_CANCEL),
        ("cancel", _cancel_exponentials, _LARGEST_EXPONENTIAL if exponentials else 0),
        ("simplify", simplified, LARGEST_SIMPLIFY),
    ):
        if length > limit or _size_over_one(expression) > _LARGEST_NUMERATOR:
            continue
        try:
            if attempt(expression) == 0:
                return name
        except (sp.PolynomialError, NotImplementedError):
            continue
    return NUMERIC


def _cancel(expression: sp.Expr) -> sp.Expr:
    if _size_over_one(expression) > _LARGEST_NUMERATOR:
        return expression
    return sp.cancel(expression)


def _cancel_exponentials(expression: sp.Expr) -> sp.Expr:
    """Cancel after writing trigonometric and hyperbolic functions as exponentials of single terms.

    Addition theorems are then identities between monomials.
    """
    written = sp.expand_log(expression).rewrite(sp.exp)
    return _cancel(sp.expand(written, trig=False))


def _size_over_one(expression: sp.Expr) -> int:
    """Estimate how many terms there are over one common denominator."""
    terms = sp.Add.make_args(expression)
    powers: dict[sp.Expr, int] = {}
    for term in terms:
        for factor in sp.Mul.make_args(term):
            base, exponent = factor.as_base_exp()
            if base.is_Add and exponent.is_number and exponent < 0:
                powers[base] = max(powers.get(base, 0), int(sp.ceiling(-exponent)))
    size = len(terms)
    for base, power in powers.items():
        size *= min(len(base.args), _LARGEST_NUMERATOR) ** min(power, _LARGEST_POWER)
    return size


def _positive(expression: sp.Expr, box: Box) -> dict[sp.Symbol, sp.Symbol]:
    """Symbols of which SymPy may know that they are positive over the box."""
    return {
        symbol: sp.Dummy(symbol.name, positive=True)
        for symbol in expression.free_symbols
        if box.get(symbol, (-1.0, 1.0))[0] > 0.0
    }


def _points(symbols: list[sp.Symbol], box: Box) -> Iterator[list[sp.Rational]]:
    random = Random(0)
    for _ in range(_TRIES):
        point = []
        for symbol in symbols:
            lower, upper = box.get(symbol, (-1.0, 1.0))
            low = sp.Rational(lower) if lower > -sp.oo else sp.Integer(-2)
            high = sp.Rational(upper) if upper < sp.oo else low + 4
            share = sp.Rational(2 * random.randrange(_GRID) + 1, 2 * _GRID)
            point.append(low + share * (high - low))
        yield point


def _values(terms: list[sp.Expr], box: Box) -> list[list[Any]] | None:
    """Values of terms at random points of the box, to 100 digits; None where there are too few."""
    if any(size(term) > _LARGEST_NUMERIC for term in terms):
        return None
    mpmath: Any = import_module("mpmath")
    symbols = sorted(set().union(*(term.free_symbols for term in terms)), key=str)
    try:
        function = sp.lambdify(symbols, terms, "mpmath", cse=True)
    except NotImplementedError:
        return None
    found: list[list[Any]] = []
    with mpmath.workdps(_WORKING):
        for point in _points(symbols, box):
            try:
                values = function(*[mpmath.mpf(int(v.p)) / int(v.q) for v in point])
                if not all(mpmath.isfinite(v) for v in values):
                    continue
            except (ZeroDivisionError, ValueError, TypeError, OverflowError):
                continue
            found.append(values)
            if len(found) == _POINTS:
                return [list(column) for column in zip(*found, strict=True)]
    return None


def _vanish(values: list[list[Any]]) -> bool:
    """Tell whether terms add up to zero to 60 digits, relative to their size, at every point."""
    mpmath: Any = import_module("mpmath")
    with mpmath.workdps(_WORKING):
        limit = mpmath.mpf(10) ** -_DIGITS
        return all(
            abs(mpmath.fsum(column)) <= limit * mpmath.fsum(abs(v) for v in column)
            for column in zip(*values, strict=True)
        )
