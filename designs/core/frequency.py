"""The gain of linear maps over all frequencies: searched, not proved."""

import numpy as np
from numpy.typing import NDArray

from obsynth.symbolic.arrays import FloatArray

ComplexArray = NDArray[np.complex128]
FREQUENCIES = 48
REFINEMENTS = 6


def peak_gain(
    A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray, refinements: int = REFINEMENTS
) -> tuple[FloatArray, FloatArray, ComplexArray]:
    """Return the peak of ``C (z I - A)^-1 B + D``, where it is and the input that it takes.

    Shapes: A (N, n, n), all else a matrix or N of them; found (N,), (N,) in radians per sample and
    (N, n_w). Infinite where A is not stable.
    """
    modes, rows = np.linalg.eigvals(A), np.arange(len(A))
    size = np.abs(modes).max(axis=1)
    unstable = size >= 1.0
    # their peak is no number, and where a mode lies on the circle there is no inverse
    A = A / np.where(unstable, 1.001 * size, 1.0)[:, None, None]
    common = np.broadcast_to(np.linspace(0.0, np.pi, FREQUENCIES), (len(A), FREQUENCIES))
    grid, width = np.hstack([common, np.abs(np.angle(modes))]), np.pi / (FREQUENCIES - 1)
    B, C, D = (part if part.ndim == 2 else part[:, None] for part in (B, C, D))
    for left in reversed(range(refinements + 1)):
        z = np.exp(1j * grid)[:, :, None, None]
        response = np.linalg.solve(z * np.eye(A.shape[-1]) - A[:, None], B.astype(complex))
        transfer = C @ response + D
        # few rows: the squares of the singular values are quicker than these
        squares = np.linalg.eigvalsh(transfer @ np.conj(np.swapaxes(transfer, -1, -2)))[..., -1]
        best = np.argmax(squares, axis=1)
        peak = grid[rows, best]
        if left:
            grid = np.clip(peak[:, None] + np.linspace(-width, width, 11), 0.0, np.pi)
            width *= 0.2
    _, sizes, right = np.linalg.svd(transfer[rows, best])
    return np.where(unstable, np.inf, sizes[:, 0]), peak, right[:, 0].conj()
