"""From a majorant or Jacobian bounds to the sector that multipliers weigh."""

from __future__ import annotations

from typing import Literal

import numpy as np

from obsynth.derive import Majorant, Split, majorant
from obsynth.derive.errors import DerivationError
from obsynth.designs.hinf.system import Sector

Multipliers = Literal["single", "per_row", "per_entry"]
MULTIPLIERS: tuple[Multipliers, ...] = ("single", "per_row", "per_entry")
# Covers the rounding of one square.
UP = 1.0 + 2.0**-51
# A given number such as .1089 may be the exact least value: it counts with what branch and bound
# leaves between the bounds that it proves and those that are attained.
ROOM = 1.0 + 2.0**-28


def derive_majorant(parts: Split, given: tuple[float, ...] | None = None) -> Majorant:
    """Derive M'M, or prove that a given diagonal is one."""
    if given is None:
        return majorant(parts)
    names = parts.model.names("x")
    if len(given) != len(names):
        raise DerivationError(
            f"majorant= has {len(given)} numbers; M'M has {len(names)} on its diagonal "
            f"({', '.join(names)})"
        )
    free = majorant(parts)
    needed = [bool(column.any()) for column in free.entry_bounds.T]
    for name, value, used in zip(names, given, needed, strict=True):
        if used and not value > 0.0:
            raise DerivationError(
                f"majorant= has {value} for {name}, on which g depends: it has to be positive",
                symbol=name,
            )
    fixed = {n: v * ROOM for n, v, used in zip(names, given, needed, strict=True) if used}
    return majorant(parts, fixed=fixed) if fixed else free


def build_sector(
    found: Majorant,
    multipliers: Multipliers,
    drop_zero_rows: bool,
    given: tuple[float, ...] | None = None,
) -> Sector | None:
    """Make the sector of a majorant, None where g has no part to bound."""
    n = len(found.diagonal)
    eye = np.eye(n)
    if multipliers == "single":
        rows = [part.row for part in found.rows] if drop_zero_rows else list(range(n))
        diagonal = found.diagonal if given is None else np.array(given) * ROOM
        return Sector(eye[:, rows], (0,) * len(rows), diagonal[None]) if rows else None
    if multipliers == "per_row":
        rows = [part.row for part in found.rows]
        R = np.array([part.diagonal for part in found.rows])
    else:
        rows = [part.row for part in found.rows for _ in np.flatnonzero(part.entries)]
        columns = [j for part in found.rows for j in np.flatnonzero(part.entries)]
        sizes = found.entry_bounds[rows, columns] if rows else np.zeros(0)
        R = eye[columns] * (sizes**2 * UP)[:, None]
    if not rows:
        return None
    if not drop_zero_rows:
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
