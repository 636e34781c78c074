"""Elementwise bounds of the state matrix between the ends of what the outputs show.

Equal ends are the paper's bounds as functions of the output; ends y - v and y + v include the
noise, and ends moved further apart what the output does between two samples.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from obsynth.derive.forms.quasi_lpv.elementwise import bound_elements
from obsynth.derive.forms.quasi_lpv.form import QuasiLPV
from obsynth.derive.forms.scheduling import Known, readings
from obsynth.derive.intervals.ranges import bound_ranges
from obsynth.derive.rigour import substitute
from obsynth.designs.core.boxes import column
from obsynth.designs.core.record import Context
from obsynth.symbolic import Plant, Signal, read_text, to_sx, write_text
from obsynth.symbolic.arrays import FloatArray

BLOCKS = ("A", "B", "offset")
_SIDES = ("lower", "upper")


@dataclass(frozen=True, eq=False)
class EndBounds:
    """Bounds of A, B and the offset as functions of ends of the measured states.

    exact: inputs and measured scheduling variables, known exactly
    lower, upper: of the blocks, for states between their ends and inside their declared ranges
    """

    states: tuple[Signal, ...]
    exact: tuple[Signal, ...]
    lower: dict[str, sp.Matrix]
    upper: dict[str, sp.Matrix]

    def function(self) -> ca.Function:
        """Return (lower ends, upper ends, exact) -> (A_lower, A_upper, B_lower, ...)."""
        low, high = (_columns(len(self.states)) for _ in _SIDES)
        known = _columns(len(self.exact))
        table = {}
        for i, state in enumerate(self.states):
            first, second = end_symbols(state)
            table[first], table[second] = low[i], high[i]
        table |= {s.symbol: known[i] for i, s in enumerate(self.exact)}
        results, names = [], []
        for block in BLOCKS:
            for side, matrices in zip(_SIDES, (self.lower, self.upper), strict=True):
                results.append(_matrix(matrices[block], table, f"{block}_{side}"))
                names.append(f"{block}_{side}")
        return ca.Function(
            "end_bounds", [low, high, known], results, ["lower", "upper", "exact"], names
        )

    def extremes(self, reach: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return the least A_lower and the largest A_upper over the ranges; reach: a state each."""
        width = np.broadcast_to(np.asarray(reach, dtype=float), (len(self.states),))
        known = _columns(len(self.exact))
        variables = [known[i] for i in range(len(self.exact))]
        box = [(s.lower, s.upper) for s in self.exact]
        low, high = [], []
        for state, wide in zip(self.states, width, strict=True):
            span = state.upper - state.lower
            symbols = [ca.SX.sym("end") for _ in range(1 if wide < span else 2)]
            variables += symbols
            box += [(state.lower, state.upper)] * len(symbols)
            if wide == 0.0 or wide >= span:
                low.append(symbols[0])
                high.append(symbols[-1])
            else:
                low.append(ca.fmax(symbols[0] - wide, state.lower))
                high.append(ca.fmin(symbols[0] + wide, state.upper))
        A_lower, A_upper = self.function()(ca.vertcat(*low), ca.vertcat(*high), known)[:2]
        n = A_lower.shape[0]
        rows = ca.vertcat(ca.vec(A_lower.T), ca.vec(A_upper.T))
        used = [k for k, variable in enumerate(variables) if ca.depends_on(rows, variable)]
        if not used:
            values = np.array(ca.DM(ca.evalf(rows))).ravel()
            return values[: n * n].reshape(n, n), values[n * n :].reshape(n, n)
        found = bound_ranges(
            rows, ca.vertcat(*[variables[k] for k in used]), np.array([box[k] for k in used])
        )
        return found.lower[: n * n].reshape(n, n), found.upper[n * n :].reshape(n, n)

    def to_record(self) -> dict[str, Any]:
        """Return the bounds as text."""
        return {
            "states": [s.name for s in self.states],
            "exact": [s.name for s in self.exact],
            **{
                side: {
                    block: [[write_text(e) for e in row] for row in matrices[block].tolist()]
                    for block in BLOCKS
                }
                for side, matrices in zip(_SIDES, (self.lower, self.upper), strict=True)
            },
        }

    @classmethod
    def from_record(cls, stored: Mapping[str, Any], context: Context) -> EndBounds:
        """Read the text of `to_record` with the signals of the plant that was read before."""
        plant = context.plant
        if plant is None:
            raise ValueError("bounds without a plant")
        states = tuple(_signal(plant.x, name) for name in stored["states"])
        exact = tuple(_signal((*plant.u, *plant.rho), name) for name in stored["exact"])
        symbols = {str(e): e for s in states for e in end_symbols(s)}
        symbols |= {s.name: s.symbol for s in exact}
        sides = (
            {
                block: sp.ImmutableMatrix(
                    len(plant.x),
                    _width(plant, block),
                    [read_text(text, symbols) for row in stored[side][block] for text in row],
                )
                for block in BLOCKS
            }
            for side in _SIDES
        )
        return cls(states, exact, *sides)


def end_symbols(state: Signal) -> tuple[sp.Symbol, sp.Symbol]:
    """Return the symbols of the two ends of a measured state."""
    return (
        sp.Symbol(f"{state.name}_lower", real=True),
        sp.Symbol(f"{state.name}_upper", real=True),
    )


def derive_bounds(form: QuasiLPV) -> EndBounds:
    """Bound the blocks of a quasi-LPV form elementwise between ends of the measured states."""
    plant = form.model
    shown = {r.state for r in readings(plant)}
    states = tuple(s for s in plant.x if s.symbol in shown)
    exact = (*plant.u, *(s for s in plant.rho if s.measured))
    way = form.ranging
    blocks = {name: substitute_all(way.matrix[form.layout.place(name)], plant) for name in BLOCKS}
    known = [Known(s.symbol, end_symbols(s)) for s in states]
    known += [Known(s.symbol, (s.symbol, s.symbol)) for s in exact]
    more = [lift.signal for lift in way.lifts]
    lower, upper = {}, {}
    for name, block in blocks.items():
        places = {(i, j): block[i, j] for i in range(block.rows) for j in range(block.cols)}
        found = bound_elements(places, plant, known, more)
        lower[name] = sp.ImmutableMatrix(*block.shape, [low for low, _ in found.values()])
        upper[name] = sp.ImmutableMatrix(*block.shape, [high for _, high in found.values()])
    used = {s for side in (lower, upper) for m in side.values() for s in m.free_symbols}
    return EndBounds(states, tuple(s for s in exact if s.symbol in used), lower, upper)


def substitute_all(matrix: sp.Matrix, plant: Plant) -> sp.Matrix:
    """Put the values of a plant's constants into a matrix."""
    values = plant.constant_values
    return matrix.applyfunc(lambda e: substitute(e, values))


def _columns(count: int) -> ca.SX:
    return column(ca.SX.sym(f"s{i}") for i in range(count))


def _matrix(matrix: sp.Matrix, table: Mapping[sp.Symbol, ca.SX], label: str) -> ca.SX:
    entries = column(to_sx(list(matrix.T), table, [label] * len(matrix)))
    return ca.densify(ca.reshape(entries, *matrix.shape))


def _signal(signals: tuple[Signal, ...], name: str) -> Signal:
    return {s.name: s for s in signals}[name]


def _width(plant: Plant, block: str) -> int:
    return {"A": len(plant.x), "B": len(plant.u), "offset": 1}[block]
