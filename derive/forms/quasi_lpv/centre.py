"""The point about which a quasi-linear form is taken."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp

from obsynth.derive.equilibrium import Equilibrium, equilibrium
from obsynth.derive.errors import DerivationError
from obsynth.derive.rigour.numbers import rational
from obsynth.symbolic.plant import Plant


@dataclass(frozen=True, eq=False)
class Centre:
    """Exact coordinates of the point about which deviations are taken.

    x, u: state and input; zeros for the origin
    """

    x: tuple[sp.Expr, ...]
    u: tuple[sp.Expr, ...]

    @property
    def is_origin(self) -> bool:
        """True when states and inputs are taken as they are."""
        return all(value == 0 for value in (*self.x, *self.u))


def deviations(model: Plant, centre: Centre) -> dict[sp.Symbol, sp.Expr]:
    """Signals whose deviation from the centre is not the signal itself, with that deviation."""
    symbols = [s.symbol for s in (*model.x, *model.u)]
    return {s: s - c for s, c in zip(symbols, (*centre.x, *centre.u), strict=True) if c != 0}


def read_centre(model: Plant, given: Any) -> Centre:
    """Read the option ``centre=``."""
    if given is None or (isinstance(given, str) and given == "origin"):
        zero = sp.Integer(0)
        return Centre((zero,) * len(model.x), (zero,) * len(model.u))
    if isinstance(given, str) and given == "equilibrium":
        given = equilibrium(model)
    if isinstance(given, Equilibrium):
        given = (given.x, given.u)
    try:
        x, u = given
        return Centre(_numbers(model, "x", x), _numbers(model, "u", u))
    except (TypeError, ValueError) as error:
        if isinstance(error, DerivationError):
            raise
        raise DerivationError(
            f"centre= is 'origin', 'equilibrium', an Equilibrium or a pair (x, u); given was "
            f"{given!r}",
            given=given,
        ) from error


def _numbers(model: Plant, kind: str, values: Any) -> tuple[sp.Expr, ...]:
    names = model.names(kind)
    listed = list(np.ravel(np.asarray(values, dtype=object)))
    exact = []
    for value in listed:
        number = sp.sympify(value) if isinstance(value, sp.Expr | int) else rational(float(value))
        exact.append(rational(float(number)) if number.is_Float else number)
    if len(exact) != len(names) or not all(n.is_finite and n.is_real for n in exact):
        raise DerivationError(
            f"the centre needs one finite number for each of {', '.join(names) or 'no signals'}; "
            f"given was {listed}",
            symbols=names,
        )
    return tuple(exact)
