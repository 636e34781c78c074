"""From a plant to the numbers of the general class: the extended plant and its Jacobians."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from obsynth.derive.forms.extended import Extended, extend
from obsynth.derive.jacobian.bounds import JacobianBounds, jacobian_bounds
from obsynth.derive.rigour import middle_and_radius
from obsynth.derive.structure.following import RTOL
from obsynth.designs.core.given import PlantClass
from obsynth.designs.general.record import Fading, GeneralDesign, PeakBound, Rounding
from obsynth.symbolic import Plant, Role
from obsynth.symbolic.arrays import FloatArray

CLASS = PlantClass(
    who="the bounded-error observer",
    time="discrete",
    faults=(Role.ACTUATOR_FAULT, Role.PROCESS_FAULT, Role.SENSOR_FAULT),
)


@dataclass(frozen=True, eq=False)
class GeneralModel:
    """What is read of a plant; its design is complete except for gain, rounding and bound."""

    extended: Extended
    bounds: JacobianBounds
    design: GeneralDesign


def boxes(extended: Extended) -> tuple[FloatArray, FloatArray]:
    """Return middle and radius of the extended plant's disturbances, shapes (n_v,)."""
    box = extended.plant.box("w").reshape(-1, 2)
    centre, radius = middle_and_radius(box[:, 0], box[:, 1])
    symmetric = box[:, 0] == -box[:, 1]
    return np.where(symmetric, 0.0, centre), np.where(symmetric, box[:, 1], radius)


def read(model: Plant, unfollowed: Sequence[str] = (), divided: Sequence[str] = ()) -> GeneralModel:
    """Extend the plant and bound the Jacobians."""
    extended = extend(model, unfollowed, divided)
    bounds = jacobian_bounds(extended.plant, wrt="joint", rtol=RTOL, effort="fast")
    return of(model, extended, bounds, unfollowed, divided)


def of(
    model: Plant,
    extended: Extended,
    bounds: JacobianBounds,
    unfollowed: Sequence[str],
    divided: Sequence[str],
) -> GeneralModel:
    """Return a design without gain for what was derived of a plant."""
    N, m = extended.L0.shape
    centre, radius = boxes(extended)
    none = np.zeros(N)
    nothing = np.zeros((N, N))
    design = GeneralDesign(
        plant=model,
        unfollowed=tuple(unfollowed),
        divided=tuple(divided),
        v_centre=centre,
        v_radius=radius,
        L0=np.array(extended.L0.evalf(25).tolist(), dtype=float).reshape(N, m),
        Z=np.zeros((N, m)),
        K=np.zeros((N, m)),
        family=bounds.family,
        rounding=Rounding(none, none, none),
        bound=PeakBound(np.zeros(2 * N), Fading(nothing, nothing, nothing, 0.0, None)),
        options={},
    )
    design.__dict__["extended"] = extended
    return GeneralModel(extended, bounds, design)


def read_again(design: GeneralDesign) -> GeneralModel:
    """Derive everything anew from the stored equations."""
    return read(design.plant, design.unfollowed, design.divided)
