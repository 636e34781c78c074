"""How much of an energy gain is attained: the errors at a Jacobian that stays as it is.

A lower bound of the worst case over the stored family, beside the level that is proved. Searched,
not proved: corners of the family at random, and frequencies on a grid that is refined.
"""

import numpy as np

from obsynth.designs.general.lmis import Loop, error_loop
from obsynth.designs.general.record import GeneralDesign
from obsynth.designs.general.system import error_system
from obsynth.symbolic.arrays import FloatArray

CORNERS, FREQUENCIES, REFINEMENTS = 48, 64, 4


def attained_gain(design: GeneralDesign, weights: FloatArray) -> float:
    """Return the largest gain from v, in units of its bounds, to the weighted errors."""
    family, rng = design.family, np.random.default_rng(0)
    middle = family.ranges.mean(axis=1)
    corners = [middle]
    if len(middle):
        picks = rng.integers(0, 2, (CORNERS, len(middle)))
        corners += [family.ranges[np.arange(len(middle)), pick] for pick in picks]
    loop = error_loop(error_system(design))
    found = [_at(design, loop, corner, weights, _grid(0.0, np.pi)) for corner in corners]
    best, corner = max(zip(found, corners, strict=True), key=lambda pair: pair[0][0])
    width = np.pi / FREQUENCIES
    for _ in range(REFINEMENTS):
        grid = _grid(max(best[1] - width, 0.0), min(best[1] + width, np.pi))
        best = max(best, _at(design, loop, corner, weights, grid))
        width /= 0.25 * FREQUENCIES
    return best[0]


def _grid(low: float, high: float) -> FloatArray:
    even = np.linspace(low, high, FREQUENCIES)
    return even if low > 0.0 else np.concatenate([[0.0], np.geomspace(1e-4, high, FREQUENCIES)])


def _at(
    design: GeneralDesign, loop: Loop, corner: FloatArray, weights: FloatArray, grid: FloatArray
) -> tuple[float, float]:
    """Return the largest gain over frequencies and where it is, at one Jacobian."""
    family, N, radius = design.family, design.size, design.v_radius
    J = family.constant + np.tensordot(corner, family.directions, axes=1)
    A, W, C, V = J[:N, :N], J[:N, N:] * radius, J[N:, :N], J[N:, N:] * radius
    kept = (np.eye(N) - design.Z @ C) @ (np.eye(N) - design.L0 @ C)
    closed = kept @ A
    if np.abs(np.linalg.eigvals(closed)).max(initial=0.0) >= 1.0:
        return np.inf, 0.0
    shown = design.L0 @ V + design.Z @ (V - C @ (design.L0 @ V))
    # what stands in rows and outputs counts twice
    count = np.zeros(len(radius))
    count[loop.before] += 1.0
    count[loop.after] += 1.0
    share = np.where(count > 0.0, 1.0 / np.sqrt(np.maximum(count, 1.0)), 0.0)
    z = np.exp(1j * grid)[:, None, None]
    drive = (kept @ W - z * shown) * share
    response = weights[:, None] * np.linalg.solve(z * np.eye(N) - closed, drive)
    sizes = np.linalg.norm(response, ord=2, axis=(1, 2)) if len(radius) else np.zeros(len(grid))
    k = int(np.argmax(sizes))
    return float(sizes[k]), float(grid[k])
