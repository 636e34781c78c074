"""The sector that multipliers weigh: what it says, and how it is made from a majorant."""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from obsynth.derive import Majorant
from obsynth.symbolic.arrays import FloatArray

Multipliers = Literal["single", "per_row", "per_entry"]
# Covers the rounding of one square.
UP = 1.0 + 2.0**-51
# A given number such as .1089 may be the exact least value: it counts with what branch and bound
# leaves between the bounds that it proves and those that are attained.
ROOM = 1.0 + 2.0**-28


@dataclass(frozen=True, eq=False)
class SectorForm:
    """How a nonlinearity is bounded by a sector.

    multipliers: how finely
    drop_zero_rows: whether rows of g that are zero are left out
    given: diagonal of M'M where it is given and only proved
    """

    multipliers: Multipliers
    drop_zero_rows: bool = True
    given: tuple[float, ...] | None = None


@dataclass(frozen=True, eq=False)
class Sector:
    """What the nonlinearity may do: s = E phi, |phi of group g|^2 <= e' diag(R_g) e.

    E: where every phi enters
    group: group of every phi; one multiplier per group
    """

    E: Annotated[FloatArray, "n k"]
    group: tuple[int, ...]
    R: Annotated[FloatArray, "groups n"]

    @property
    def groups(self) -> int:
        """Number of multipliers."""
        return len(self.R)

    def mask(self, number: int) -> FloatArray:
        """Return the diagonal matrix that picks the phi of one group."""
        return np.diag([1.0 if g == number else 0.0 for g in self.group])


def build_sector(found: Majorant, form: SectorForm) -> Sector | None:
    """Make the sector of a majorant, None where g has no part to bound."""
    n = len(found.diagonal)
    eye = np.eye(n)
    if form.multipliers == "single":
        rows = [part.row for part in found.rows] if form.drop_zero_rows else list(range(n))
        diagonal = found.diagonal if form.given is None else np.array(form.given) * ROOM
        return Sector(eye[:, rows], (0,) * len(rows), diagonal[None]) if rows else None
    if form.multipliers == "per_row":
        rows = [part.row for part in found.rows]
        R = np.array([part.diagonal for part in found.rows])
    else:
        rows = [part.row for part in found.rows for _ in np.flatnonzero(part.entries)]
        columns = [j for part in found.rows for j in np.flatnonzero(part.entries)]
        sizes = found.entry_bounds[rows, columns] if rows else np.zeros(0)
        R = eye[columns] * (sizes**2 * UP)[:, None]
    if not rows:
        return None
    if not form.drop_zero_rows:
        rest = [i for i in range(n) if i not in rows]
        rows, R = rows + rest, np.vstack([R, np.zeros((len(rest), n))])
    return Sector(eye[:, rows], tuple(range(len(rows))), R)


def covers_sector(stored: Sector, derived: Sector | None) -> tuple[bool, float]:
    """Whether a stored sector holds a derived one, and by how much its R is larger."""
    if derived is None:
        return True, float(stored.R.min(initial=0.0))
    if not (np.array_equal(stored.E, derived.E) and stored.group == derived.group):
        return False, -np.inf
    room = float((stored.R - derived.R).min(initial=np.inf))
    return room >= 0.0, room
