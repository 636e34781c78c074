"""The gain at run time: weights of the vertices from what is measured, and the fastest mode."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import sympy as sp

from obsynth.designs.qpv.record import QPVDesign
from obsynth.symbolic import Plant
from obsynth.symbolic.convert import to_sx
from obsynth.symbolic.errors import ObsynthError
from obsynth.symbolic.signals import Signal
from obsynth.symbolic.text import read_text

FASTEST = 1.0
"""Largest product of sample time and modulus of a mode.

A Runge-Kutta step of order four then errs by less than one per cent of the change of that mode,
and is far from its limit of stability.
"""


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


def fastest_mode(design: QPVDesign) -> float:
    """Return the largest modulus of an eigenvalue of A + Psi - L C, over vertices, in 1/s."""
    data = design.data
    psi = data.psi(design.sets)
    largest = 0.0
    for A, members, gain in zip(data.A, psi, design.L, strict=True):
        for C in np.unique(data.C, axis=0):
            modes = np.linalg.eigvals(A + members - gain @ C)
            largest = max(largest, float(np.abs(modes).max()))
    return largest


def choose_sample_time(fastest: float, given: float | None) -> float:
    """Check a sample time against the fastest mode, or choose one (1, 2 or 5 times 10^k)."""
    longest = FASTEST / max(fastest, 1e-6)
    if given is None:
        power = 10.0 ** math.floor(math.log10(longest))
        factor = max(f for f in (1.0, 2.0, 5.0) if f * power <= longest * (1.0 + 1e-12))
        return float(f"{factor * power:.0e}")
    if given > longest:
        raise ObsynthError(
            f"Ts = {given:g} s is too long for the observer's fastest mode of {fastest:.4g}/s: a "
            f"Runge-Kutta step follows it up to Ts = {longest:.3g} s. Take a shorter step, or "
            "keep the gains smaller with gain_cap=",
            Ts=given,
            largest=longest,
            fastest_mode=fastest,
        )
    return given
