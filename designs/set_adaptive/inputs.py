"""Checks of what `Observer.memory0` is given."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.symbolic import Plant
from obsynth.symbolic.errors import ObsynthError

__all__ = ["read_box", "read_vector"]

FloatArray = NDArray[np.float64]


def read_vector(value: Any, plant: Plant) -> FloatArray:
    """Check the guess of `memory0`."""
    array = np.asarray(value, dtype=float)
    names = plant.names("x")
    if array.shape != (len(names),) or not np.all(np.isfinite(array)):
        raise ObsynthError(
            f"guess has to be {len(names)} finite numbers ({', '.join(names)}); got {value!r}"
        )
    return array


def read_box(value: Any, default: FloatArray, what: str, names: tuple[str, ...]) -> FloatArray:
    """Check a box of `memory0`, or take the declared one."""
    box = default if value is None else np.asarray(value, dtype=float)
    if box.shape != default.shape or not np.all(np.isfinite(box)) or np.any(box[:, 0] > box[:, 1]):
        raise ObsynthError(
            f"{what} has to be {len(names)} finite pairs lower <= upper ({', '.join(names)}); got "
            f"{value!r}",
            option=what,
        )
    return box
