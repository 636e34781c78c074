"""Detectability between the vertices of a Jacobian family."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from obsynth.derive.errors import StructureError
from obsynth.derive.jacobian.bounds import JacobianBounds
from obsynth.derive.split import Split
from obsynth.derive.structure.conditions import augmented_pair, unknown_input_condition

Array = NDArray[np.float64]
_STARTS = 2
_RANDOM = 64
_HIDDEN = 1e-9
_MODE_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class WeakestMember:
    """The member of a Jacobian family that is hardest to observe, as far as a search finds it.

    Attributes
    ----------
    margin : float
        Smallest singular value of [z I - A; C] with columns of size one, over the modes z that do
        not decay.
    scalars : dict of str to float
        The scalars of the family there.
    matrix : ndarray, shape (n, n)
        The Jacobian there.
    mode : complex or None
        The mode; None when all modes decay by themselves everywhere.
    members : int
        How many were looked at.
    """

    margin: float
    scalars: dict[str, float]
    matrix: Array
    mode: complex | None
    members: int

    def __str__(self) -> str:
        if self.mode is None:
            return f"all modes decay by themselves ({self.members} members of the family)"
        mode = f"{self.mode.real:.6g}" if self.mode.imag == 0 else f"{self.mode:.6g}"
        return (
            f"smallest margin {self.margin:.2g}, mode {mode} "
            f"({self.members} members of the family, a search and no proof)"
        )


def pair_margin(A: Array, C: Array, discrete: bool) -> tuple[float, complex | None]:
    """Distance of a pair from a hidden mode that does not decay."""
    margin, where = 1.0, None
    for mode in np.linalg.eigvals(A).tolist():
        stays = abs(mode) >= 1.0 - _MODE_TOLERANCE if discrete else mode.real >= -_MODE_TOLERANCE
        if not stays:
            continue
        pencil = np.vstack([mode * np.eye(len(A)) - A, C.astype(complex)])
        size = np.linalg.norm(pencil, axis=0)
        value = float(np.linalg.svd(pencil / np.where(size > 0.0, size, 1.0), compute_uv=False)[-1])
        if value < margin or where is None:
            margin, where = min(value, margin), complex(mode)
    return margin, where


def weakest_member(split: Split, bounds: JacobianBounds) -> WeakestMember:
    """Search the Jacobian family for a member whose state or faults cannot be detected.

    Detectable vertices do not make a detectable polytope: with x2 seen through s x2 only, both
    s = -1 and s = 1 are fine and s = 0 is not. The search looks at the middle, at scalars that
    pass through zero, at random members, and improves the worst of them.

    Parameters
    ----------
    split : Split
        The plant's matrices.
    bounds : JacobianBounds
        Bounds of dg/dx.

    Returns
    -------
    WeakestMember
        What was found.

    Raises
    ------
    StructureError
        A member with a hidden mode that does not decay; ``scalars`` says which. Or unknown inputs
        that cannot be decoupled.

    Examples
    --------
    >>> from obsynth.derive.jacobian.bounds import jacobian_bounds
    >>> from obsynth.derive.split import split
    >>> from obsynth.symbolic.plants import quadruple_tank
    >>> parts = split(quadruple_tank().discretise("euler", Ts=1.0))
    >>> weakest_member(parts, jacobian_bounds(parts)).margin > 1e-3
    True
    """
    from scipy.optimize import minimize

    decoupling = unknown_input_condition(split)
    family = bounds.family
    low, high = family.ranges[:, 0], family.ranges[:, 1]
    discrete = split.model.Ts is not None
    looked = 0

    def margin(scalars: Array) -> tuple[float, complex | None]:
        nonlocal looked
        looked += 1
        inside = np.clip(scalars, low, high)
        return pair_margin(*augmented_pair(split, decoupling, family.at(inside)), discrete)

    middle = 0.5 * (low + high)
    starts = [middle]
    for k in np.flatnonzero((low < 0.0) & (high > 0.0)).tolist():
        crossing = middle.copy()
        crossing[k] = 0.0
        starts.append(crossing)
    starts.append(np.clip(np.zeros_like(middle), low, high))
    rng = np.random.default_rng(0)
    starts += list(low + rng.random((_RANDOM if len(low) else 0, len(low))) * (high - low))
    scored = sorted(((margin(s)[0], k) for k, s in enumerate(starts)), key=lambda pair: pair[0])
    best, best_margin = starts[scored[0][1]], scored[0][0]
    width = np.where(high > low, high - low, 1.0)
    for value, k in scored[:_STARTS]:
        if value >= 1.0 or not len(low):
            break
        found = minimize(
            lambda share: margin(low + share * width)[0],
            (starts[k] - low) / width,
            method="Nelder-Mead",
            bounds=[(0.0, 1.0)] * len(low),
            options={"maxfev": 40 * len(low), "xatol": 1e-10, "fatol": 1e-12},
        )
        if found.fun < best_margin:
            best, best_margin = np.clip(low + found.x * width, low, high), float(found.fun)
    value, mode = margin(best)
    scalars = dict(zip(family.labels, best.tolist(), strict=True))
    if mode is not None and value <= _HIDDEN:
        listed = ", ".join(f"{name} = {s:.6g}" for name, s in scalars.items())
        raise StructureError(
            f"state and faults cannot be detected where {listed}, inside the Jacobian family: the "
            f"mode {mode:.6g} does not decay and no output shows it. Narrow the ranges so that "
            "they avoid this point, or measure more",
            condition="detectability inside the polytope",
            scalars=scalars,
            mode=mode,
            matrix=family.at(best),
        )
    return WeakestMember(value, scalars, family.at(best), mode, looked)
