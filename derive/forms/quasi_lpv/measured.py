"""Which signals are known on line, and how the outputs tell them."""

from dataclasses import dataclass

import sympy as sp

from obsynth.derive.rigour.numbers import substitute
from obsynth.symbolic.plant import Plant

__all__ = ["Reading", "known_signals", "readings"]


@dataclass(frozen=True, eq=False)
class Reading:
    """An output that shows one state: y = scale * state + noise.

    Attributes
    ----------
    output : str
        Name of the output.
    state : sympy.Symbol
        The state.
    scale : sympy.Expr
        Exact factor, not zero.
    noise : tuple of (sympy.Symbol, sympy.Expr)
        Disturbances in the output with their exact factors.
    """

    output: str
    state: sp.Symbol
    scale: sp.Expr
    noise: tuple[tuple[sp.Symbol, sp.Expr], ...]


def readings(model: Plant) -> tuple[Reading, ...]:
    """List the outputs that show one state each, free of faults.

    Parameters
    ----------
    model : Plant
        The plant.

    Returns
    -------
    tuple of Reading
        In the order of the outputs, the first one for every state.

    Examples
    --------
    >>> from obsynth.symbolic.plants import quadruple_tank
    >>> [(r.output, r.state, r.noise) for r in readings(quadruple_tank())]
    [('y1', h1, ((w1, 1),)), ('y2', h2, ((w2, 1),)), ('y3', h3, ((w3, 1),))]
    """
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
    """Names of the signals whose values are known on line.

    Parameters
    ----------
    model : Plant
        The plant.

    Returns
    -------
    frozenset of str
        States that an output shows (up to its noise), inputs, measured scheduling variables. A
        state whose output may carry a sensor fault is not among them.
    """
    names = {str(reading.state) for reading in readings(model)}
    names |= set(model.names("u"))
    names |= {s.name for s in model.rho if s.measured}
    return frozenset(names)
