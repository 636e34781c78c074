"""What the methods read of declared ranges: a size for signals without one, the nominal w."""

import numpy as np

from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray

LARGEST_SIGNAL = 1e6
"""Magnitude up to which signals without a declared range are covered."""


def finite_box(plant: Plant, kind: str) -> FloatArray:
    """Return the declared box of signals, `LARGEST_SIGNAL` where there is none, shape (k, 2)."""
    box = plant.box(kind)
    return np.where(np.isfinite(box), box, np.sign(box) * LARGEST_SIGNAL)


def noise_centre(plant: Plant) -> FloatArray:
    """Return the middle of the declared disturbances, 0 where they have no bound, shape (n_w,)."""
    w = np.where(np.isfinite(plant.box("w")), plant.box("w"), 0.0)
    return np.asarray(0.5 * w[:, 0] + 0.5 * w[:, 1])


def about_centre(plant: Plant, centre: FloatArray) -> str:
    """Write w - centre in the user's names, ``(w1 - 2.5, w2)``."""
    pairs = zip(plant.names("w"), centre.tolist(), strict=True)
    words = (f"{w} {'-' if c > 0 else '+'} {abs(c):.17g}" if c else w for w, c in pairs)
    return f"({', '.join(words)})"


def at_centre(plant: Plant, centre: FloatArray) -> str:
    """Say that w is at the centre in the user's names, ``w1 = 2.5, w2 = 0``."""
    pairs = zip(plant.names("w"), centre.tolist(), strict=True)
    return ", ".join(f"{w} = {c:.17g}" for w, c in pairs)
