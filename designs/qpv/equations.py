"""The plant's functions as the observer follows them, one step of (7), and what rounding adds.

One step as it runs is off by delta, elementwise, from the Runge-Kutta step of real numbers with the
plant's own constants, for a state in X, estimates with an error in E, readings that an admissible
plant shows and are rounded. With V' <= rate (limit - V) the root of the bound of V shrinks
differences by exp(-rate Ts / 2) a step, so that after any number of steps

    V^1/2 <= level^1/2 + rho / (1 - exp(-rate Ts / 2)) ,    rho = (delta'|P| delta)^1/2 .

That is at most `QPVDesign.rounding`, and E made larger by it is the E meant above. Innovations are
no larger than C e + H w, of later stages than that and what C makes of the rates before: far less
than readings and expectations by themselves, which is what makes delta sharp.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import sympy as sp

from obsynth.derive.rigour import Interval
from obsynth.designs.core.boxes import column, cut_box
from obsynth.designs.core.half_widths import above
from obsynth.designs.core.rounding import Bound, rounding_bound
from obsynth.designs.core.signals import finite_box
from obsynth.designs.core.stepping import inside
from obsynth.designs.qpv.record import ASSUMED, QPVDesign
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.convert import to_sx
from obsynth.symbolic.signals import Signal
from obsynth.symbolic.text import read_text

STAGES = (0.0, 0.5, 0.5, 1.0)
"""Where in a sample the Runge-Kutta formula of order four evaluates."""
WEIGHTS = (1.0, 2.0, 2.0, 1.0)
"""What it weighs each by, in sixths."""
# Of the error set: above it a bound of rounding is no help.
USEFUL = {"double": 2.0**-20, "single": 0.25}
# Above the rounding of the formulas here, all of whose terms are nonnegative.
UP = 1.0 + 2.0**-40
# What is stored above what was found, so that another library finds it proved too.
ROOM = 1.0 + 2.0**-10
_CELLS = 256


def measured_schedule(plant: Plant) -> tuple[Signal, ...]:
    """Scheduling signals whose values the step is given, in the order of declaration."""
    return tuple(s for s in plant.rho if s.measured)


def vertex_weights(design: QPVDesign, u: ca.SX, theta: ca.SX) -> ca.SX:
    """Return the weights of the vertices, (V, 1); rounding may take a variable past its ends."""
    weights = [ca.SX(1)]
    for value, (low, high) in zip(
        _values(design, u, theta), design.family.ranges.tolist(), strict=True
    ):
        if low == high:
            continue
        share = ca.fmin(ca.fmax((value - low) / (high - low), 0.0), 1.0)
        weights = [weight * part for weight in weights for part in (1.0 - share, share)]
    return ca.vertcat(*weights)


def _values(design: QPVDesign, u: ca.SX, theta: ca.SX) -> list[ca.SX]:
    plant = design.plant
    signals = [*plant.u, *measured_schedule(plant)]
    entries = ca.vertsplit(ca.vertcat(u, theta)) if signals else []
    table = {s.symbol: entry for s, entry in zip(signals, entries, strict=True)}
    symbols: dict[str, sp.Symbol] = {s.name: s.symbol for s in signals}
    expressions = [read_text(text, symbols) for text in design.scheduling]
    return to_sx(expressions, table, list(design.scheduling)) if expressions else []


@dataclass(frozen=True, eq=False)
class Equations:
    """The plant's functions at the middle of the disturbances, and the scheduled gain."""

    design: QPVDesign

    def model(
        self, state: ca.SX, u: ca.SX, theta: ca.SX, w: ca.SX | None = None
    ) -> tuple[ca.SX, ca.SX]:
        """Right-hand side and output for an augmented state, w at its middle where not given."""
        plant = self.design.plant
        n = len(plant.x)
        names = [s.name for s in measured_schedule(plant)]
        # what is not measured enters nowhere: the design refuses it
        rho = [theta[names.index(s.name)] if s.name in names else ca.SX(0) for s in plant.rho]
        noise = ca.DM(self.design.w_centre) if w is None else w
        found = plant.function()(x=state[:n], u=u, f=state[n:], w=noise, rho=column(rho))
        return found["rhs"], found["y"]

    def innovation(self, state: ca.SX, u: ca.SX, y: ca.SX, theta: ca.SX) -> ca.SX:
        """Return readings less what is expected."""
        return y - self.model(state, u, theta)[1]

    def rate(self, state: ca.SX, u: ca.SX, theta: ca.SX, gain: ca.SX, innovation: ca.SX) -> ca.SX:
        """Equation (7)."""
        still = ca.SX.zeros(len(self.design.plant.f))
        return ca.vertcat(self.model(state, u, theta)[0], still) + ca.mtimes(gain, innovation)

    def gain(self, u: ca.SX, theta: ca.SX) -> ca.SX:
        """L(theta)."""
        weights = vertex_weights(self.design, u, theta)
        total = ca.SX.zeros(*self.design.L.shape[1:])
        for k, gain in enumerate(self.design.L):
            total += weights[k] * ca.DM(gain)
        return total

    def scheduled(self, theta: ca.SX) -> ca.SX:
        """Whether what is measured for the scheduling lies in its ranges."""
        plant = self.design.plant
        ranges = plant.box("rho").reshape(-1, 2)[[s.measured for s in plant.rho]]
        return inside(theta, theta, ranges, self.design.precision)

    def level_rate(self) -> tuple[float, float]:
        """Rate and limit of the bound of V: V' <= rate (limit - V)."""
        noise = self.design.noise
        if noise is not None:
            return noise.rate, 1.0
        return (self.design.alpha, 0.0) if self.design.bounded else (0.0, 0.0)

    def next_level(self, level: ca.SX) -> ca.SX:
        """Bound of V one sample later: V' <= rate (limit - V), exactly, and rounded up."""
        rate, limit = self.level_rate()
        up = above(self.design.precision, 4)
        lost, share = -np.expm1(-rate * self.design.Ts), np.exp(-rate * self.design.Ts)
        after = float(limit * lost * up) + float(share * up) * level
        return ca.fmin(after, ca.fmax(level, limit))


def symbols_of(plant: Plant) -> dict[str, ca.SX]:
    """Return symbols for what the step is given."""
    names = {"u": len(plant.u), "y": len(plant.output), "theta": len(measured_schedule(plant))}
    return {name: ca.SX.sym(name, size) for name, size in names.items()}


def build_update(design: QPVDesign) -> ca.Function:
    """(state, u, y, theta) -> estimates after a Runge-Kutta step, nu and rates of its stages."""
    equations, inputs = Equations(design), symbols_of(design.plant)
    state = ca.SX.sym("state", len(design.P))
    u, y, theta = inputs["u"], inputs["y"], inputs["theta"]
    gain, rates = equations.gain(u, theta), [ca.SX.zeros(len(design.P))]
    total, found = ca.SX(0), dict[str, ca.SX]()
    for j, (at, weight) in enumerate(zip(STAGES, WEIGHTS, strict=True), 1):
        now = state + at * design.Ts * rates[-1] if at else state
        nu = equations.innovation(now, u, y, theta)
        rates.append(equations.rate(now, u, theta, gain, nu))
        total = total + (weight * rates[-1] if weight != 1.0 else rates[-1])
        found |= {f"nu{j}": nu, f"k{j}": rates[-1]}
    found = {"after": state + design.Ts / 6.0 * total, **found}
    return ca.Function(
        "update", [state, u, y, theta], [*found.values()], ["state", *inputs], [*found]
    )


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
