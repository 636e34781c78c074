"""From derivatives to next values: Euler's and the classical Runge-Kutta formula."""

from typing import TYPE_CHECKING, Any

import sympy as sp

from obsynth.symbolic.declare import exact_number
from obsynth.symbolic.errors import PlantError

if TYPE_CHECKING:
    from obsynth.symbolic.plant import Plant

__all__ = ["METHODS", "discrete_rows", "sampling_time"]

METHODS = ("euler", "rk4")
"""The methods by name."""


def sampling_time(Ts: Any) -> sp.Expr:
    """Read a sampling time in seconds.

    Parameters
    ----------
    Ts : float, int, Fraction or sympy number
        A float that is a short binary fraction (1.0, 0.5, 0.125) is taken as that
        rational, so that exact coefficients stay exact; other floats keep their double.

    Returns
    -------
    sympy.Expr
        A positive number.

    Raises
    ------
    PlantError
        Not a finite positive number.

    Examples
    --------
    >>> sampling_time(0.5), sampling_time(sp.Rational(1, 10))
    (1/2, 1/10)
    """
    number = exact_number(Ts, "Ts")
    if not number.is_positive:
        raise PlantError(f"the sampling time Ts={Ts} is not positive", Ts=Ts)
    if isinstance(number, sp.Float):
        exact = sp.Rational(float(number))
        return exact if exact.q <= 2**20 else number
    return number


def discrete_rows(plant: "Plant", method: str, Ts: Any) -> tuple[tuple[sp.Expr, ...], sp.Expr]:
    """Discretise the dynamics of a continuous plant, its inputs held over a step.

    Whatever stands in the dynamics (unknown inputs, disturbances, faults) is multiplied
    by Ts with them.

    Parameters
    ----------
    plant : Plant
        A complete continuous plant.
    method : str
        ``"euler"`` or ``"rk4"``.
    Ts : float or sympy.Rational
        Sampling time in seconds.

    Returns
    -------
    tuple of sympy.Expr
        The next value of every state, before faults are inserted.
    sympy.Expr
        The sampling time as an exact number.

    Raises
    ------
    PlantError
        The plant is discrete, the method unknown, Ts not positive.
    """
    if method not in METHODS:
        raise PlantError(
            f"discretisation {method!r} is unknown; methods are {', '.join(METHODS)}",
            method=method,
        )
    if plant.Ts is not None:
        raise PlantError(f"plant {plant.name!r} is discrete already (Ts = {plant.Ts} s)")
    step = sampling_time(Ts)
    rates = sp.Matrix(plant._dynamics)
    x = sp.Matrix([signal.symbol for signal in plant.x])
    rows = x + step * rates if method == "euler" else _rk4(x, rates, step)
    return tuple(rows), step


def _rk4(x: sp.Matrix, rates: sp.Matrix, step: sp.Expr) -> sp.Matrix:
    def at(point: sp.Matrix) -> sp.Matrix:
        return rates.xreplace(dict(zip(x, point, strict=True)))

    k1 = rates
    k2 = at(x + step / 2 * k1)
    k3 = at(x + step / 2 * k2)
    k4 = at(x + step * k3)
    return x + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
