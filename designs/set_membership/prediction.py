"""How wide the sets become: the generators of the bank followed at the point of operation.

The step's recursion in numbers and without its rounding, readings in the middle of their strips.
Nothing that is proved rests on it; it chooses among gains, coordinates and numbers of columns.
"""

import math
from dataclasses import dataclass

import numpy as np

from obsynth.designs.set_membership.model import Around, SetMembershipModel
from obsynth.symbolic.arrays import FloatArray

LONGEST = 300
_STEADY, _SLOWEST = 1e-3, 1.0 - 1e-4
_MOVED = 0.02
"""Share of a box by which it changes before the equations are enclosed anew."""


@dataclass(frozen=True, eq=False)
class Bank:
    """A choice: gain (N, m), coordinates and their inverse (N, N), columns, zonotopes, restart."""

    L: FloatArray
    V: FloatArray
    W: FloatArray
    columns: int
    zonotopes: int
    restart: int


@dataclass(frozen=True, eq=False)
class Predicted:
    """Mean half widths over the last round, states then faults, and the calls to settle."""

    widths: FloatArray
    calls: int


def predict(
    model: SetMembershipModel,
    bank: Bank,
    held: FloatArray,
    share: float = 1.0,
    calls: int = LONGEST,
) -> Predicted:
    """Follow half widths from a share of the declared ranges, held or less, to rest."""
    n, n_f = len(model.plant.x), len(model.plant.f)
    free = model.enclosures.free
    declared = 0.5 * np.diff(model.box[: n + n_f], axis=1)[:, 0]
    declared = np.minimum(declared, held)
    limit = np.concatenate([declared[:n], declared[n:][model.followed]])
    z = share * np.minimum(limit, 1e6 * model.half)
    found = [_filled(np.diag(z), bank.columns) for _ in range(1 + bank.zonotopes)]
    beside, late = model.beside.copy(), declared[n:].copy()
    guessed = _guessed(model)
    history: list[FloatArray] = []
    period = max(bank.restart, 20) if bank.zonotopes else 20
    seen = np.zeros(len(z) + len(beside))
    for call in range(calls):
        boxes = np.append(z, beside)
        if np.any(np.abs(boxes - seen) > _MOVED * seen):
            around, seen = model.around(z, beside), boxes
        before, z = z, limit
        moved = [_moved(around, G) for G in found]
        for G in (*moved[1:], _moved(around, np.diag(before))):
            z = np.minimum(z, _cut(G, G, around))
        corrected = moved[0] - bank.L @ (around.H @ moved[0])
        corrected = np.hstack([bank.L * around.sigma, corrected])
        z = np.minimum(z, np.minimum(np.abs(moved[0]).sum(axis=1), np.abs(corrected).sum(axis=1)))
        for k, j in enumerate(free):
            row = np.zeros((1, moved[0].shape[1]))
            row[0, k] = beside[n + j]
            late[j] = min(declared[n + j], *(float(_cut(row, G, around)[0]) for G in moved))
        for j in guessed:
            beside[j] = _inverted(model, around, j, beside, before, z)
        kept = [_reduced(bank, corrected)]
        for number, G in enumerate(moved[1:]):
            again = call % bank.restart == (number * bank.restart) // bank.zonotopes
            kept.append(_filled(np.diag(z), bank.columns) if again else _reduced(bank, G))
        found = kept
        shown = late.copy()
        shown[model.followed] = z[n:]
        history.append(np.concatenate([z[:n], shown]))
        if len(history) > 2 * period and not len(history) % period:
            new, old = (np.mean(history[-k * period :][:period], axis=0) for k in (1, 2))
            if not np.all(np.isfinite(new)) or np.all(np.abs(new - old) <= _STEADY * old):
                break
    else:
        # what the slowest mode needs
        closed = (np.eye(len(z)) - bank.L @ around.H) @ around.J
        rho = min(float(np.abs(np.linalg.eigvals(closed)).max()), _SLOWEST)
        calls = max(calls, math.ceil(math.log(_STEADY) / math.log(rho))) if rho > 0.0 else calls
        return Predicted(np.mean(history[-period:], axis=0), calls)
    return Predicted(np.mean(history[-period:], axis=0), len(history))


def _guessed(model: SetMembershipModel) -> list[int]:
    """Variables whose boxes follow from what they did: free faults and inputs without a range."""
    n = len(model.plant.x)
    half = 0.5 * np.diff(model.box, axis=1)[:, 0]
    loose = [j for j in model.enclosures.beside if half[j] > 1e90]
    return sorted({*loose, *(n + j for j in model.enclosures.free)})


def _inverted(
    model: SetMembershipModel,
    around: Around,
    j: int,
    beside: FloatArray,
    before: FloatArray,
    z: FloatArray,
) -> float:
    """Return what the states say of a variable beside them, one call late."""
    own = model.slopes[:, j] * beside[j]
    total = np.abs(around.columns).sum(axis=1) + around.spread - own
    rest = z + np.abs(around.J) @ before + np.maximum(total, 0.0)
    seen = own > 1e-12 * model.half
    told = beside[j] * float(np.min(rest[seen] / own[seen], initial=np.inf))
    limit = 0.5 * float(model.box[j, 1] - model.box[j, 0])
    return float(np.clip(told, 1e-3 * beside[j], min(2.0 * beside[j], limit)))


def _moved(around: Around, G: FloatArray) -> FloatArray:
    return np.hstack([around.columns, np.diag(around.spread), around.J @ G])


def _filled(G: FloatArray, columns: int) -> FloatArray:
    return np.hstack([G, np.zeros((len(G), columns - G.shape[1]))])


def _cut(rows: FloatArray, G: FloatArray, around: Around) -> FloatArray:
    """Return the least reach of rows over single strips, see `zonotope.cut`."""
    best = np.abs(rows).sum(axis=1)
    for a, sigma in zip(around.H @ G, around.sigma, strict=True):
        lam = rows @ a / (a @ a + sigma**2 + 1e-300)
        reach = np.abs(rows - lam[:, None] * a).sum(axis=1) + np.abs(lam) * sigma
        best = np.minimum(best, reach)
    return np.asarray(best)


def _reduced(bank: Bank, G: FloatArray) -> FloatArray:
    keep = bank.columns - len(G)
    box = bank.V * np.abs(bank.W @ G[:, keep:]).sum(axis=1)
    return np.hstack([box, G[:, :keep]])
