"""What is read of a plant: the split, the Jacobians of its g, the box of the disturbances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from obsynth.derive import JacobianBounds, Split, jacobian_bounds, split
from obsynth.derive.errors import StructureError
from obsynth.derive.jacobian.family import AffineFamily
from obsynth.derive.rigour import middle_and_radius
from obsynth.designs.core.given import PlantClass
from obsynth.designs.core.record import Record
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray

CLASS = PlantClass(
    who="the Luenberger observer",
    time="discrete",
    forbids={
        "f": ": this observer estimates states only; use BoundedErrorUIO",
        "d": ": this observer does not decouple unknown inputs; use BoundedErrorUIO",
        "p": " is only known to an interval; give it a value",
        "rho": ": declare it as an input",
    },
    finite={
        "x": " has no finite range, so the Jacobian cannot be bounded; declare it with range=",
        "w": " has no bound; declare it with bound= or range=",
    },
)


@dataclass(frozen=True, eq=False)
class LuenbergerModel(Record):
    """x+ = A x + B u + g(x, u) + W1 w, y = C x + W2 w, with the Jacobians of g in the family."""

    plant: Plant
    A: Annotated[FloatArray, "n n"]
    C: Annotated[FloatArray, "m n"]
    W1: Annotated[FloatArray, "n n_w"]
    W2: Annotated[FloatArray, "m n_w"]
    family: Annotated[AffineFamily, "n n"]
    w_centre: Annotated[FloatArray, "n_w"]
    w_radius: Annotated[FloatArray, "n_w"]


def read(given: Plant | Split, bounds: JacobianBounds | None = None) -> LuenbergerModel:
    """Split the plant and bound the Jacobian of its nonlinear part."""
    parts = split(given, linear="terms") if isinstance(given, Plant) else given
    rounded = [name for name in ("C", "W1", "W2") if parts.proof.rounding[name].any()]
    if rounded or not parts.proof.holds:
        raise StructureError(
            f"{parts.model.name}: the split is not proved to be the plant in doubles ({parts.proof}"
            f"; rounded: {', '.join(rounded) or 'none'}); give the coefficients of outputs and "
            "disturbances as numbers that doubles hold",
            condition="an exact split",
        )
    family = (jacobian_bounds(parts) if bounds is None else bounds).family
    box = parts.model.box("w")
    centre, radius = middle_and_radius(box[:, 0], box[:, 1])
    return LuenbergerModel(
        parts.model, parts.A, parts.C, parts.W1, parts.W2, family, centre, radius
    )
