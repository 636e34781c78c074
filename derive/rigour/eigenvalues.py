"""Largest eigenvalues of symmetric matrices, bounded on both sides with every rounding counted.

An approximate eigenvector matrix Q from LAPACK turns A into T = Q'AQ, which is almost diagonal. The
products are charged with the a priori error of a dot product in any order, Gershgorin bounds T, and
the distance of Q'Q from the identity enters as a factor, since y'Ty / y'Q'Qy runs through all
Rayleigh quotients of A. Nothing is assumed about the quality of Q: a poor one gives a wide bound.
"""

from dataclasses import dataclass

import numpy as np

from obsynth.derive.rigour.interval import UNIT_ROUNDOFF, down, gamma_bound, up
from obsynth.symbolic.arrays import BoolArray, FloatArray

# What sums of products may lose to underflow; far below every tolerance.
_UNDERFLOW = 1e-290


def finite(matrices: FloatArray) -> BoolArray:
    """Tell which matrices of a batch, shape (N, k, k), have finite entries only."""
    return np.asarray(np.isfinite(matrices).all(axis=(1, 2)), dtype=np.bool_)


@dataclass(frozen=True, eq=False)
class Rotation:
    """Symmetric matrices A seen in the basis Q of their approximate eigenvectors, values ascending.

    error: bound of the norm of Q'AQ - diag(values), radius of A included
    defect: bound of the norm of Q'Q - I, below 1/2; infinite where LAPACK gave nothing of use
    """

    values: FloatArray
    vectors: FloatArray
    error: FloatArray
    defect: FloatArray

    def upper(self, value: FloatArray) -> FloatArray:
        """Turn a bound of the largest eigenvalue of Q'AQ into one of A."""
        with np.errstate(all="ignore"):
            scaled = np.where(
                value >= 0.0, value / (1.0 - self.defect), value / (1.0 + self.defect)
            )
            result = up(scaled + 4.0 * UNIT_ROUNDOFF * np.abs(scaled))
        return np.where(np.isfinite(self.defect) & np.isfinite(result), result, np.inf)

    def lower(self, value: FloatArray) -> FloatArray:
        """Turn a lower bound of a diagonal entry of Q'AQ into one of A's largest eigenvalue."""
        with np.errstate(all="ignore"):
            scaled = np.where(
                value >= 0.0, value / (1.0 + self.defect), value / (1.0 - self.defect)
            )
            result = down(scaled - 4.0 * UNIT_ROUNDOFF * np.abs(scaled))
        return np.where(np.isfinite(self.defect) & np.isfinite(result), result, -np.inf)


def rotate(centre: FloatArray, radius: FloatArray) -> Rotation:
    """Diagonalise a batch of symmetric matrices, with a bound of what is left."""
    count, k = centre.shape[:2]
    usable = finite(centre) & finite(radius)
    safe = np.where(usable[:, None, None], centre, 0.0)
    values, vectors = np.linalg.eigh(safe)
    size = np.abs(vectors)
    across = size.transpose(0, 2, 1)
    image = vectors.transpose(0, 2, 1) @ (safe @ vectors)
    spread = np.where(usable[:, None, None], radius, 0.0) + gamma_bound(2 * k + 4) * np.abs(safe)
    charge = across @ (spread @ size) * (1.0 + gamma_bound(4 * k + 8))
    charge = charge + _UNDERFLOW * spread.any(axis=(1, 2), keepdims=True)
    rest = np.abs(image - values[:, :, None] * np.eye(k)) * (1.0 + 4.0 * UNIT_ROUNDOFF) + charge
    error = rest.sum(axis=2).max(axis=1, initial=0.0) * (1.0 + gamma_bound(k + 4))
    gram = np.abs(vectors.transpose(0, 2, 1) @ vectors - np.eye(k))
    gram = gram + gamma_bound(k + 4) * (across @ size + 1.0)
    defect = gram.sum(axis=2).max(axis=1, initial=0.0) * (1.0 + gamma_bound(k + 4))
    good = usable & (defect < 0.5)
    return Rotation(
        values,
        vectors,
        np.where(good, error, np.inf) if count else error,
        np.where(good, defect, np.inf) if count else defect,
    )


def largest_eigenvalue(
    centre: FloatArray, radius: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Bound the largest eigenvalue of every matrix of a batch from both sides."""
    radius = np.zeros_like(centre) if radius is None else radius
    if centre.shape[1] == 0:
        nothing = np.zeros(len(centre))
        return nothing, nothing.copy()
    plain = rotate(centre, np.zeros_like(centre))
    with np.errstate(invalid="ignore"):
        upper = plain.upper(plain.values[:, -1] + plain.error)
        wide = radius.any(axis=(1, 2))
        upper = np.where(wide, up(upper + perron_bound(radius)), upper)
        around = (
            np.where(wide, rotate(centre, radius).error, plain.error) if wide.any() else plain.error
        )
        lower = plain.lower(down(plain.values[:, -1] - around))
    upper = np.where(finite(radius) & ~np.isnan(upper), upper, np.inf)
    lower = np.where(np.isnan(lower), -np.inf, lower)
    zero = ~(centre.any(axis=(1, 2)) | radius.any(axis=(1, 2)))
    return np.where(zero, 0.0, lower), np.where(zero, 0.0, upper)


def perron_bound(matrix: FloatArray) -> FloatArray:
    """Bound the largest eigenvalue of nonnegative symmetric matrices by max_i (R v)_i / v_i."""
    k = matrix.shape[1]
    usable = finite(matrix)
    safe = np.where(usable[:, None, None], matrix, 0.0)
    if k == 0 or not safe.any():
        return np.where(usable, 0.0, np.inf)
    vector = np.abs(np.linalg.eigh(safe)[1][:, :, -1])
    vector = vector + 1e-9 * np.maximum(vector.max(axis=1, keepdims=True), 1e-300)
    for _ in range(2):
        # two steps of the power method spread the mass over rows that the vector left out
        image = (safe @ vector[:, :, None])[:, :, 0]
        largest = np.maximum(image.max(axis=1, keepdims=True), 1e-300)
        vector = np.maximum(0.5 * (vector + image / largest), 1e-12)
    image = (safe @ vector[:, :, None])[:, :, 0] * (1.0 + gamma_bound(k + 4)) + _UNDERFLOW
    bound = (image / vector).max(axis=1) * (1.0 + 4.0 * UNIT_ROUNDOFF)
    rows = safe.sum(axis=2).max(axis=1) * (1.0 + gamma_bound(k + 2))
    return np.where(usable, np.where(safe.any(axis=(1, 2)), np.minimum(bound, rows), 0.0), np.inf)
