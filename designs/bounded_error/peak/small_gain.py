"""Linear inequalities n + G b <= b in nonnegative doubles, proved in rounded-up arithmetic."""

from __future__ import annotations

import numpy as np

from obsynth.derive.rigour import TINY, add_up, product_up, raised
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.symbolic.arrays import FloatArray

# Room that the certificate leaves for other orders of summation on other machines.
SLACK = 2.0**-40


def small_gain_solution(G: FloatArray, n: FloatArray) -> FloatArray:
    """Return a b, barely above ``(I - G)^-1 n``, with ``n + G b <= b`` in rounded-up numbers."""
    eye = np.eye(len(n))
    b = np.maximum(np.linalg.solve(eye - G, n), n)
    b = np.maximum(np.linalg.solve(eye - G, n + SLACK * b + 64.0 * TINY), n)
    for _ in range(100):
        image = add_up(n, product_up(G, b))
        if np.all(image <= b) and np.all(np.isfinite(b)):
            return b
        b = np.maximum(b, image * (1.0 + 2.0**-45))
    raise InfeasibleDesign(
        "peak bounds: the small-gain condition holds without a margin that doubles can prove",
        ["use other gains, or a smaller domain"],
        rho=spectral_radius(G),
        G=G,
    )


def spectral_radius(matrix: FloatArray) -> float:
    """Return the largest absolute eigenvalue as computed."""
    return float(np.max(np.abs(np.linalg.eigvals(matrix)), initial=0.0))


def contraction(G: FloatArray, b: FloatArray) -> float:
    """Return max (G v)_i / v_i for a positive v, over the outputs that feed back, rounded up.

    Below one it proves that the spectral radius of G is below one.
    """
    coupled = np.flatnonzero(np.any(G, axis=0))
    if coupled.size == 0:
        return 0.0
    inner, scale = G[np.ix_(coupled, coupled)], b[coupled]
    # an output without noise of its own has (G b)_i = b_i, so b itself need not do
    v = np.linalg.solve(np.eye(coupled.size) - inner, scale)
    v = np.maximum(v, 2.0**-500 * np.max(np.abs(v)))
    return float(np.max(raised(product_up(inner, v) / v, 1)))
