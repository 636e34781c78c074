"""The run-time functions of the observer: the differential equation (7) and its fixed step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from obsynth.designs.core.given import Start, read_vector
from obsynth.designs.core.stepping import (
    all_finite,
    finite_or,
    largest_level,
    make_step,
    select,
    slices,
    status_word,
)
from obsynth.designs.qpv.record import QPVDesign
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.convert import to_sx
from obsynth.symbolic.signals import Signal
from obsynth.symbolic.text import read_text

# Above the rounding of the few dozen operations behind every returned number.
_UP = 1.0 + 2.0**-40


def memory_sizes(design: QPVDesign) -> dict[str, int]:
    """Return the parts of the memory vector.

    ``xhat``, ``fhat``, ``level`` (a bound of V = e'P e, infinite where none is known) and
    ``initialised`` (0 or 1).
    """
    plant = design.plant
    return {"xhat": len(plant.x), "fhat": len(plant.f), "level": 1, "initialised": 1}


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

    def model(self, state: ca.SX, u: ca.SX, theta: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Right-hand side and output for an augmented state."""
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
            ca.DM(self.design.w_centre),
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
    memory = ca.SX.sym("memory", layout["initialised"].stop)
    found = _symbols(plant)
    u, y, theta = found["u"], found["y"], found["theta"]
    equations = _Equations(design)
    gain, _ = equations.gain(u, theta)
    state = memory[: layout["fhat"].stop]
    level = memory[layout["level"]]
    rate, limit = equations.level_rate()
    grown = ca.if_else(level <= 1.0, rate * (limit - level), 0.0)
    d_state = equations.rate(state, u, y, theta, gain)
    running = memory[layout["initialised"]] > 0.5
    moved = ca.vertcat(d_state, grown, 0)
    outputs = select(running, moved, ca.SX.zeros(moved.numel()))
    inputs = {"memory": memory, "u": u, "y": y}
    if theta.numel():
        inputs["theta"] = theta
    return ca.Function(
        "ode", list(inputs.values()), [ca.densify(outputs)], list(inputs), ["dmemory"]
    )


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


def _inside_region(sizes: _Sizes, offset: ca.SX, level: ca.SX) -> ca.SX:
    """Whether offset + {e'P e <= level} lies in the ellipsoid X - c, by the triangle inequality."""
    distance = ca.sqrt(ca.mtimes([offset.T, ca.DM(sizes.inverse_Q), offset]))
    return distance + ca.sqrt(level) * sizes.region <= 1.0


def build_step(design: QPVDesign) -> ca.Function:
    """Return `Observer.step`: the Runge-Kutta step of order four with u, y and theta held."""
    plant = design.plant
    n, n_f, m = len(plant.x), len(plant.f), len(plant.output)
    layout = slices(memory_sizes(design))
    memory = ca.SX.sym("memory", layout["initialised"].stop)
    found = _symbols(plant)
    u, y, theta = found["u"], found["y"], found["theta"]
    equations, sizes = _Equations(design), _Sizes.of(design)
    initialised = memory[layout["initialised"]] > 0.5
    state = memory[: n + n_f]

    u_used = finite_or(u, [0.0 if s.nominal is None else float(s.nominal) for s in plant.u])
    middle = [0.5 * (s.lower + s.upper) for s in measured_schedule(plant)]
    theta_used = finite_or(theta, middle) if theta.numel() else theta
    known = ca.logic_and(all_finite(u), all_finite(theta))
    gain, scheduled = equations.gain(u_used, theta_used)
    expected = equations.model(state, u_used, theta_used)[1]
    y_used = finite_or(y, expected)
    seen = all_finite(y)

    offset = state - ca.DM(design.region.c)
    level = memory[layout["level"]]
    if design.reset < 1.0:
        # whatever was lost before, the state lies in X
        away = ca.sqrt(ca.mtimes([offset.T, ca.DM(design.P), offset])) + design.reset
        level = ca.fmin(level, away * away * _UP)
    certified = ca.logic_and(initialised, ca.logic_and(level <= 1.0, scheduled))
    bounded = design.bounded
    valid = ca.logic_and(certified, seen) if bounded else ca.SX(0)
    half = ca.DM(sizes.half) * ca.sqrt(level)
    half = half + 2.0**-40 * (ca.fabs(state) + half)
    half = ca.vertcat(*(ca.if_else(valid, half[i], ca.inf) for i in range(n + n_f)))
    innovation = y_used - expected
    reach = ca.sqrt(level) if bounded else ca.SX(1)
    consistent = ca.SX(1)
    for i in range(m):
        if np.isfinite(sizes.noise[i]):
            allowed = reach * sizes.reach[i] + sizes.noise[i] + 2.0**-40 * ca.fabs(y_used[i])
            consistent = ca.logic_and(consistent, ca.fabs(innovation[i]) <= allowed)
    in_region = _inside_region(sizes, offset, level if bounded else ca.SX(0))
    status = status_word(
        {
            "not_initialised": ca.logic_not(initialised),
            "non_finite_input": ca.logic_not(ca.logic_and(known, seen)),
            "outside_domain": ca.logic_not(ca.logic_and(certified, in_region)),
            "inconsistent_measurement": ca.logic_and(certified, ca.logic_not(consistent)),
            "fault_not_valid": ca.logic_not(ca.logic_and(certified, seen)),
        }
    )

    moved = _runge_kutta(
        lambda value: equations.rate(value, u_used, y_used, theta_used, gain), state, design.Ts
    )
    rate, limit = equations.level_rate()
    share = float(np.exp(-rate * design.Ts))
    next_level = limit * (1.0 - share) + share * level * (1.0 + 2.0**-50)
    next_level = ca.fmin(next_level, ca.fmax(level, limit)) if limit else next_level
    alive = ca.logic_and(ca.logic_and(known, seen), scheduled)
    next_level = ca.if_else(ca.logic_and(alive, level <= 1.0), next_level, ca.inf)
    going = all_finite(moved)
    next_level = ca.if_else(going, next_level, ca.inf)
    following = ca.vertcat(select(going, moved, state), next_level, 1)
    inputs = {"memory": memory, "u": u, "y": y}
    if theta.numel():
        inputs["theta"] = theta
    return make_step(
        inputs,
        {
            "memory": select(initialised, following, memory),
            "xhat": state[:n],
            "fhat": state[n:],
            "x_lower": state[:n] - half[:n],
            "x_upper": state[:n] + half[:n],
            "f_lower": state[n:] - half[n:],
            "f_upper": state[n:] + half[n:],
            "status": status,
        },
    )


def _runge_kutta(rate: Callable[[ca.SX], ca.SX], state: ca.SX, step: float) -> ca.SX:
    k1 = rate(state)
    k2 = rate(state + 0.5 * step * k1)
    k3 = rate(state + 0.5 * step * k2)
    k4 = rate(state + step * k3)
    return state + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
