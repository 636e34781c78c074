"""The memory for the first call: a box of states becomes a box of r."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from obsynth.designs.interval.design import IntervalDesign
from obsynth.designs.interval.exact_arrays import FloatArray
from obsynth.designs.interval.step import first_box, memory_layout
from obsynth.symbolic import ObsynthError

__all__ = ["make_start"]


def make_start(design: IntervalDesign) -> Callable[..., FloatArray]:
    """Return the function behind `Observer.memory0`."""
    plant = design.model.plant
    n, n_f = len(plant.x), design.n_f
    layout = memory_layout(n, len(design.P), n_f)

    def start(
        guess: ArrayLike,
        x_range: ArrayLike | None = None,
        f_range: ArrayLike | None = None,
        y0: ArrayLike | None = None,
    ) -> FloatArray:
        """Start from a box of states; neither the first fault nor y0 are needed."""
        names = ", ".join(plant.names("x"))
        point = np.asarray(guess, dtype=float)
        if point.shape != (n,) or not np.isfinite(point).all():
            raise ObsynthError(f"guess has to be {n} finite numbers ({names}); got {guess!r}")
        box = plant.box("x") if x_range is None else np.asarray(x_range, dtype=float)
        if box.shape != (n, 2) or not np.all(box[:, 0] <= box[:, 1]):
            raise ObsynthError(
                f"x_range has to have the shape ({n}, 2), lower before upper ({names})"
            )
        if not np.isfinite(box).all():
            raise ObsynthError(
                "x_range is needed: the states have no finite declared range, so the first set "
                "has no bound"
            )
        memory = np.zeros(layout["initialised"].stop)
        memory[layout["r_lower"]], memory[layout["r_upper"]] = first_box(design, box)
        memory[layout["prediction"]] = point
        memory[layout["initialised"]] = 1.0
        return memory

    return start
