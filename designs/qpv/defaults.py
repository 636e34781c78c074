"""Sets that follow from the declared ranges, where an option does not give them."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from obsynth.derive import QPV
from obsynth.derive.errors import StructureError
from obsynth.designs.qpv.region import Ellipsoid
from obsynth.symbolic import Plant


def default_sets(form: QPV) -> Mapping[str, Any]:
    """Return region, E_x and initial_error by name.

    region: the smallest ellipsoid with axes along the coordinates and sides in proportion to the
        declared ranges that holds all of them
    E_x: half of the half ranges, of the states or, where their errors enter the dynamics, of all
    initial_error: a tenth of the half ranges of the states; no fault at the start, as
        `Observer.memory0` takes it
    """
    plant = form.model
    boxes = np.vstack([plant.box("x"), plant.box("f").reshape(-1, 2)])
    loose = [s.name for s in (*plant.x, *plant.f) if not s.bounded]
    if loose:
        raise StructureError(
            f"{', '.join(loose)} has no range, from which region= would follow; declare it with "
            "range=, or give region=Ellipsoid(Q, c), one coordinate for every state and fault",
            symbol=loose[0],
            symbols=tuple(loose),
            condition="a region",
        )
    half, n = 0.5 * np.diff(boxes, axis=1)[:, 0], len(plant.x)
    return {
        "region": Ellipsoid(len(half) * half**2, boxes.mean(axis=1)),
        "E_x": 0.5 * (half[:n] if form.form_of_N == "upper" else half),
        "initial_error": np.append(0.1 * half[:n], np.zeros(len(half) - n)),
    }


def takes_rate(plant: Plant) -> bool:
    """Whether there are disturbances or fault rates, and all disturbances have bounds."""
    moving = any(s.rate for s in plant.f)
    return bool(plant.w or moving) and all(s.bounded for s in plant.w)
