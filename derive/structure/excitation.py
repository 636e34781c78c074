"""When a fault can be identified: what its effect depends on, and how much has to move."""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import sympy as sp

from obsynth.derive.algebra.linear_parts import slope
from obsynth.derive.jacobian.entries import matrix_entries
from obsynth.derive.rigour import substitute
from obsynth.derive.structure.frozen import Frozen, balls, freeze, precision, rank
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.shown import Shown
from obsynth.symbolic.taking import takes

_MOST_POINTS = 6


@dataclass(frozen=True, eq=False)
class FaultEffect:
    """How a fault enters: the derivative of dynamics, then outputs, by it, at fault zero.

    depends_on: signals that occur in it; empty for an additive fault
    floor: guaranteed lower bound of its norm over the box; None without finite ranges
    at: where the norm is smallest, as far as found
    """

    fault: str
    column: sp.Matrix
    depends_on: tuple[str, ...]
    floor: float | None
    at: dict[str, float]

    @property
    def always(self) -> bool:
        """True when the effect vanishes nowhere in the box, provably."""
        return self.floor is not None and self.floor > 0.0

    def __str__(self) -> str:
        if not any(self.column):
            return f"{self.fault} has no effect at all"
        if not self.depends_on:
            return f"{self.fault} enters with constant coefficients"
        by = ", ".join(self.depends_on)
        if self.always:
            return (
                f"{self.fault} acts everywhere in the box (through {by}; at least {self.floor:.3g})"
            )
        where = ", ".join(f"{k} = {v:.4g}" for k, v in self.at.items())
        return f"{self.fault} acts through {by} and fades at {where}: keep away from there"


@dataclass(frozen=True, eq=False, repr=False)
class Excitation(Shown):
    """What has to move for constant faults to be identified together.

    visible_at_rest: how many combinations of constant faults one operating point shows points: how
    many operating points show all of them, None beyond ``limit``
    """

    effects: tuple[FaultEffect, ...]
    visible_at_rest: int
    points: int | None
    limit: int

    @property
    def condition(self) -> str:
        """What the inputs have to do, as a sentence."""
        count = len(self.effects)
        if not count:
            return "no faults"
        names = ", ".join(e.fault for e in self.effects)
        if self.points == 1:
            verb = "shows" if count == 1 else "show"
            return f"constant {names} {verb} with constant inputs; nothing has to move"
        if self.points is not None:
            return (
                f"one operating point shows {self.visible_at_rest} of {count} constant faults: the "
                f"plant has to move between at least {self.points} of them (persistent excitation "
                f"of order {self.points})"
            )
        return (
            f"one operating point shows {self.visible_at_rest} of {count} constant faults and no "
            f"excitation adds the others ({self.limit} points tried): estimate fewer at a time, or "
            "measure more"
        )

    def __str__(self) -> str:
        return "\n".join([self.condition, *(str(effect) for effect in self.effects)])


@takes(model="Plant")
def excitation(model: Plant) -> Excitation:
    """Derive the conditions under which faults can be identified.

    A constant fault f at a point of operation moves states and outputs by a constant, so that all
    that one point shows of the faults is [B_f; D_f] outside the range of [A, D; C, C_d] (A - I in
    discrete time). Where coefficients depend on the state or on the inputs, a second point shows
    another combination: the number of points needed is the order of excitation. Ranks are taken
    at random points of the box in 40 digits; for a discretised plant the continuous one is looked
    at.

    Parameters
    ----------
    model : Plant
        Any plant.

    Returns
    -------
    Excitation
        Effects one by one, and the condition for all together.

    Raises
    ------
    DerivationError
        Derivatives that are not finite inside the box.

    Examples
    --------
    >>> from obsynth.symbolic.plants import quadruple_tank
    >>> found = excitation(quadruple_tank())
    >>> found.points, str(found.effects[0])
    (1, 'f1 enters with constant coefficients')
    """
    # the equations of a continuous plant are shorter than those of its step
    plant = model.check().continuous or model
    names = plant.names("f")
    if not names:
        return Excitation((), 0, 1, 0)
    effects = tuple(_effect(plant, k) for k in range(len(names)))
    limit = min(len(names) + 1, _MOST_POINTS)
    points = freeze(plant, limit)
    with precision():
        shown = [_shown(points[:count], plant.Ts is not None) for count in range(1, limit + 1)]
    enough = [count for count, seen in enumerate(shown, start=1) if seen == len(names)]
    return Excitation(effects, shown[0], min(enough, default=None), limit)


def _effect(plant: Plant, index: int) -> FaultEffect:
    signal = plant.f[index]
    quiet = {s.symbol: sp.Integer(0) for kind in ("f", "w") for s in getattr(plant, kind)}
    rows = [*plant.rhs, *plant.output]
    column = sp.Matrix(
        [substitute(slope(row, signal.symbol), plant.constant_values).subs(quiet) for row in rows]
    )
    depends = sorted({str(s) for s in column.free_symbols})
    entries = matrix_entries({(i, 0): column[i] for i in range(len(rows))}, plant)
    if not entries.exact:
        return FaultEffect(signal.name, column, (), 0.0, {})
    floor: float | None = None
    at: dict[str, float] = {}
    if np.isfinite(entries.box).all():
        found = entries.search(1e-8, "fast", ca.sumsqr(entries.values))
        if not found.failures:
            floor = float(np.nextafter(np.sqrt(max(float(found.lower[0]), 0.0)), 0.0))
            at = entries.named(found.points_lower[0])
    return FaultEffect(signal.name, column, tuple(depends), floor, at)


def _shown(points: list[Frozen], discrete: bool) -> int:
    """How many combinations of constant faults some operating points show together."""
    n, q = points[0].A.rows, points[0].D.cols
    height = n + points[0].C.rows
    without: list[list[Any]] = []
    with_faults: list[list[Any]] = []
    for index, frozen in enumerate(points):
        A = frozen.A - sp.eye(n) if discrete else frozen.A
        left = balls(A.row_join(frozen.D).col_join(frozen.C.row_join(frozen.C_d)))
        right = balls(frozen.B_f.col_join(frozen.D_f))
        for i in range(height):
            row: list[Any] = [0] * (len(points) * (n + q))
            row[index * (n + q) : (index + 1) * (n + q)] = [left[i, j] for j in range(n + q)]
            without.append(row)
            with_faults.append([*row, *(right[i, j] for j in range(right.ncols()))])
    return rank(with_faults) - rank(without)
