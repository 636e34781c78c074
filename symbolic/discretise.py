"""From derivatives to next values: Euler's and the classical Runge-Kutta formula."""

from collections.abc import Callable, Sequence
from typing import Any

import sympy as sp

from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.signals import exact_number

METHODS = ("euler", "rk4")
"""The methods by name."""


def sampling_time(Ts: Any) -> sp.Expr:
    """Read a sampling time in seconds."""
    number = exact_number(Ts, "Ts")
    if not number.is_positive:
        raise PlantError(f"the sampling time Ts={Ts} is not positive", Ts=Ts)
    if isinstance(number, sp.Float):
        exact = sp.Rational(float(number))
        return exact if exact.q <= 2**20 else number
    return number


def check_method(method: str) -> str:
    """Return the name of a method, or refuse it with the names there are."""
    if method not in METHODS:
        raise PlantError(
            f"discretisation {method!r} is unknown; methods are {', '.join(METHODS)}",
            method=method,
        )
    return method


def next_values(
    method: str, x: Sequence[sp.Symbol], rates: Sequence[sp.Expr], step: sp.Expr
) -> tuple[sp.Expr, ...]:
    """Return the next value of every state, everything else held over the step."""
    state, derivative = sp.Matrix(x), sp.Matrix(rates)
    if method == "euler":
        return tuple(state + step * derivative)

    def at(point: sp.Matrix) -> sp.Matrix:
        return derivative.xreplace(dict(zip(x, point, strict=True)))

    return tuple(runge_kutta(at, state, step))


def runge_kutta(rates: Callable[[Any], Any], x: Any, step: Any) -> Any:
    """Return one step of the classical formula of order four."""
    k1 = rates(x)
    k2 = rates(x + step / 2 * k1)
    k3 = rates(x + step / 2 * k2)
    k4 = rates(x + step * k3)
    return x + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
