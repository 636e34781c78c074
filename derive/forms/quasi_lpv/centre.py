"""The point about which a quasi-linear form is taken, and the signs that the box decides there."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp

from obsynth.derive.equilibrium import Equilibrium, equilibrium
from obsynth.derive.errors import DerivationError
from obsynth.derive.jacobian.matrix_entries import matrix_entries
from obsynth.derive.rigour import rational
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


def decide_signs(rows: Sequence[sp.Expr], model: Plant, centre: Centre) -> list[sp.Expr]:
    """Write sign(g) and |g| without a kink where g keeps its sign on the box and at the centre.

    A secant from the centre to a point of the box exists in closed form only for what is smooth
    between them.
    """
    kinked = sorted(
        {a for row in rows for a in row.atoms(sp.sign, sp.Abs)}, key=sp.default_sort_key
    )
    inner = list(dict.fromkeys(atom.args[0] for atom in kinked))
    if not inner:
        return list(rows)
    symbols = [s.symbol for s in (*model.x, *model.u)]
    at = dict(zip(symbols, (*centre.x, *centre.u), strict=True))
    entries = matrix_entries({(0, k): g for k, g in enumerate(inner)}, model)
    found = entries.search(1e-2, "fast")
    signs: dict[sp.Expr, int] = {}
    for k, (_, position) in enumerate(entries.places):
        value = inner[position].xreplace(at)
        if found.lower[k] > 0.0 and value.is_positive:
            signs[inner[position]] = 1
        elif found.upper[k] < 0.0 and value.is_negative:
            signs[inner[position]] = -1
    replacements = {
        atom: signs[g] * (g if isinstance(atom, sp.Abs) else 1)
        for atom in kinked
        if (g := atom.args[0]) in signs
    }
    return [row.xreplace(replacements) for row in rows]
