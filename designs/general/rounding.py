"""What rounding adds in one step, proved for the stored gains, stage by stage.

Each stage as it runs differs from its equation over real numbers by what `rounding_bound` says over
the limits of estimates and inputs and all readings that an admissible plant shows there; what a
rounded L0 leaves of the unknown inputs counts too. All is at most `GeneralDesign.rounding`.
"""

import casadi as ca
import numpy as np

from obsynth.designs.core.boxes import cut_box
from obsynth.designs.core.certificate import Claim
from obsynth.designs.core.equations import curved_states
from obsynth.designs.core.rounding import Bound, rounding_bound
from obsynth.designs.general.record import GeneralDesign, Rounding
from obsynth.designs.general.step import stages
from obsynth.symbolic.arrays import FloatArray

CELLS = 256
# Above the rounding of the formulas here, all of whose terms are nonnegative.
UP = 1.0 + 2.0**-40
# What is stored above what was found, so that another library finds it proved too.
ROOM = 1.0 + 2.0**-10


def shown(design: GeneralDesign) -> FloatArray:
    """Bound the readings of states within the limits, (m,)."""
    plant, limits = design.extended.plant, design.limits
    sx = plant.sx()
    output = ca.Function("shown", [sx.x, sx.u, sx.w], [ca.densify(sx.y)], ["x", "u", "w"], ["y"])
    found = _over(design, output, {"x": limits.x, "u": limits.u, "w": plant.box("w")})["y"]
    return np.asarray(found.size + found.error)


def _over(
    design: GeneralDesign, function: ca.Function, boxes: dict[str, FloatArray]
) -> dict[str, Bound]:
    """Bound the rounding of a function over boxes, cut along the states that matter."""
    plant = design.extended.plant
    bends = np.flatnonzero(curved_states(plant, noise=True)).tolist()
    cells = {"x": cut_box(boxes["x"], CELLS, bends)}
    for name in function.name_in():
        if name != "x":
            box = boxes[name].reshape(-1, 2)
            cells[name] = box[:, :1], box[:, 1:]
    return rounding_bound(function, cells, design.precision, read=("y",))


def needed(design: GeneralDesign) -> Rounding:
    """Bound what one step adds, rounded up."""
    limits, most = design.limits, shown(design)
    boxes = {"x": limits.x, "u": limits.u, "y": np.column_stack([-most, most])}
    first, second, third = stages(design)
    leak = design.extended.leak(design.L0, most)
    corrected = _over(design, second, boxes)
    nu = corrected["nu"]
    most = nu.size + nu.error
    boxes["nu"] = np.column_stack([-most, most])
    return Rounding(
        q=(_over(design, first, boxes)["q"].error + leak) * UP,
        c=corrected["c"].error * UP,
        p=(_over(design, third, boxes)["p"].error + np.abs(design.K) @ nu.error) * UP,
    )


def settle(design: GeneralDesign) -> GeneralDesign:
    """Return a design with gains, its allowances those that its step needs."""
    found = needed(design)
    return design.changed(rounding=Rounding(found.q * ROOM, found.c * ROOM, found.p * ROOM))


def prove_rounding(design: GeneralDesign) -> Claim:
    """Compare the allowances with what one step needs."""
    found, have = needed(design), design.rounding
    room = min(
        float((mine - least).min(initial=np.inf))
        for mine, least in ((have.q, found.q), (have.c, found.c), (have.p, found.p))
    )
    return Claim(
        "rounding",
        "the rounding error of one step is within the allowances",
        bool(room >= 0.0),
        room,
        "interval analysis of the rounding of every instruction",
    )
