"""The paper's forms as printed: equation (32) with each of its flaws, and what refuses them."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from obsynth.derive.rigour import exact, inverse, nearest, negative, positive
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.interval.model import columns_of
from obsynth.designs.interval.record import IntervalDesign
from obsynth.designs.interval.rows import Part
from obsynth.symbolic import ObsynthError
from obsynth.symbolic.arrays import FloatArray

FLAWS = ("y", "theta", "product")
"""Of (32): y_{k+1} in place of y_k; the upper theta_1 in the lower bound; K0 R0^-1 times bounds."""


def printed_faults(
    design: IntervalDesign,
    r_lower: FloatArray,
    r_upper: FloatArray,
    y: FloatArray,
    u: FloatArray,
    flaws: Collection[str] = FLAWS,
) -> tuple[FloatArray, FloatArray]:
    """Evaluate (32) for logged bounds of r, with all or some of its flaws."""
    unknown = set(flaws) - set(FLAWS)
    if unknown:
        raise ObsynthError(f"flaws {sorted(unknown)} are not among {FLAWS}", option="flaws")
    model, plant, q = design.model, design.plant, design.model.q
    K = exact(design.chosen.K0) @ inverse(exact(design.chosen.R0))
    rows = inverse(K) @ plant.F_left
    zero = np.full((q, len(plant.N12)), exact(0.0).item(), dtype=object)
    part = Part(model, plant, design.S, -rows, zero)
    parts = part.split(exact(design.nominal))
    _, b, o = columns_of(model)
    constant = model.vertices[0]
    v_lower, v_upper = _box(nearest(model.W2), nearest(model.box("w")))
    Phi, W = nearest(rows @ plant.Phi), nearest(rows @ plant.W @ design.S)
    R, B = nearest(parts.R), nearest(part.X @ constant[:, b])
    sigma_lower, sigma_upper = nearest(parts.sigma_lower), nearest(parts.sigma_upper)
    M_lower, M_upper = nearest(parts.M_lower), nearest(parts.M_upper)

    seen = y[..., 1:, :] if "y" in flaws else y[..., :-1, :]
    low, high = r_lower[..., :-1, :], r_upper[..., :-1, :]
    low_next, high_next = r_lower[..., 1:, :], r_upper[..., 1:, :]
    known = y[..., 1:, :] @ Phi.T + u[..., :-1, :] @ B.T + nearest(part.X @ constant[:, o])[:, 0]
    upper = known + positive(seen) @ M_upper.T - negative(seen) @ M_lower.T
    lower = known + positive(seen) @ M_lower.T - negative(seen) @ M_upper.T
    upper += high_next @ positive(W).T - low_next @ negative(W).T
    lower += low_next @ positive(W).T - high_next @ negative(W).T
    upper += high @ positive(R).T - low @ negative(R).T
    lower += low @ positive(R).T - high @ negative(R).T
    upper += _product(sigma_lower, sigma_upper, low, high)
    lower -= _product(-sigma_upper, -sigma_lower, low, high)
    theta_lower, theta_upper = _ends(-Phi, v_lower, v_upper)
    upper += theta_upper
    lower += theta_upper if "theta" in flaws else theta_lower
    upper += nearest(parts.noise[1])
    lower += nearest(parts.noise[0])
    gain = nearest(K)
    if "product" in flaws:
        return lower @ gain.T, upper @ gain.T
    plus, minus = positive(gain), negative(gain)
    return lower @ plus.T - upper @ minus.T, upper @ plus.T - lower @ minus.T


def _box(matrix: FloatArray, box: FloatArray) -> tuple[FloatArray, FloatArray]:
    return _ends(matrix, box[:, 0], box[:, 1])


def _ends(matrix: FloatArray, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    plus, minus = positive(matrix), negative(matrix)
    return plus @ low - minus @ high, plus @ high - minus @ low


def _product(
    lower: FloatArray, upper: FloatArray, r_lower: FloatArray, r_upper: FloatArray
) -> FloatArray:
    """Upper end of (4) for an interval matrix times an interval vector."""
    value: FloatArray = (
        positive(r_upper) @ positive(upper).T
        - negative(r_upper) @ positive(lower).T
        - positive(r_lower) @ negative(upper).T
        + negative(r_lower) @ negative(lower).T
    )
    return value


def refuse_printed(design: IntervalDesign) -> InfeasibleDesign:
    """Return the refusal of (32) as printed, for gains whose bounds are stable.

    Gains whose bounds diverge are refused before, with the numbers of Theorem 1.
    """
    K = nearest(exact(design.chosen.K0) @ inverse(exact(design.chosen.R0)))
    details = [
        "Gamma_f takes y_{k+1} where (31) has y_k: the bounds belong to no instant",
        "the lower bound adds the upper theta_1",
        "f_k needs y_{k+1} and z_{2,k+1}: what (32) returns at k is f_{k-1}",
    ]
    if K.min(initial=0.0) < 0.0:
        details.append(
            f"K0 R0^-1 has an entry {K.min():.4g} below zero and exchanges lower and upper bounds"
        )
    details.append('form="corrected" repairs all of them')
    return InfeasibleDesign(
        "(32) as printed does not enclose the fault", details, least_entry=float(K.min(initial=0.0))
    )
