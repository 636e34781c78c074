"""What `Observer.memory0` is given, checked in the same words by every method."""

from __future__ import annotations

from typing import Any

import numpy as np

from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError


def read_vector(value: Any, what: str, names: tuple[str, ...]) -> FloatArray:
    """Return one finite number for each name."""
    array = _numbers(value)
    if array is None or array.shape != (len(names),) or not np.isfinite(array).all():
        raise ObsynthError(
            f"{what} has to be {len(names)} finite numbers ({', '.join(names)}); got {value!r}",
            option=what,
        )
    return array


def read_box(value: Any, what: str, names: tuple[str, ...]) -> FloatArray:
    """Return a finite pair (lower, upper) for each name, shape (n, 2)."""
    array = _numbers(value)
    if array is not None and array.size == 0 and not names:
        return np.zeros((0, 2))
    if (
        array is None
        or array.shape != (len(names), 2)
        or not np.isfinite(array).all()
        or np.any(array[:, 0] > array[:, 1])
    ):
        raise ObsynthError(
            f"{what} has to be {len(names)} finite pairs lower <= upper ({', '.join(names)}); got "
            f"{value!r}",
            option=what,
        )
    return array


def _numbers(value: Any) -> FloatArray | None:
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        return None
