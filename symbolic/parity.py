"""Is the derived form of an equation the same function as what the user typed?

SymPy expressions are evaluated with mpmath at 100 bits by a walk of its own, which
shares nothing with the conversion it checks.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mpmath
import numpy as np
import sympy as sp
from numpy.typing import NDArray
from sympy.core.relational import Relational
from sympy.logic.boolalg import And, Not, Or

from obsynth.symbolic.errors import ObsynthError

POINTS = 64
"""Random points of the box at which two forms are compared."""

TOLERANCE = 1e-12
"""Largest difference, relative to the row's value and to what cancels in it."""

_BITS = 100
_PERTURBATION = mpmath.mpf(2) ** -50


class ParityError(ObsynthError):
    """Two forms of the same equation differ; ``row`` and ``point`` say where."""


def sample_box(
    box: NDArray[np.float64], count: int = POINTS, seed: int = 0, around: Any = None
) -> NDArray[np.float64]:
    """Return random points of a box; an infinite side becomes [-1, 1] about its nominal value."""
    centre = np.zeros(len(box)) if around is None else np.asarray(around, dtype=np.float64)
    finite = np.isfinite(box).all(axis=1)
    lower = np.where(finite, box[:, 0], centre - 1.0)
    upper = np.where(finite, box[:, 1], centre + 1.0)
    return np.random.default_rng(seed).uniform(lower, upper, (count, len(box)))


def check_parity(
    expressions: Sequence[sp.Expr],
    symbols: Sequence[sp.Symbol],
    derived: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    points: NDArray[np.float64],
    labels: Sequence[str],
) -> None:
    """Compare expressions with numbers computed from their other form.

    Parameters
    ----------
    expressions : sequence of sympy.Expr
        The rows.
    symbols : sequence of sympy.Symbol, length k
        The symbols the columns of ``points`` belong to.
    derived : callable
        Maps one point (k,) to the values (rows,) of the other form.
    points : array (count, k)
        Where to compare. A point at which both forms are undefined is passed over.
    labels : sequence of str
        Names of the rows, for messages.

    Raises
    ------
    ParityError
        A row differs by more than ``TOLERANCE``, or is defined in one form only.

    Examples
    --------
    >>> x = sp.Symbol("x", real=True)
    >>> check_parity([x**2], [x], lambda v: v * v, np.array([[0.5], [2.0]]), ["row 1"])
    """
    for point in points:
        values = np.ravel(derived(point))
        with mpmath.workprec(_BITS):
            evaluator = _Evaluator(dict(zip(symbols, map(mpmath.mpf, point), strict=True)))
            for row, label, value in zip(expressions, labels, values, strict=True):
                _compare(evaluator, row, label, float(value), symbols, point)


def _compare(
    evaluator: "_Evaluator",
    row: sp.Expr,
    label: str,
    value: float,
    symbols: Sequence[sp.Symbol],
    point: NDArray[np.float64],
) -> None:
    try:
        exact, magnitude = evaluator.visit(row)
        defined = mpmath.isfinite(exact)
    except (ArithmeticError, ValueError, TypeError):
        exact, magnitude, defined = mpmath.nan, mpmath.nan, False
    if not defined and not np.isfinite(value):
        return
    if defined and np.isfinite(value) and abs(exact - value) <= TOLERANCE * magnitude:
        return
    used = row.free_symbols
    place = {str(s): float(v) for s, v in zip(symbols, point, strict=True) if s in used}
    raise ParityError(
        f"{label}: the SymPy form is {mpmath.nstr(exact, 17) if defined else 'no real number'} "
        f"and the CasADi form {value!r} at "
        + ", ".join(f"{name} = {v!r}" for name, v in place.items())
        + f"; the row is {row}",
        row=label,
        point=place,
        sympy_value=float(exact) if defined else float("nan"),
        casadi_value=value,
    )


def _real(value: Any) -> Any:
    if isinstance(value, mpmath.mpc):
        raise ValueError("not real")
    return value


def _quotient_at_zero(numerator: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda x: mpmath.mpf(1) if x == 0 else numerator(x) / x


_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "Abs": abs,
    "sign": mpmath.sign,
    "ceiling": mpmath.ceil,
    "Max": max,
    "Min": min,
    "Heaviside": lambda x, middle: mpmath.mpf(x > 0) if x != 0 else middle,
    "sinc": _quotient_at_zero(mpmath.sin),
    "phi1": _quotient_at_zero(mpmath.expm1),
    "tanhc": _quotient_at_zero(mpmath.tanh),
}
_COMPARE: dict[Any, Callable[[Any, Any], bool]] = {
    sp.Lt: lambda a, b: a < b,
    sp.Le: lambda a, b: a <= b,
    sp.Gt: lambda a, b: a > b,
    sp.Ge: lambda a, b: a >= b,
    sp.Eq: lambda a, b: a == b,
    sp.Ne: lambda a, b: a != b,
}


class _Evaluator:
    """Values of sub-expressions with the magnitude of what went into them.

    The magnitude is what rounding errors are relative to: terms of a sum add up without
    their signs, and a function passes on what a change of its arguments does to it.
    """

    def __init__(self, values: Mapping[sp.Symbol, Any]) -> None:
        self.values = values
        self.done: dict[sp.Basic, tuple[Any, Any]] = {}

    def visit(self, node: sp.Expr) -> tuple[Any, Any]:
        if node not in self.done:
            value, magnitude = self._build(node)
            self.done[node] = _real(value), magnitude
        return self.done[node]

    def _build(self, node: sp.Expr) -> tuple[Any, Any]:
        if isinstance(node, sp.Symbol):
            return self.values[node], abs(self.values[node])
        if node.is_number:
            value = _constant(node)
            return value, abs(value)
        if isinstance(node, sp.Piecewise):
            chosen = next(e for e, condition in node.args if self._holds(condition))
            return self.visit(chosen)
        parts = [self.visit(argument) for argument in node.args]
        if isinstance(node, sp.Add):
            return mpmath.fsum(v for v, _ in parts), mpmath.fsum(m for _, m in parts)
        if isinstance(node, sp.Mul):
            value = mpmath.fprod(v for v, _ in parts)
            return value, mpmath.fprod(m for _, m in parts)
        function = _function(node)
        values = [v for v, _ in parts]
        value = function(*values)
        magnitude = abs(value)
        for k, (v, m) in enumerate(parts):
            moved = [*values[:k], v + m * _PERTURBATION, *values[k + 1 :]]
            magnitude += abs(function(*moved) - value) / _PERTURBATION
        return value, magnitude

    def _holds(self, condition: sp.Basic) -> bool:
        if isinstance(condition, And):
            return all(self._holds(part) for part in condition.args)
        if isinstance(condition, Or):
            return any(self._holds(part) for part in condition.args)
        if isinstance(condition, Not):
            return not self._holds(condition.args[0])
        if isinstance(condition, Relational):
            left, right = self.visit(condition.lhs)[0], self.visit(condition.rhs)[0]
            return _COMPARE[condition.func](left, right)
        if condition in (sp.true, sp.false):
            return bool(condition)
        raise ParityError(f"the condition {condition} cannot be evaluated", condition=condition)


def _function(node: sp.Expr) -> Callable[..., Any]:
    if isinstance(node, sp.Pow):
        return lambda base, exponent: mpmath.power(base, exponent)
    name = node.func.__name__
    return _FUNCTIONS[name] if name in _FUNCTIONS else getattr(mpmath, name)


def _constant(node: sp.Expr) -> Any:
    if isinstance(node, sp.Rational):
        return mpmath.mpf(int(node.p)) / int(node.q)
    return mpmath.mpf(sp.Float(node.evalf(40), 40)._mpf_)
