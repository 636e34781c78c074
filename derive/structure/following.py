"""Which faults of a plant of the general class can be followed as states, and why others cannot."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import casadi as ca
import numpy as np

from obsynth.derive.errors import StructureError
from obsynth.derive.forms.extended import Extended, extend
from obsynth.derive.jacobian.bounds import JacobianBounds, jacobian_bounds
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.plant import Plant

RTOL = 1e-3
"""Of the bounds of the joint Jacobian."""
NO_RATE = "it has no rate"
MOST_FREE = 6
"""Signals along which a point of the box is looked for, three values each."""
_DECAYS = 1.0 - 1e-7
_HIDDEN = 1e-8


@dataclass(frozen=True, eq=False)
class Following:
    """An extended plant, its joint Jacobian, and why faults that are not followed are not."""

    extended: Extended
    bounds: JacobianBounds
    reasons: Mapping[str, str]

    def __str__(self) -> str:
        plant, followed = self.extended.plant, self.extended.followed
        lines = []
        if self.extended.free:
            directions = self.extended.D0.shape[1]
            lines.append(
                f"{', '.join(self.extended.free)} of any size taken away in {directions} constant "
                f"direction{'s' if directions > 1 else ''}"
            )
        if followed:
            lines.append(f"{', '.join(followed)} followed as a state, by the rate")
        lines += [f"{name} not followed: {reason}" for name, reason in self.reasons.items()]
        lines.append(f"disturbances: {', '.join(plant.names('w')) or 'none'}")
        scalars = int((self.bounds.family.half_ranges > 0.0).sum())
        lines.append(f"{scalars} scalars vary in the Jacobian of rows and outputs")
        return "; ".join(lines)


def follow(model: Plant, divided: Sequence[str] = (), bounded: Sequence[str] = ()) -> Following:
    """Follow the faults that the outputs tell from the states, at the middle of the family.

    divided, bounded: faults that are not to be followed, see `extend`. StructureError where states
    alone cannot be detected, or where faults to be divided act in too few directions.
    """
    extended = extend(model, bounded, divided)
    free, rank = extended.free, extended.D0.shape[1]
    if divided and rank < len(free):
        raise StructureError(
            f"{', '.join(free)} act in {rank} direction{'s' if rank > 1 else ''} on the "
            "states: of any size they cannot be told apart",
            symbols=free,
            condition="faults in different directions",
        )
    bounds = jacobian_bounds(extended.plant, wrt="joint", rtol=RTOL, effort="fast")
    hidden = untold(extended, bounds.family.midpoint)
    if hidden:
        extended = extend(model, (*bounded, *hidden), divided)
        bounds = jacobian_bounds(extended.plant, wrt="joint", rtol=RTOL, effort="fast")
    rateless = [s for s in model.f if s.rate is None and not s.constant]
    reasons = hidden | {s.name: NO_RATE for s in rateless if s.name not in (*divided, *bounded)}
    return Following(extended, bounds, reasons)


def untold(extended: Extended, middle: FloatArray, again: Sequence[str] = ()) -> dict[str, str]:
    """Return the faults that no output tells from other states, and why; refuse modes of states.

    middle: joint Jacobian of the extended plant, (N + m, N + n_v); again: disturbances of it that
    are read as followed faults. Of several faults that with the smallest range goes first.
    """
    A, C, half = _pair(extended, middle, again)
    names = [*extended.plant.names("x"), *again]
    states, kept = names[: extended.L0.shape[0] - len(extended.followed)], np.arange(len(names))
    found: dict[str, str] = {}
    while True:
        lost = _hidden(A[np.ix_(kept, kept)], C[:, kept])
        if lost is None:
            return found
        value, vector = lost
        moved = [names[kept[i]] for i in np.argsort(-vector) if vector[i] > 1e-6 * vector.max()]
        faults = [name for name in moved if name not in states]
        if not faults:
            raise StructureError(
                f"a mode {abs(value):.6g} of {', '.join(moved)} does not decay and no output shows "
                f"it ({', '.join(extended.plant.output_names)}); measure one of them",
                symbols=tuple(moved),
                condition="detectability",
            )
        gone = min(faults, key=lambda name: float(half[names.index(name)]))
        others = ", ".join(name for name in moved if name != gone) or "nothing"
        found[gone] = (
            f"the outputs do not tell it from {others} (a mode {abs(value):.6g} of the middle of "
            "the family)"
        )
        kept = kept[[names[i] != gone for i in kept]]


def hidden_somewhere(extended: Extended) -> str | None:
    """Say where in the box a mode does not decay that no output shows: no gain serves there.

    Looked for at lower ends, upper ends and nominal values or middles; None where none is found.
    """
    plant, sx = extended.plant, extended.plant.sx()
    signals, v = (*plant.x, *plant.u, *plant.w), ca.vertcat(sx.x, sx.u, sx.w)
    J = ca.densify(ca.jacobian(ca.vertcat(sx.rhs, sx.y), ca.vertcat(sx.x, sx.w)))
    function, matters = ca.Function("J", [v], [J]), ca.which_depends(ca.vec(J), v, 1, False)
    ends = [(s.usual, s.lower, s.upper) if s.bounded else (0.0,) * 3 for s in signals]
    free = [k for k, s in enumerate(signals) if s.bounded and matters[k]]
    for pick in product(range(3), repeat=min(len(free), MOST_FREE)):
        at = {k: ends[k][place] for k, place in zip(free, pick, strict=False)}
        found = np.array(function([at.get(k, end[0]) for k, end in enumerate(ends)]))
        lost = _hidden(*_pair(extended, found)[:2]) if np.isfinite(found).all() else None
        if lost is not None:
            names = [n for n, size in zip(plant.names("x"), lost[1], strict=True) if size > 1e-6]
            where = ", ".join(f"{signals[k].name} = {value:g}" for k, value in at.items())
            return (
                f"where {where}, the error of {', '.join(names)} does not decay (a mode "
                f"{abs(lost[0]):.6g}) and no output shows it ({', '.join(plant.output_names)}): no "
                f"gain serves there; measure {names[0]}, or narrow a range that this point is in"
            )
    return None


def _pair(
    extended: Extended, middle: FloatArray, again: Sequence[str] = ()
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A and C of the errors, in units of half ranges and noise, and the half ranges."""
    plant, (N, m) = extended.plant, extended.L0.shape
    noise = plant.names("w")
    columns = [*range(N), *(N + noise.index(name) for name in again)]
    half = np.concatenate([half_ranges(plant, "x"), half_ranges(plant, "w")])
    rest = [j for j in range(N, N + len(noise)) if j not in columns]
    size = np.abs(middle[N:, rest]) @ half[rest]
    half = half[columns]
    F = np.vstack([middle[:N, columns], np.eye(len(columns))[N:]])
    C = middle[N:, columns]
    L0 = np.zeros((len(columns), m))
    L0[:N] = np.array(extended.L0.evalf(17).tolist(), dtype=float).reshape(N, m)
    size = np.maximum(size, 1e-6 * (np.abs(C) @ half))
    T = np.eye(len(columns)) - L0 @ C
    A = (T @ F) * half / half[:, None]
    return A, ((C @ T) * half) / np.where(size > 0.0, size, 1.0)[:, None], half


def half_ranges(plant: Plant, kind: str) -> FloatArray:
    """Return half the ranges of signals, 1 where there is none."""
    box = plant.box(kind).reshape(-1, 2)
    half = 0.5 * (box[:, 1] - box[:, 0])
    return np.where(np.isfinite(half) & (half > 0.0), half, 1.0)


def _hidden(A: FloatArray, C: FloatArray) -> tuple[complex, FloatArray] | None:
    """Return a mode that does not decay and that no output sees, with its vector; None without."""
    for value in np.linalg.eigvals(A):
        if abs(value) < _DECAYS:
            continue
        _, sizes, vectors = np.linalg.svd(np.vstack([A - value * np.eye(len(A)), C]))
        if sizes[-1] < _HIDDEN:
            return complex(value), np.abs(vectors[-1])
    return None
