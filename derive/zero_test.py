"""Proof that an expression is identically zero, or evidence at 60 digits, or a counterexample."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import import_module
from random import Random
from typing import Any

import sympy as sp

from obsynth.derive.secants import quotients

__all__ = ["NUMERIC", "FormProof", "prove_zero"]

Box = Mapping[sp.Symbol, tuple[float, float]]
NUMERIC = "numerically zero at 60 digits"
_DIGITS = 60
_WORKING = 100
_POINTS = 6
_TRIES = 40
# Beyond this size cancel and simplify take minutes, and numbers are the better evidence.
_LARGEST_CANCEL = 3000
_LARGEST_EXPONENTIAL = 1000
_LARGEST_SIMPLIFY = 600
_GRID = 10**6


@dataclass(frozen=True, eq=False)
class FormProof:
    """Proof that the parts of a form add up to the plant, row by row.

    Attributes
    ----------
    rows : tuple of str
        Names of the rows: states, then outputs.
    methods : tuple of str
        How every row was proved: ``"syntactic"``, ``"expand"``, ``"cancel"``, ``"simplify"``, or
        that it is numerically zero at 60 digits only.
    """

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
    """Prove that an expression is zero, or find that it is not.

    Parameters
    ----------
    expression : sympy.Expr
        Exact, without floating-point numbers.
    box : mapping of sympy.Symbol to (float, float)
        Where the symbols live; random points and signs are taken from there. Symbols that are
        missing are unbounded.

    Returns
    -------
    str
        ``"syntactic"``, ``"expand"``, ``"cancel"`` or ``"simplify"`` for a proof, `NUMERIC` for an
        expression that vanishes to 60 digits at random points of the box and resisted the proof,
        empty for one that is not zero. Quotients like sinc(x) = sin(x)/x are compared away from
        x = 0; what is equal there is equal at x = 0 by continuity.

    Examples
    --------
    >>> x = sp.Symbol("x", real=True)
    >>> prove_zero(sp.cos(12 * x) - 1 + 12 * x * sp.sin(6 * x) * sp.sinc(6 * x), {})
    'cancel'
    >>> prove_zero(sp.sqrt(x) - x, {x: (1, 2)})
    ''
    """
    expression = sp.sympify(expression)
    if expression == 0:
        return "syntactic"
    expression = sp.expand(quotients(expression))
    if expression == 0:
        return "expand"
    if not _vanishes(expression, box):
        return ""
    signed = _with_signs(expression, box)
    if sp.expand(signed) == 0:
        return "expand"
    for name, attempt, limit in (
        ("cancel", sp.cancel, _LARGEST_CANCEL),
        ("cancel", _cancel_exponentials, _LARGEST_EXPONENTIAL),
        ("simplify", sp.simplify, _LARGEST_SIMPLIFY),
    ):
        if signed.count_ops() > limit:
            continue
        try:
            if attempt(signed) == 0:
                return name
        except (sp.PolynomialError, NotImplementedError):
            continue
    return NUMERIC


def _cancel_exponentials(expression: sp.Expr) -> sp.Expr:
    """Cancel after writing trigonometric and hyperbolic functions as exponentials of single terms.

    Addition theorems are then identities between monomials.
    """
    written = sp.expand_log(expression).rewrite(sp.exp)
    return sp.cancel(sp.expand(written, trig=False))


def _with_signs(expression: sp.Expr, box: Box) -> sp.Expr:
    """Tell SymPy which symbols are positive over the box."""
    known = {}
    for symbol in expression.free_symbols:
        lower, _ = box.get(symbol, (-1.0, 1.0))
        if lower > 0.0:
            known[symbol] = sp.Dummy(symbol.name, positive=True)
    return expression.xreplace(known)


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


def _vanishes(expression: sp.Expr, box: Box) -> bool:
    """Tell whether an expression is zero to 60 digits, relative to its terms, at random points."""
    mpmath: Any = import_module("mpmath")
    symbols = sorted(expression.free_symbols, key=str)
    terms = sp.Add.make_args(expression)
    if not symbols:
        value = expression.evalf(_WORKING)
        return bool(abs(value) < sp.Float(10) ** -_DIGITS)
    function = sp.lambdify(symbols, list(terms), "mpmath", cse=True)
    found = 0
    with mpmath.workdps(_WORKING):
        limit = mpmath.mpf(10) ** -_DIGITS
        for point in _points(symbols, box):
            try:
                values = function(*[mpmath.mpf(int(v.p)) / int(v.q) for v in point])
                size = mpmath.fsum(abs(v) for v in values)
                total = abs(mpmath.fsum(values))
            except (ZeroDivisionError, ValueError, TypeError, OverflowError):
                continue
            if not mpmath.isfinite(size):
                continue
            if total > limit * size:
                return False
            found += 1
            if found == _POINTS:
                return True
    return False
