"""Which faults of a plant of the general class can be followed as states, and why others cannot."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from obsynth.derive.errors import StructureError
from obsynth.derive.forms.extended import Extended, extend
from obsynth.derive.jacobian.bounds import JacobianBounds, jacobian_bounds
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.plant import Plant

RTOL = 1e-3
"""Of the bounds of the joint Jacobian."""
_DECAYS = 1.0 - 1e-7
_HIDDEN = 1e-8


@dataclass(frozen=True, eq=False)
class Following:
    """An extended plant, its joint Jacobian, and what is made of every fault.

    reasons: why a fault is not followed, by its name
    """

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
    unfollowed, reasons = list(bounded), {}
    while True:
        extended = extend(model, unfollowed, divided)
        free, rank = extended.free, extended.D0.shape[1]
        if divided and rank < len(free):
            raise StructureError(
                f"{', '.join(free)} act in {rank} direction{'s' if rank > 1 else ''} on the "
                "states: of any size they cannot be told apart",
                symbols=free,
                condition="faults in different directions",
            )
        bounds = jacobian_bounds(extended.plant, wrt="joint", rtol=RTOL, effort="fast")
        lost = _hidden_fault(model, extended, bounds.family.midpoint)
        if lost is None:
            break
        unfollowed.append(lost[0])
        reasons[lost[0]] = lost[1]
    for s in model.f:
        if s.rate is None and not s.constant and s.name not in divided:
            reasons.setdefault(s.name, "it has no rate")
    return Following(extended, bounds, reasons)


def _hidden_fault(model: Plant, extended: Extended, middle: FloatArray) -> tuple[str, str] | None:
    """Return a followed fault of a mode that no output sees, and why; refuse modes of states.

    Of several faults that nothing tells from each other, the one with the smallest range.
    """
    names, n = extended.plant.names("x"), len(model.x)
    half = half_ranges(extended.plant, "x")
    for value, vector in hidden_modes(extended, middle, half):
        moved = [i for i in np.argsort(-vector) if vector[i] > 1e-6 * vector.max()]
        faults = [int(i) for i in moved if i >= n]
        others = [names[i] for i in moved]
        if faults:
            name = names[min(faults, key=lambda i: float(half[i]))]
            rest = ", ".join(other for other in others if other != name) or "nothing"
            return name, (
                f"the outputs do not tell it from {rest} (a mode {abs(value):.6g} of the middle of "
                "the family)"
            )
        raise StructureError(
            f"a mode {abs(value):.6g} of {', '.join(others)} does not decay and no output shows it "
            f"({', '.join(model.output_names)}); measure one of them",
            symbols=tuple(others),
            condition="detectability",
        )
    return None


def half_ranges(plant: Plant, kind: str) -> FloatArray:
    """Return half the ranges of signals, 1 where there is none."""
    box = plant.box(kind).reshape(-1, 2)
    half = 0.5 * (box[:, 1] - box[:, 0])
    return np.where(np.isfinite(half) & (half > 0.0), half, 1.0)


def hidden_modes(
    extended: Extended, middle: FloatArray, half: FloatArray
) -> list[tuple[complex, FloatArray]]:
    """Return modes of the middle that do not decay and that no output sees, with their vectors.

    In units of the half ranges (N,), and of the readings' noise.
    """
    N = len(half)
    T = np.array(extended.T0.evalf(17).tolist(), dtype=float).reshape(N, N)
    noise = np.abs(middle[N:, N:]) @ half_ranges(extended.plant, "w")
    size = np.maximum(noise, 1e-6 * (np.abs(middle[N:, :N]) @ half))
    A = (T @ middle[:N, :N]) * half / half[:, None]
    C = ((middle[N:, :N] @ T) * half) / np.where(size > 0.0, size, 1.0)[:, None]
    found = []
    for value in np.linalg.eigvals(A):
        if abs(value) < _DECAYS:
            continue
        _, sizes, vectors = np.linalg.svd(np.vstack([A - value * np.eye(N), C]))
        if sizes[-1] < _HIDDEN:
            found.append((complex(value), np.abs(vectors[-1])))
    return found
