"""Fewer scalars: what is dropped stays as an interval remainder, so that the guarantee stands."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import casadi as ca
import numpy as np

from obsynth.derive.errors import DerivationError, UnboundedError
from obsynth.derive.jacobian.bounds import jacobian_bounds
from obsynth.derive.jacobian.entries import jacobian_entries
from obsynth.derive.jacobian.family import AffineFamily
from obsynth.derive.polytopes.support import basis_entries
from obsynth.derive.rigour import UNIT_ROUNDOFF
from obsynth.derive.split import Split
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.plant import Plant

_ROUND = 1.0 + 2.0**-44


def _above(value: FloatArray) -> FloatArray:
    """Push up what was computed with some hundred roundings of nonnegative terms."""
    return np.where(value > 0.0, np.nextafter(value * _ROUND, np.inf), 0.0)


def drop_scalars(family: AffineFamily, dropped: Sequence[int]) -> AffineFamily:
    """Fix scalars at the middle of their ranges and keep their variation as an interval.

    The family found has a larger ``radius`` and holds every matrix of the given one.
    """
    kept = [k for k in range(len(family.ranges)) if k not in dropped]
    constant, radius = family.constant.copy(), family.radius.copy()
    for k in dropped:
        low, high = family.ranges[k]
        middle = low + 0.5 * (high - low)
        half = np.nextafter(max(high - middle, middle - low), np.inf) if high > low else 0.0
        direction = np.abs(family.directions[k])
        constant = constant + middle * family.directions[k]
        # the product and the sum round once each
        lost = 4.0 * UNIT_ROUNDOFF * (np.abs(constant) + 2.0 * abs(middle) * direction)
        radius = radius + half * direction + np.where(direction > 0.0, lost, 0.0)
    return replace(
        family,
        constant=constant,
        directions=family.directions[kept],
        ranges=family.ranges[kept],
        radius=_above(radius) if dropped else radius,
        labels=tuple(family.labels[k] for k in kept),
        exact=family.exact and not dropped,
    )


def principal_family(
    split_or_model: Split | Plant,
    keep: int,
    wrt: Literal["states", "inputs"] = "states",
    rtol: float = 1e-4,
    effort: Literal["fast", "normal", "tight"] = "normal",
) -> AffineFamily:
    """Write a Jacobian in its principal coordinates, the small ones as an interval remainder.

    The directions come from samples, the ranges of the coordinates do not: every coordinate is
    bounded over the box by branch and bound, so the family holds every Jacobian. It can still be
    worse than the box of ranges, since a box along other axes may be larger.

    Parameters
    ----------
    split_or_model : Split or Plant
        As for `jacobian_bounds`.
    keep : int
        Principal coordinates that stay scalars: 2**keep vertices.
    wrt : {"states", "inputs"}
        What to differentiate by.
    rtol : float
        Wanted gap of every range.
    effort : {"fast", "normal", "tight"}
        How many boxes branch and bound may use.

    Returns
    -------
    AffineFamily
        ``exact`` is False: an outer polytope.

    Raises
    ------
    StructureError, UnboundedError, DerivationError
        As `jacobian_bounds`; a number of coordinates that does not fit.

    Examples
    --------
    >>> from obsynth.symbolic.plants import exothermic_cstr
    >>> found = principal_family(exothermic_cstr(), keep=1)
    >>> len(found.vertices()), found.labels
    (2, ('c1(C_A, T)',))
    """
    bounds = jacobian_bounds(split_or_model, wrt, rtol, effort)
    entries, family = jacobian_entries(split_or_model, wrt), bounds.family
    basis = basis_entries(bounds)
    count = len(basis)
    if not 0 <= keep <= count:
        raise DerivationError(f"keep={keep} has to be between 0 and {count}, the number of scalars")
    if count == 0:
        return family
    samples = entries.sample(corners=False)
    half = np.maximum(family.half_ranges, 1e-300)
    values = np.array([samples[place] for place in basis]).T / half
    # coordinates c = axes s, and back
    rotation = np.linalg.svd(values - values.mean(axis=0))[2]
    axes, inverse = rotation / half, rotation.T * half[:, None]
    columns = dict(zip(entries.places, ca.vertsplit(entries.values), strict=True))
    scalars = ca.vertcat(*[columns[place] for place in basis])
    found = entries.search(rtol, effort, ca.mtimes(ca.DM(axes), scalars))
    if not np.isfinite(found.lower + found.upper).all():
        raise UnboundedError("a principal coordinate has no finite bound over the box")
    # s = inverse c + defect s: the product of the two matrices is not quite the identity
    size = np.abs(family.ranges).max(axis=1)
    defect = np.abs(np.eye(count) - inverse @ axes)
    unit = (2 * count + 4) * UNIT_ROUNDOFF
    defect = defect + unit * (np.abs(inverse) @ np.abs(axes) + np.eye(count))
    spread = np.maximum(np.abs(found.lower), np.abs(found.upper))
    rest = defect @ size + unit * (np.abs(inverse) @ spread)
    weights = np.abs(family.directions)
    directions = np.tensordot(inverse.T, family.directions, axes=1)
    rounding = (
        (2 * count + 8)
        * UNIT_ROUNDOFF
        * (np.tensordot(np.abs(inverse) @ spread + size, weights, axes=1) + np.abs(family.constant))
    )
    order = np.argsort(-np.ptp(values @ rotation.T, axis=0), kind="stable")
    whole = replace(
        family,
        directions=directions[order],
        ranges=np.column_stack([found.lower, found.upper])[order],
        radius=_above(family.radius + np.tensordot(rest, weights, axes=1) + rounding),
        labels=tuple(f"c{k + 1}({', '.join(entries.names)})" for k in range(count)),
        exact=False,
    )
    return drop_scalars(whole, range(keep, count))
