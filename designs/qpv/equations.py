"""The plant's functions as the observer follows them: the scheduled gain and one step of (7)."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import sympy as sp

from obsynth.designs.core.boxes import column
from obsynth.designs.core.half_widths import above
from obsynth.designs.core.stepping import inside
from obsynth.designs.qpv.record import QPVDesign
from obsynth.symbolic import Plant
from obsynth.symbolic.convert import to_sx
from obsynth.symbolic.signals import Signal
from obsynth.symbolic.text import read_text


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


STAGES = (0.0, 0.5, 0.5, 1.0)
"""Where in a sample the Runge-Kutta formula of order four evaluates."""
WEIGHTS = (1.0, 2.0, 2.0, 1.0)
"""What it weighs each by, in sixths."""


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
