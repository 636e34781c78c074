"""Noise that every language can reproduce: the SplitMix64 generator."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from obsynth.symbolic.errors import PlantError

_INCREMENT = np.uint64(0x9E3779B97F4A7C15)
_FACTORS = (np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB))
_SHIFTS = (np.uint64(30), np.uint64(27), np.uint64(31))
_DROPPED = np.uint64(11)


def splitmix64(seed: int, count: int) -> NDArray[np.float64]:
    """Return numbers uniform in [0, 1), the same on every machine. Shapes: returns (count,).

    Steele, Lea, Flood: Fast splittable pseudorandom number generators, OOPSLA 2014.
    """
    if isinstance(seed, bool) or int(seed) != seed or not 0 <= seed < 2**64:
        raise PlantError(f"seed={seed!r} is not a whole number from 0 to 2^64 - 1", seed=seed)
    steps = np.arange(1, count + 1, dtype=np.uint64)
    z = np.uint64(seed) + steps * _INCREMENT
    for shift, factor in zip(_SHIFTS, _FACTORS, strict=False):
        z = (z ^ (z >> shift)) * factor
    z = z ^ (z >> _SHIFTS[2])
    return (z >> _DROPPED).astype(np.float64) * 2.0**-53


def bounded_noise(seed: int, steps: int, bound: ArrayLike) -> NDArray[np.float64]:
    """Return noise uniform in [-bound, bound): one row for each sample, drawn row by row.

    Shapes: bound (n_w,), returns (steps + 1, n_w).
    """
    size = np.atleast_1d(np.asarray(bound, dtype=np.float64))
    drawn = splitmix64(seed, (steps + 1) * len(size)).reshape(steps + 1, len(size))
    return size * (2.0 * drawn - 1.0)
