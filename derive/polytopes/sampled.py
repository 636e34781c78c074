"""Hulls of samples: what a Jacobian looks like, for plots and first guesses, without guarantee."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from obsynth.derive.errors import DerivationError
from obsynth.derive.jacobian.bounds import jacobian_bounds
from obsynth.derive.jacobian.entries import jacobian_entries
from obsynth.derive.polytopes.polytope import Label, polytope_from_vertices
from obsynth.derive.polytopes.support import basis_entries, scalar_values
from obsynth.derive.split import Split
from obsynth.symbolic.plant import Plant

Array = NDArray[np.float64]
_MOST_SCALARS = 6


@dataclass(frozen=True, eq=False)
class SampledHull:
    """Matrices at the corners of the hull of samples.

    No design takes this type: between the samples, and in the corners of the box that they missed,
    the Jacobian may lie outside.

    matrices: jacobians at the samples that are corners of the hull
    scalars: their scalars
    label: always SAMPLED
    samples: how many points were looked at
    """

    matrices: Array
    scalars: Array
    label: Label
    samples: int

    def __str__(self) -> str:
        return f"{len(self.matrices)} corners of {self.samples} samples ({self.label})"


def sampled_hull(
    split_or_model: Split | Plant,
    wrt: Literal["states", "inputs"] = "states",
    samples: int = 10_000,
    seed: int = 0,
) -> SampledHull:
    """Sample a Jacobian over the box of the plant and take the hull.

    Parameters
    ----------
    split_or_model : Split or Plant
        As for `jacobian_bounds`.
    wrt : {"states", "inputs"}
        What to differentiate by.
    samples : int
        Number of random points; corners of the box are among them.
    seed : int
        Seed of the generator.

    Returns
    -------
    SampledHull
        Labelled ``sampled``.

    Raises
    ------
    DerivationError
        More than six scalars, or a hull without inside.

    Examples
    --------
    >>> from obsynth.symbolic.plants import van_der_pol
    >>> print(sampled_hull(van_der_pol(), samples=2000).label)
    sampled: hull of samples, which the set may leave; no guarantee
    """
    bounds = jacobian_bounds(split_or_model, wrt, effort="fast")
    part = split_or_model if isinstance(split_or_model, Split) else None
    model = split_or_model.model if isinstance(split_or_model, Split) else split_or_model
    entries, basis = jacobian_entries(model, part, wrt), basis_entries(bounds)
    if not 1 <= len(basis) <= _MOST_SCALARS:
        raise DerivationError(
            f"the hull of samples is there for 1 to {_MOST_SCALARS} scalars, not {len(basis)}",
            scalars=len(basis),
        )
    rng = np.random.default_rng(seed)
    low, high = entries.box.T
    low, high = np.where(np.isfinite(low), low, -1.0), np.where(np.isfinite(high), high, 1.0)
    share = rng.random((samples, len(low)))
    share[: samples // 2] = np.round(share[: samples // 2] * 4) / 4
    scalars = scalar_values(entries, basis, low + share * (high - low))
    corners = polytope_from_vertices(scalars).vertices
    return SampledHull(
        np.array([bounds.family.at(values) for values in corners]),
        corners,
        Label.SAMPLED,
        len(scalars),
    )
