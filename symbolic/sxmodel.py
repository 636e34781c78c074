"""A plant as CasADi SX expressions, and the check that it is what was typed.

Is the derived form of an equation the same function as what the user typed?

SymPy expressions are evaluated with mpmath at 100 bits by a walk of its own, which
shares nothing with the conversion it checks.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import casadi as ca
import mpmath
import numpy as np
import sympy as sp
from numpy.typing import NDArray
from sympy.core.relational import Relational
from sympy.logic.boolalg import And, Not, Or

from obsynth.symbolic.convert import column, to_sx
from obsynth.symbolic.discretise import PREFIX, Step, composed
from obsynth.symbolic.errors import ObsynthError, PlantError
from obsynth.symbolic.signals import KINDS

if TYPE_CHECKING:
    from obsynth.symbolic.plant import Plant


POINTS = 64
"""Random points of the box at which two forms are compared."""

TOLERANCE = 1e-12
"""Largest difference, relative to the row's value and to what cancels in it."""

_BITS = 100
_PERTURBATION = mpmath.mpf(2) ** -50
# What an operation loses by underflow, as the size of a number that it is a rounding error of.
_UNDERFLOW = mpmath.mpf(2) ** -1022 / TOLERANCE


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
    """Compare expressions with numbers computed from their other form, (k,) -> (rows,).

    points: where, (count, k), in the order of the symbols; one at which neither form is defined is
        passed over
    labels: names of the rows

    ParityError where a row differs by more than `TOLERANCE`, or is defined in one form only.
    """
    for point in points:
        values = np.ravel(derived(point))
        with mpmath.workprec(_BITS):
            evaluator = _Evaluator(dict(zip(symbols, map(mpmath.mpf, point), strict=True)))
            for row, label, value in zip(expressions, labels, values, strict=True):
                _compare(evaluator, row, label, float(value), symbols, point)


def _compare(
    evaluator: _Evaluator,
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
    """Values of sub-expressions with the magnitude that rounding errors are relative to."""

    def __init__(self, values: Mapping[sp.Symbol, Any]) -> None:
        self.values = values
        self.done: dict[sp.Basic, tuple[Any, Any]] = {}

    def visit(self, node: sp.Expr) -> tuple[Any, Any]:
        if node not in self.done:
            value, magnitude = self._build(node)
            self.done[node] = _real(value), max(magnitude, _UNDERFLOW) if value else magnitude
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


@dataclass(frozen=True, eq=False)
class SxModel:
    """SX columns of a plant's signals, its right-hand side and its output.

    Parameters
    ----------
    name : str
        The plant's name as an identifier.
    x, u, d, f, w, p, rho, c : casadi.SX
        Columns of symbols; ``c`` holds the constants and is empty where their values
        stand in the equations.
    rhs : casadi.SX
        (n, 1): time derivative, or next state of a discrete plant.
    y : casadi.SX
        (m, 1): measured outputs.
    """

    name: str
    x: ca.SX
    u: ca.SX
    d: ca.SX
    f: ca.SX
    w: ca.SX
    p: ca.SX
    rho: ca.SX
    c: ca.SX
    rhs: ca.SX
    y: ca.SX

    def function(self) -> ca.Function:
        """Return (x, u, d, f, w, p, rho[, c]) -> (rhs, y); c only where it is not empty."""
        kinds = [*KINDS, "c"] if self.c.numel() else list(KINDS)
        arguments = [getattr(self, kind) for kind in kinds]
        return ca.Function(self.name, arguments, [self.rhs, self.y], kinds, ["rhs", "y"])


def build_sx(plant: Plant, constants: Literal["value", "symbol"]) -> SxModel:
    """Convert a complete plant to SX and compare the two forms at random points.

    Of a step of higher order the derivatives are compared, from which it is composed in SX.
    """
    if constants not in ("value", "symbol"):
        raise PlantError(f"constants= is 'value' or 'symbol', not {constants!r}")
    original, step = plant.continuous, plant.step
    if original is not None and step is not None and step.method != "euler":
        return _composed(original.sx(constants), plant, step)
    columns = {kind: [ca.SX.sym(name) for name in plant.names(kind)] for kind in KINDS}
    values = plant.constant_values
    columns["c"] = []
    rows = [*plant.rhs, *plant.output]
    signals = [signal for kind in KINDS for signal in getattr(plant, kind)]
    if constants == "symbol":
        columns["c"] = [ca.SX.sym(str(symbol)) for symbol in values]
        signals += plant.constants
    else:
        rows = [row.xreplace(values) for row in rows]
    flat = [item for items in columns.values() for item in items]
    n = len(plant.x)
    labels = [f"dynamics row {k}" for k in range(1, n + 1)]
    labels += [f"outputs row {k}" for k in range(1, len(rows) - n + 1)]
    symbols = dict(zip((signal.symbol for signal in signals), flat, strict=True))
    found = to_sx(rows, symbols, labels)

    function = ca.Function("rows", [column(flat)], [column(found)])
    box = np.array([(signal.lower, signal.upper) for signal in signals])
    centre = [0.0 if signal.nominal is None else signal.nominal for signal in signals]
    points = sample_box(box, around=centre)
    check_parity(rows, list(symbols), lambda point: np.array(function(point)), points, labels)

    stacked = {kind: column(items) for kind, items in columns.items()}
    name = _identifier(plant.name)
    return SxModel(name=name, rhs=column(found[:n]), y=column(found[n:]), **stacked)


def _composed(model: SxModel, plant: Plant, step: Step) -> SxModel:
    """Return the model of a step of another's right-hand side, with its remainder."""
    rhs = composed(step, model.x, model.rhs, plant.Ts)
    carriers = {signal.name: ca.SX.sym(signal.name) for signal in plant.remainder or ()}
    rest = [carriers.get(PREFIX + name, 0) for name in plant.names("x")]
    return replace(model, rhs=rhs + ca.vertcat(*rest), w=ca.vertcat(model.w, *carriers.values()))


def _identifier(name: str) -> str:
    plain = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_")
    return plain if plain[:1].isalpha() else f"plant_{plain}".strip("_")
