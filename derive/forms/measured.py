"""Which signals are known on line, how the outputs tell them, and bounds as functions of them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import sympy as sp

from obsynth.derive.errors import DerivationError
from obsynth.derive.rigour import rational, substitute
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.signals import Signal


@dataclass(frozen=True, eq=False)
class Reading:
    """An output that shows one state: y = scale * state + noise.

    output: name of the output
    state: the state
    scale: exact factor, not zero
    noise: disturbances in the output with their exact factors
    """

    output: str
    state: sp.Symbol
    scale: sp.Expr
    noise: tuple[tuple[sp.Symbol, sp.Expr], ...]


def readings(model: Plant) -> tuple[Reading, ...]:
    """List the outputs that show one state each, free of faults."""
    states = {s.symbol for s in model.x}
    disturbances = {s.symbol for s in model.w}
    found: list[Reading] = []
    for name, row in zip(model.output_names, model.output, strict=True):
        row = sp.expand(substitute(row, model.constant_values))
        shown = row.free_symbols & states
        if len(shown) != 1 or row.free_symbols - shown - disturbances:
            continue
        (state,) = shown
        symbols = sorted(row.free_symbols, key=str)
        slopes = {s: sp.diff(row, s) for s in symbols}
        linear = sum((slope * s for s, slope in slopes.items()), sp.Integer(0))
        if any(slope.free_symbols for slope in slopes.values()) or sp.expand(row - linear) != 0:
            continue
        if any(reading.state == state for reading in found):
            continue
        noise = tuple((s, slope) for s, slope in slopes.items() if s != state)
        found.append(Reading(name, state, slopes[state], noise))
    return tuple(found)


def known_signals(model: Plant) -> frozenset[str]:
    """Names of the signals whose values are known on line."""
    names = {str(reading.state) for reading in readings(model)}
    names |= set(model.names("u"))
    names |= {s.name for s in model.rho if s.measured}
    return frozenset(names)


@dataclass(frozen=True, eq=False)
class Known:
    """A signal of the plant that is known at run time, exactly or up to the noise of an output.

    signal: the signal of the plant
    argument: what is measured: the signal itself, or the output that shows it
    ends: lower and upper end of the signal, as functions of the argument; equal without noise
    lower, upper: range of the argument for which the signal is inside its own range
    """

    signal: sp.Symbol
    argument: sp.Symbol
    ends: tuple[sp.Expr, sp.Expr]
    lower: float
    upper: float

    @property
    def exact(self) -> bool:
        """True when the signal follows from the argument without noise."""
        return bool(self.ends[0] == self.ends[1])


def read_measured(model: Plant, measured: Any, margin: float = 0.0) -> tuple[Known, ...]:
    """Read the option ``measured=``."""
    if not 0.0 <= margin < math.inf:
        raise DerivationError(
            f"margin= is finite and not negative; given was {margin}", given=margin
        )
    if measured is None:
        return ()
    extra = rational(margin)
    shown = {reading.output: reading for reading in readings(model)}
    exact = {s.name: s for kind in ("x", "u", "rho") for s in getattr(model, kind)}
    if isinstance(measured, str) and measured == "outputs":
        names: Sequence[str] = [*shown, *model.names("u")]
        names = [*names, *(s.name for s in model.rho if s.measured)]
    else:
        names = [str(n) for n in ([measured] if isinstance(measured, str) else measured)]
    found = []
    for name in names:
        if name in shown:
            found.append(_from_output(model, shown[name], extra))
        elif name in exact:
            signal = exact[name]
            itself = Reading(name, signal.symbol, sp.Integer(1), ())
            found.append(_known(itself, signal, signal.symbol, -extra, extra))
        elif name in model.output_names:
            raise DerivationError(
                f"measured= names the output {name}, which does not show a single state free of "
                "faults; name the states that are known instead",
                symbol=name,
            )
        else:
            raise DerivationError(
                f"measured= names {name!r}; there are the outputs {', '.join(model.output_names)} "
                f"and the signals {', '.join(exact)}",
                symbol=name,
            )
    return tuple(found)


def _from_output(model: Plant, reading: Reading, extra: sp.Expr) -> Known:
    state = next(s for s in model.x if s.symbol == reading.state)
    bounds = {s.symbol: s for s in model.w}
    low, high = -extra, extra
    for symbol, factor in reading.noise:
        signal = bounds[symbol]
        if not signal.bounded:
            raise DerivationError(
                f"the output {reading.output} shows {state.name} with the disturbance "
                f"{signal.name}, which has no bound; declare it with bound= or name {state.name} "
                "itself in measured=",
                symbol=signal.name,
            )
        ends = sorted([factor * rational(signal.lower), factor * rational(signal.upper)])
        low, high = low + ends[0], high + ends[1]
    return _known(reading, state, sp.Symbol(reading.output, real=True), low, high)


def _known(
    reading: Reading, signal: Signal, argument: sp.Symbol, low: sp.Expr, high: sp.Expr
) -> Known:
    """Enclose a signal, given that argument - scale * signal lies between low and high."""
    ends = [(argument - high) / reading.scale, (argument - low) / reading.scale]
    if reading.scale.is_negative:
        ends.reverse()
    if low != high and signal.bounded:
        ends[0] = sp.Max(ends[0], rational(signal.lower))
        ends[1] = sp.Min(ends[1], rational(signal.upper))
    domain = (-math.inf, math.inf)
    if signal.bounded:
        corners = sorted([reading.scale * rational(v) for v in (signal.lower, signal.upper)])
        # a double that satisfies an exact bound also satisfies the nearest double of the bound
        domain = (float(corners[0] + low), float(corners[1] + high))
    return Known(signal.symbol, argument, (ends[0], ends[1]), *domain)
