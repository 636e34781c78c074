"""Which signals are known on line, and how the outputs tell them."""

from dataclasses import dataclass

import sympy as sp

from obsynth.derive.rigour import substitute
from obsynth.symbolic.plant import Plant


@dataclass(frozen=True, eq=False)
class Reading:
    """An output that shows one state: y = scale * state + noise, the scale exact and not zero."""

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
    """A signal of the plant that lies between two functions of what is known at run time."""

    signal: sp.Symbol
    ends: tuple[sp.Expr, sp.Expr]

    @property
    def exact(self) -> bool:
        """True when both ends are the same."""
        return bool(self.ends[0] == self.ends[1])
