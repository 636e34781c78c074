"""Proof that an expression is identically zero, or evidence at 60 digits, or a counterexample."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import import_module
from random import Random
from typing import Any

import sympy as sp
from sympy.core.function import AppliedUndef

from obsynth.derive.algebra.secants import quotients
from obsynth.derive.algebra.sizes import LARGEST_SIMPLIFY, is_short, simplified, size

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
