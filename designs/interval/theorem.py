"""The stability condition of Theorem 1 beside the sharper comparison matrix."""

from __future__ import annotations

import numpy as np

from obsynth.derive.rigour import exact, nearest, negative, positive
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.interval.record import IntervalDesign
from obsynth.symbolic.arrays import FloatArray

NEGATIVE = 1e-9
"""How far below zero rounded gains may leave an entry of R that is meant to be zero."""


def lipschitz_alpha(sigma_lower: FloatArray, sigma_upper: FloatArray) -> float:
    """Return alpha = 2 max{a1 + b1, a2 + b2} of Theorem 1, with the constants of (14)."""
    up = float(np.linalg.norm(positive(sigma_upper), 2))
    down = float(np.linalg.norm(negative(sigma_lower), 2))
    return 2.0 * (up + down)


def largest_alpha(R: FloatArray) -> float:
    """Return the largest alpha of (20): 1 / ||(z I - R)^-1||_inf, 0 if unstable."""
    if np.abs(np.linalg.eigvals(R)).max(initial=0.0) >= 1.0:
        return 0.0
    eye = np.eye(len(R))

    def smallest(angles: FloatArray) -> FloatArray:
        pencils = np.exp(1j * angles)[:, None, None] * eye - R
        values: FloatArray = np.linalg.svd(pencils, compute_uv=False)[:, -1]
        return values

    angles = np.linspace(0.0, np.pi, 721)
    step = angles[1]
    for _ in range(6):
        best = angles[int(np.argmin(smallest(angles)))]
        angles = np.clip(best + np.linspace(-step, step, 41), 0.0, np.pi)
        step /= 20.0
    return float(smallest(angles).min())


def comparison_radius(design: IntervalDesign) -> float:
    """Spectral radius of the matrix that bounds one step of the errors, without contraction.

    ``max_i |M_i|`` for the vertex form, ``|R| + sigma_upper+ + sigma_lower-`` for the paper's.
    """
    return float(np.abs(np.linalg.eigvals(nearest(design.width_map.part.E))).max(initial=0.0))


def divergence(design: IntervalDesign, headline: str = "the bounds diverge") -> InfeasibleDesign:
    """Return the refusal for gains whose bounds are not bounded, with the numbers."""
    radius = comparison_radius(design)
    parts = design.prediction.split(exact(design.nominal))
    R = nearest(parts.R)
    alpha = lipschitz_alpha(nearest(parts.sigma_lower), nearest(parts.sigma_upper))
    limit = largest_alpha(R)
    details = []
    signed = design.bound == "paper" and R.min(initial=0.0) < -NEGATIVE
    if signed:
        details.append(
            f"R = P (A2 - L C2) P^-1 has an entry {R.min():.4g} below zero, which Theorem 1 does "
            'not allow; bound="vertex" needs no sign'
        )
    details.append(
        f"the errors of one step grow by the factor {radius:.6g} (spectral radius; below 1 needed)"
    )
    met = "is met" if alpha < limit else "is not met"
    details.append(
        f"the condition of Theorem 1 {met}: alpha = {alpha:.6g}, (20) is feasible for alpha below "
        f"{limit:.6g}"
    )
    details.append(
        'use gains="lp" with centred=True, narrower ranges of the scheduling variables, or measure '
        "more states"
    )
    if radius < 1.0 and signed:
        headline = "R is not nonnegative"
    return InfeasibleDesign(
        f"{headline}: spectral radius {radius:.6g}",
        details,
        radius=radius,
        alpha=alpha,
        largest_alpha=limit,
        least_entry=float(R.min(initial=0.0)),
    )
