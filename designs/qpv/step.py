"""The run-time functions of the observer: the differential equation (7) and its fixed step."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from obsynth.designs.core.boxes import Ends, cut_box, select
from obsynth.designs.core.core import Core, Known, Parts, Seen
from obsynth.designs.core.given import Start, read_vector
from obsynth.designs.core.limits import LIMITS
from obsynth.designs.core.rounding import rounding_bound
from obsynth.designs.core.signals import finite_box
from obsynth.designs.core.stepping import all_finite, largest_level, make_ode, slices
from obsynth.designs.qpv.record import QPVDesign
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.convert import to_sx
from obsynth.symbolic.signals import Signal
from obsynth.symbolic.text import read_text

SETTLED = 20.0
"""Time constants of the bound of V for which a copy is kept by default."""
# Above the rounding of the few dozen operations behind every returned number.
_UP = 1.0 + 2.0**-40
# What the root of V is at estimates that were placed anew.
_PLACED = 0.999
# Of the error set: above it a bound of rounding is no help.
_USEFUL = 2.0**-20
_CELLS = 256


def memory_sizes(design: QPVDesign) -> dict[str, int]:
    """Return the parts of the memory vector.

    ``xhat``, ``fhat`` and ``level`` (a bound of V = e'P e, infinite where none is known).
    """
    plant = design.plant
    return {"xhat": len(plant.x), "fhat": len(plant.f), "level": 1}


def first_memory(
    design: QPVDesign, start: Start, fhat0: ArrayLike | None = None
) -> dict[str, ArrayLike]:
    """Start at the guess; fhat0 is the middle of f_range, or given; y0 is not needed."""
    plant = design.plant
    fhat = start.f.mean(axis=1) if fhat0 is None else read_vector(fhat0, "fhat0", plant.names("f"))
    state = np.concatenate([start.guess, fhat])
    x_box = plant.box("x") if start.x_range is None else start.x_range
    box = np.concatenate([x_box, start.f]) - state[:, None]
    offset = state - design.region.c
    level = float((np.sqrt(offset @ design.P @ offset) + design.reset) ** 2 * _UP)
    if np.isfinite(box).all():
        level = min(level, largest_level(design.P, box[:, 0], box[:, 1]))
    return {"xhat": start.guess, "fhat": fhat, "level": level if level <= 1.0 else np.inf}


def measured_schedule(plant: Plant) -> tuple[Signal, ...]:
    """Scheduling signals whose values the step is given, in the order of declaration."""
    return tuple(s for s in plant.rho if s.measured)


def vertex_weights(design: QPVDesign, u: ca.SX, theta: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return the weights of the vertices, and whether the scheduling lies in its range.

    Shapes: weights (V, 1).
    """
    values = _values(design, u, theta)
    weights, inside = [ca.SX(1)], ca.SX(1)
    for value, (low, high) in zip(values, design.family.ranges.tolist(), strict=True):
        inside = ca.logic_and(inside, ca.logic_and(value >= low, value <= high))
        if low == high:
            continue
        share = ca.fmin(ca.fmax((value - low) / (high - low), 0.0), 1.0)
        weights = [weight * part for weight in weights for part in (1.0 - share, share)]
    return ca.vertcat(*weights), inside


def _values(design: QPVDesign, u: ca.SX, theta: ca.SX) -> list[ca.SX]:
    plant = design.plant
    signals = [*plant.u, *measured_schedule(plant)]
    entries = ca.vertsplit(ca.vertcat(u, theta)) if signals else []
    table = {s.symbol: entry for s, entry in zip(signals, entries, strict=True)}
    symbols: dict[str, sp.Symbol] = {s.name: s.symbol for s in signals}
    expressions = [read_text(text, symbols) for text in design.scheduling]
    return to_sx(expressions, table, list(design.scheduling)) if expressions else []


@dataclass(frozen=True, eq=False)
class _Equations:
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
        rho = [theta[names.index(s.name)] if s.name in names else 0 for s in plant.rho]
        rhs, y = plant.function()(
            state[:n],
            u,
            ca.DM.zeros(0),
            state[n:],
            ca.DM(self.design.w_centre) if w is None else w,
            ca.DM.zeros(0),
            ca.vertcat(*rho) if rho else ca.DM.zeros(0),
        )
        return rhs, y

    def rate(self, state: ca.SX, u: ca.SX, y: ca.SX, theta: ca.SX, gain: ca.SX) -> ca.SX:
        """Equation (7)."""
        rhs, expected = self.model(state, u, theta)
        still = ca.SX.zeros(len(self.design.plant.f))
        return ca.vertcat(rhs, still) + ca.mtimes(gain, y - expected)

    def gain(self, u: ca.SX, theta: ca.SX) -> tuple[ca.SX, ca.SX]:
        """L(theta) and whether theta is in its range."""
        weights, ok = vertex_weights(self.design, u, theta)
        total = ca.SX.zeros(*self.design.L.shape[1:])
        for k, gain in enumerate(self.design.L):
            total += weights[k] * ca.DM(gain)
        return total, ok

    def level_rate(self) -> tuple[float, float]:
        """Rate and limit of the bound of V: V' <= rate (limit - V)."""
        noise = self.design.noise
        if noise is not None:
            return noise.rate, 1.0
        return (self.design.alpha, 0.0) if self.design.bounded else (0.0, 0.0)

    def next_level(self, level: ca.SX) -> ca.SX:
        """Bound of V one sample later: V' <= rate (limit - V), exactly."""
        rate, limit = self.level_rate()
        share = float(np.exp(-rate * self.design.Ts))
        after = limit * (1.0 - share) + share * level * (1.0 + 2.0**-50)
        return ca.fmin(after, ca.fmax(level, limit)) if limit else after


def _symbols(plant: Plant) -> dict[str, ca.SX]:
    names = {
        "u": len(plant.u),
        "y": len(plant.output),
        "theta": len(measured_schedule(plant)),
    }
    return {name: ca.SX.sym(name, size) for name, size in names.items()}


def build_ode(design: QPVDesign) -> ca.Function:
    """Return `Observer.ode`: (memory, u, y[, theta]) -> dmemory."""
    plant = design.plant
    layout = slices(memory_sizes(design))
    memory = ca.SX.sym("memory", layout["level"].stop)
    found = _symbols(plant)
    u, y, theta = found["u"], found["y"], found["theta"]
    equations = _Equations(design)
    gain, _ = equations.gain(u, theta)
    state = memory[: layout["fhat"].stop]
    level = memory[layout["level"]]
    rate, limit = equations.level_rate()
    grown = ca.if_else(level <= 1.0, rate * (limit - level), 0.0)
    d_state = equations.rate(state, u, y, theta, gain)
    outputs = ca.vertcat(d_state, grown)
    return make_ode({"memory": memory, **found}, outputs)


@dataclass(frozen=True, eq=False)
class _Sizes:
    """Numbers that the monitors need, from the proved P."""

    half: FloatArray
    reach: FloatArray
    noise: FloatArray
    region: float
    inverse_Q: FloatArray

    @classmethod
    def of(cls, design: QPVDesign) -> _Sizes:
        P, Q, data = design.P, design.region.Q, design.data
        inverse = np.linalg.inv(P)
        outputs = np.einsum("vmi,ij,vmj->vm", data.C, inverse, data.C).max(axis=0)
        box = design.plant.box("w")
        radius = np.where(
            np.isfinite(box).all(axis=1),
            np.maximum(box[:, 1] - design.w_centre, design.w_centre - box[:, 0]),
            np.inf,
        )
        H = np.abs(data.H[:, :, : len(radius)]).max(axis=0)
        with np.errstate(invalid="ignore"):
            noise = np.where(H > 0, H * radius, 0.0).sum(axis=1)
        root = np.linalg.cholesky(inverse)
        largest = np.linalg.eigvalsh(root.T @ np.linalg.solve(Q, root))[-1]
        return cls(
            np.sqrt(design.inverse_diagonal) * _UP,
            np.sqrt(outputs) * _UP,
            noise * _UP,
            float(np.sqrt(largest)) * _UP,
            np.asarray(np.linalg.inv(Q), dtype=np.float64),
        )


def _inside_region(sizes: _Sizes, offset: ca.SX, reach: ca.SX) -> ca.SX:
    """Whether offset + {e'P e <= reach^2} lies in the ellipsoid X - c: triangle inequality."""
    distance = ca.sqrt(_form(sizes.inverse_Q, offset))
    return distance + reach * sizes.region <= 1.0


def build_core(design: QPVDesign) -> Core:
    """Build the Runge-Kutta step of order four with u, y and theta held, and the bound of V.

    The sets of an instant follow from readings before it. One that is missing is replaced by what
    is expected, which says nothing of V from then on: the bound begins anew.
    """
    n, m = len(design.plant.x), len(design.plant.output)
    equations, sizes, follow = _Equations(design), _Sizes.of(design), build_update(design)
    added = allowance(design).value

    def run(seen: Seen) -> Known:
        state = ca.vertcat(seen.memory["xhat"], seen.memory["fhat"])
        scheduled = equations.gain(seen.u, seen.theta)[1]
        expected = equations.model(state, seen.u, seen.theta)[1]
        y = seen.readings(expected)
        offset = state - ca.DM(design.region.c)
        level = seen.memory["level"]
        if design.reset < 1.0:
            level = ca.fmin(level, _region_level(design, offset))
        certified = ca.logic_and(level <= 1.0, scheduled)
        reach = ca.sqrt(level) + added if design.bounded else ca.SX(1)
        consistent = ca.SX(1)
        for i in range(m):
            if np.isfinite(sizes.noise[i]):
                allowed = reach * sizes.reach[i] + sizes.noise[i] + 2.0**-40 * ca.fabs(y[i])
                fits = ca.fabs(y[i] - expected[i]) <= allowed
                consistent = ca.logic_and(consistent, fits)
        in_region = _inside_region(sizes, offset, reach if design.bounded else ca.SX(0))
        x = f = None
        if design.bounded:
            half = ca.DM(sizes.half) * reach
            half = half + 2.0**-40 * (ca.fabs(state) + half)
            found = Ends(state - half, state + half).where(
                certified, Ends.unbounded(state.numel(), design.precision)
            )
            x = Ends(found.lower[:n], found.upper[:n])
            f = Ends(found.lower[n:], found.upper[n:])
        after = follow(state, seen.u, y, seen.theta)
        going = all_finite(after, LIMITS[design.precision].finite)
        after = select(going, after, state)
        moved = {"xhat": after[:n], "fhat": after[n:], "level": equations.next_level(level)}
        return Known(
            state[:n],
            state[n:],
            x,
            f,
            moved,
            sound=ca.logic_and(ca.logic_and(certified, seen.all_used), going),
            empty=ca.logic_and(certified, ca.logic_not(consistent)),
            outside=ca.logic_not(ca.logic_and(certified, in_region)),
            valid=certified,
        )

    def begin(x: Ends, f: Ends, kept: Parts) -> Parts:
        state = ca.vertcat(kept["xhat"], kept["fhat"])
        box = Ends(ca.vertcat(x.lower, f.lower), ca.vertcat(x.upper, f.upper))
        return {"level": _box_level(design, box, state) * _UP}

    def place(x: Ends, f: Ends, kept: Parts) -> Parts:
        """Move the estimates towards the middle, as little as their bound needs to be below 1."""
        box = Ends(ca.vertcat(x.lower, f.lower), ca.vertcat(x.upper, f.upper))
        middle, state = box.middle(design.precision), ca.vertcat(kept["xhat"], kept["fhat"])
        state = select(all_finite(state, LIMITS[design.precision].finite), state, middle)
        least, away = ca.sqrt(_box_level(design, box, middle)), _length(design, state - middle)
        share = ca.fmin((_PLACED - least) / ca.fmax(away, _PLACED - least), 1.0)
        share = ca.if_else(least < _PLACED, share, 1.0)
        state = middle + share * (state - middle)
        placed = {"xhat": state[:n], "fhat": state[n:]}
        return placed if design.bounded else {**placed, **begin(x, f, placed)}

    c, half = design.region.c[:n], design.region.half_widths[:n]
    domain = np.column_stack([c - half * _UP, c + half * _UP])
    return Core(run, begin, place, domain=domain, bridges=True, nonnegative=("level",))


def found_again(design: QPVDesign) -> bool:
    """Whether the bound of V begins below 1 from the declared ranges, around their middle."""
    boxes = [design.plant.box(kind).reshape(-1, 2) for kind in ("x", "f")]
    reach = 0.5 * np.diff(np.vstack(boxes), axis=1)[:, 0]
    return design.reset < 1.0 or bool(reach @ np.abs(design.P) @ reach <= 1.0)


def shared(design: QPVDesign) -> tuple[str, ...]:
    """Return what both copies have in common: the level too where no set follows from it."""
    return ("xhat", "fhat") if design.bounded else ("xhat", "fhat", "level")


def _form(matrix: FloatArray, vector: ca.SX) -> ca.SX:
    """Return v'M v for a symmetric M."""
    total = ca.SX(0)
    for i in range(len(matrix)):
        row = matrix[i, i] * vector[i]
        for j in range(i + 1, len(matrix)):
            row += 2.0 * matrix[i, j] * vector[j]
        total += row * vector[i]
    return total


def _length(design: QPVDesign, vector: ca.SX) -> ca.SX:
    """Bound the root of v'P v, and of |v|'|P||v|, by sum P_ii^1/2 |v_i|."""
    return ca.dot(ca.DM(np.sqrt(np.diag(design.P)) * _UP), ca.fabs(vector))


def _box_level(design: QPVDesign, box: Ends, state: ca.SX) -> ca.SX:
    """Bound V for a truth in a box by sum |P_ij| r_i r_j, up to rounding."""
    return _form(np.abs(design.P), ca.fmax(box.upper - state, state - box.lower))


def _region_level(design: QPVDesign, offset: ca.SX) -> ca.SX:
    """Bound V for a truth in the region, by the triangle inequality."""
    rounding = 2.0**-44 * _length(design, offset) ** 2
    away = ca.sqrt(ca.fmax(_form(design.P, offset), 0.0) + rounding) + design.reset
    return away * away * _UP


def build_update(design: QPVDesign) -> ca.Function:
    """(state, u, y, theta) -> the estimates one sample later, by a Runge-Kutta step."""
    equations, inputs = _Equations(design), _symbols(design.plant)
    state = ca.SX.sym("state", len(design.P))
    u, y, theta = inputs["u"], inputs["y"], inputs["theta"]
    gain = equations.gain(u, theta)[0]
    after = _runge_kutta(lambda value: equations.rate(value, u, y, theta, gain), state, design.Ts)
    return ca.Function("update", [state, u, y, theta], [after], ["state", *inputs], ["after"])


@dataclass(frozen=True)
class Allowance:
    """What rounding adds to the root of V over all steps, whether that is proved, and in one."""

    value: float
    proved: bool
    rho: float = np.inf


@functools.lru_cache(maxsize=8)
def allowance(design: QPVDesign) -> Allowance:
    """Bound what rounding of the steps adds to the root of V.

    One step as it runs is off by delta, elementwise, from the Runge-Kutta step of real numbers, for
    estimates of a state in X with an error in E. With V' <= rate (limit - V) the root of the bound
    of V shrinks differences by exp(-rate Ts / 2) a step, so that

        V^1/2 <= level^1/2 + rho / (1 - exp(-rate Ts / 2)) ,    rho = sup (delta'P delta)^1/2 .
    """
    plant, equations = design.plant, _Equations(design)
    half = design.region.half_widths + 1.01 * np.sqrt(design.inverse_diagonal)
    cells = cut_box(design.region.c[:, None] + half[:, None] * [-1.0, 1.0], _CELLS)
    ranges = {kind: finite_box(plant, kind).reshape(-1, 2) for kind in ("u", "rho", "w")}
    ranges["theta"] = ranges.pop("rho")[[s.measured for s in plant.rho]]
    box = {"state": cells, **{k: (v[:, :1], v[:, 1:]) for k, v in ranges.items()}}
    inputs = {"state": ca.SX.sym("state", len(half)), **_symbols(plant)}
    inputs["y"] = ca.SX.sym("w", len(plant.w))
    shown = equations.model(inputs["state"], inputs["u"], inputs["theta"], inputs["y"])[1]
    names = ["state", "u", "w", "theta"]
    size = rounding_bound(ca.Function("y", [*inputs.values()], [shown], names, ["y"]), box)[
        "y"
    ].size
    box["y"] = -size[:, None], size[:, None]
    delta = rounding_bound(build_update(design), box)["after"].error
    rho = float(np.sqrt(delta @ np.abs(design.P) @ delta)) * _UP
    shrinks = -float(np.expm1(-0.5 * equations.level_rate()[0] * design.Ts))
    value = rho / shrinks * _UP if shrinks > 0.0 else np.inf
    return Allowance(value, True, rho) if value <= _USEFUL else Allowance(2.0**-40, False)


def _runge_kutta(rate: Callable[[ca.SX], ca.SX], state: ca.SX, step: float) -> ca.SX:
    k1 = rate(state)
    k2 = rate(state + 0.5 * step * k1)
    k3 = rate(state + 0.5 * step * k2)
    k4 = rate(state + step * k3)
    return state + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
