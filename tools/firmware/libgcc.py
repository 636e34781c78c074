"""Sums of doubles as GCC's library for ARM returns them, where no FPU has doubles.

`__aeabi_dadd` (libgcc/config/arm/ieee754-df.S, GCC 12 to 14) shifts the smaller operand in two
words. By 33 places, one bit of its low word that decides the rounding is kept as "not zero" only:
if the sum loses its first bit and has to be shifted back, it is rounded down, not to nearest.
"""

import numpy as np


def soft_sum(a, b):
    """Return a + b of two arrays."""
    a, b = np.broadcast_arrays(np.asarray(a, float), np.asarray(b, float))
    with np.errstate(all="ignore"):
        total = a + b
        back = total - a
        rest = (a - (total - back)) + (b - back)  # what rounding has taken, exactly
        down = np.where(rest < 0.0, np.nextafter(total, -np.inf), total)
        first, second = (np.maximum(np.frexp(v)[1], -1021) for v in (a, b))
        apart = np.abs(first - second) == 33
        opposite = (a < 0.0) != (b < 0.0)
        power = np.ldexp(1.0, np.maximum(first, second) - 1)
        # below the power of two before it is rounded
        inwards = np.where(total < 0.0, -rest, rest)
        lost = (np.abs(total) < power) | ((np.abs(total) == power) & (inwards < 0.0))
        finite = np.isfinite(a) & np.isfinite(b) & (a != 0.0) & (b != 0.0)
        return np.where(finite & apart & opposite & lost, down, total)
