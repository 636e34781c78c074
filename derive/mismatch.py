"""What parameters in intervals do to equations that are written with values in their place."""

from collections.abc import Mapping

import casadi as ca
import numpy as np

from obsynth.derive.errors import UnboundedError
from obsynth.derive.intervals.ranges import bound_ranges
from obsynth.symbolic import Plant
from obsynth.symbolic.altered import MISMATCHES
from obsynth.symbolic.arrays import FloatArray


def mismatch(plant: Plant, values: Mapping[str, float]) -> FloatArray:
    """Bound what rows and outputs differ by over the ranges of everything, (n + m, 2).

    By the mean value theorem: a derivative by a parameter times how far it is from its value.
    """
    sx = plant.sx()
    rows = ca.vertcat(sx.rhs, sx.y)
    places = [plant.names("p").index(name) for name in values]
    off = ca.SX.sym("off", len(places))
    change = ca.jacobian(rows, sx.p)[:, places] @ off
    kinds = ("x", "u", "d", "f", "w", "p", "rho")
    variables = ca.vertcat(*(getattr(sx, kind) for kind in kinds), off)
    away = plant.box("p").reshape(-1, 2)[places] - np.array([*values.values()])[:, None]
    box = np.vstack([*(plant.box(kind).reshape(-1, 2) for kind in kinds), away])
    box = np.nextafter(box, [-np.inf, np.inf])
    found = np.zeros((rows.numel(), 2))
    for i in range(rows.numel()):
        used = np.flatnonzero(ca.which_depends(change[i], variables, 1, False)).tolist()
        if not used:
            continue
        if not np.isfinite(box[used]).all():
            k = next(k for k in used if not np.isfinite(box[k]).all())
            raise UnboundedError(
                f"what the parameters do to an equation of {plant.name} has no bound: "
                f"{variables[k]} has no range.",
                symbol=str(variables[k]),
            )
        ranges = bound_ranges(change[i], variables[used], box[used], rtol=1e-3)
        found[i] = ranges.lower[0], ranges.upper[0]
        if not np.isfinite(found[i]).all():
            raise UnboundedError(
                f"what the parameters do to row {i + 1} of {plant.name} has no bound."
            )
    return found


MISMATCHES[:] = [mismatch]
