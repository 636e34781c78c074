"""What rounding adds to the root of V, proved for the stored gains.

One step as it runs is off by delta, elementwise, from the Runge-Kutta step of real numbers with the
plant's own constants, for a state in X, estimates with an error in E, readings that an admissible
plant shows and are rounded. With V' <= rate (limit - V) the root of the bound of V shrinks
differences by exp(-rate Ts / 2) a step, so that after any number of steps

    V^1/2 <= level^1/2 + rho / (1 - exp(-rate Ts / 2)) ,    rho = (delta'|P| delta)^1/2 .

That is at most `QPVDesign.rounding`, and E made larger by it is the E meant above. Innovations are
no larger than C e + H w, of later stages than that and what C makes of the rates before: far less
than readings and expectations by themselves, which is what makes delta sharp.
"""

import functools
from dataclasses import replace

import casadi as ca
import numpy as np

from obsynth.derive.rigour import Interval
from obsynth.designs.core.boxes import cut_box
from obsynth.designs.core.rounding import Bound, rounding_bound
from obsynth.designs.core.signals import finite_box
from obsynth.designs.qpv.equations import STAGES, Equations, build_update, symbols_of
from obsynth.designs.qpv.record import ASSUMED, QPVDesign
from obsynth.symbolic.arrays import FloatArray

# Of the error set: above it a bound of rounding is no help.
USEFUL = {"double": 2.0**-20, "single": 0.25}
# Above the rounding of the formulas here, all of whose terms are nonnegative.
UP = 1.0 + 2.0**-40
# What is stored above what was found, so that another library finds it proved too.
ROOM = 1.0 + 2.0**-10
_CELLS = 256


def _boxes(design: QPVDesign, half: FloatArray) -> dict[str, Interval]:
    """Return boxes of states about the middle of the region, and of what the step is given."""
    plant = design.plant
    state = design.region.c[:, None] + half[:, None] * [-1.0, 1.0]
    boxes = {kind: finite_box(plant, kind, design.precision) for kind in ("u", "rho", "w")}
    boxes = {kind: box.reshape(-1, 2) for kind, box in boxes.items()}
    boxes["theta"] = boxes.pop("rho")[[s.measured for s in plant.rho]]
    return {"state": cut_box(state, _CELLS)} | {k: (b[:, :1], b[:, 1:]) for k, b in boxes.items()}


def _reach(design: QPVDesign) -> FloatArray:
    """Half widths of the error set made larger by the allowance, (n,)."""
    return np.asarray((1.0 + design.rounding) * np.sqrt(design.inverse_diagonal) * UP)


def _shown(design: QPVDesign, half: FloatArray, noise: bool) -> Bound:
    """Bound outputs and their rounding, (m,), for any noise or for its middle."""
    plant = design.plant
    inputs = {"state": ca.SX.sym("state", len(design.P)), **symbols_of(plant)}
    inputs["y"] = ca.SX.sym("w", len(plant.w)) if noise else ca.SX(ca.DM(design.w_centre))
    state, u, w, theta = inputs.values()
    given = {"state": state, "u": u, "theta": theta} | ({"w": w} if noise else {})
    output = Equations(design).model(state, u, theta, w)[1]
    function = ca.Function("y", [*given.values()], [ca.densify(output)], [*given], ["y"])
    boxes = _boxes(design, half)
    return rounding_bound(function, {name: boxes[name] for name in given}, design.precision)["y"]


def of_outputs(design: QPVDesign) -> FloatArray:
    """Bound what rounding adds to an expected reading, (m,), where the error is in E."""
    half = design.region.half_widths + _reach(design)
    return _shown(design, half, noise=False).error * UP


def of_step(design: QPVDesign) -> FloatArray:
    """Bound what one step as it runs adds to the estimates, (n,)."""
    plant, data, update = design.plant, design.data, build_update(design)
    n_w, reach = len(plant.w), _reach(design)
    C, H = (np.abs(block) for block in (data.C, data.H[:, :, :n_w]))
    C, H = (C + data.C_radius).max(axis=0), (H + data.H_radius[:, :n_w]).max(axis=0)
    radius = np.zeros(0) if design.noise is None else design.noise.radius[:n_w]
    most = _shown(design, design.region.half_widths * UP, noise=True).size[:, None] * UP
    box = {**_boxes(design, design.region.half_widths + reach), "y": (-most, most)}
    box.pop("w")
    first = (C @ reach + H @ radius) * UP
    known: dict[str, Interval] = {}
    found: dict[str, Bound] = {}
    for j, at in enumerate(STAGES, 1):
        moved = at * design.Ts * found[f"k{j - 1}"].size if at else np.zeros(len(reach))
        size = (first + C @ moved)[:, None] * UP
        known[f"nu{j}"] = -size, size
        found = rounding_bound(update, box, design.precision, known, read=("y",))
    return found["after"].error


@functools.lru_cache(maxsize=8)
def needed(design: QPVDesign) -> float:
    """Bound what all steps add to the root of V while its bound is up to `rounding` too small."""
    delta, rate = of_step(design), Equations(design).level_rate()[0]
    rho = float(np.sqrt(delta @ np.abs(design.P) @ delta)) * UP
    shrinks = -float(np.expm1(-0.5 * rate * design.Ts))
    return rho / shrinks * UP if shrinks > 0.0 and np.isfinite(rho) else np.inf


def settle(design: QPVDesign) -> QPVDesign:
    """Return a design with gains, its allowance that of the gains; nothing where no set follows.

    Where in doubles the bound is of no use, 2^-40 of E is assumed.
    """
    if not design.bounded:
        return replace(design, rounding=0.0)
    limit = USEFUL[design.precision]
    at_most = needed(replace(design, rounding=limit))
    if at_most > limit:
        assumed = ASSUMED if design.precision == "double" else np.inf
        return replace(design, rounding=assumed)
    value = needed(replace(design, rounding=at_most * ROOM)) * ROOM
    return replace(design, rounding=min(value, at_most * ROOM))
