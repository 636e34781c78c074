"""The memory for the first call: a box of states becomes a box of r."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from obsynth.designs.interval.record import IntervalDesign
from obsynth.designs.interval.step import first_box, memory_layout
from obsynth.designs.starting import read_box, read_vector
from obsynth.symbolic import ObsynthError
from obsynth.symbolic.arrays import FloatArray


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
        names = plant.names("x")
        point = read_vector(guess, "guess", names)
        if x_range is None and not np.isfinite(plant.box("x")).all():
            raise ObsynthError(
                "x_range is needed: the states have no finite declared range, so the first set "
                "has no bound"
            )
        box = plant.box("x") if x_range is None else read_box(x_range, "x_range", names)
        memory = np.zeros(layout["initialised"].stop)
        memory[layout["r_lower"]], memory[layout["r_upper"]] = first_box(design, box)
        memory[layout["prediction"]] = point
        memory[layout["initialised"]] = 1.0
        return memory

    return start
