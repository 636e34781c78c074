"""Draw long signals with few points and without losing a peak."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

__all__ = ["thin"]

Array = NDArray[np.float64]


def thin(t: Array, values: Array, columns: int = 500) -> tuple[Array, Array]:
    """Keep first, smallest, largest and last value of each of `columns` slices in time.

    At a resolution of `columns` pixels the picture is the same as that of all
    points, as every column shows its whole extent.

    Parameters
    ----------
    t, values : (N,)
    columns : int
        Slices in time, about the width of the plot in pixels.

    Returns
    -------
    t, values : (at most 4 * columns,)

    Examples
    --------
    >>> t = np.arange(10_000.0)
    >>> spike = np.where(t == 7777.0, 1.0, 0.0)
    >>> few_t, few = thin(t, spike, columns=100)
    >>> len(few) <= 400, float(few.max())
    (True, 1.0)
    """
    n = len(t)
    if n <= 4 * columns:
        return t, values
    edges = np.linspace(0, n, columns + 1).astype(int)
    keep = set()
    for start, stop in pairwise(edges):
        part = values[start:stop]
        finite = np.where(np.isfinite(part), part, 0.0)
        keep |= {start, stop - 1, start + int(finite.argmin()), start + int(finite.argmax())}
    index = np.array(sorted(keep))
    return t[index], values[index]
