"""A plant as CasADi SX expressions: what derivatives, bounds, simulation and code use."""

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import casadi as ca
import sympy as sp

from obsynth.symbolic.convert import to_sx

if TYPE_CHECKING:
    from obsynth.symbolic.plant import Plant

__all__ = ["SxModel", "build_sx"]

_KINDS = ("x", "u", "d", "f", "w", "p", "rho")


@dataclass(frozen=True, eq=False)
class SxModel:
    """SX columns of a plant's signals, its right-hand side and its output.

    Parameters
    ----------
    name : str
        The plant's name as an identifier.
    x, u, d, f, w, p, rho, c : casadi.SX
        Columns of symbols; ``c`` holds the constants and is empty where their values
        stand in the equations.
    rhs : casadi.SX
        (n, 1): time derivative, or next state of a discrete plant.
    y : casadi.SX
        (m, 1): measured outputs.
    """

    name: str
    x: ca.SX
    u: ca.SX
    d: ca.SX
    f: ca.SX
    w: ca.SX
    p: ca.SX
    rho: ca.SX
    c: ca.SX
    rhs: ca.SX
    y: ca.SX

    def function(self) -> ca.Function:
        """Return (x, u, d, f, w, p, rho[, c]) -> (rhs, y); c only where it is not empty."""
        kinds = (*_KINDS, "c") if self.c.numel() else _KINDS
        arguments = [getattr(self, kind) for kind in kinds]
        return ca.Function(self.name, arguments, [self.rhs, self.y], list(kinds), ["rhs", "y"])


def build_sx(plant: "Plant", constants: Literal["value", "symbol"]) -> SxModel:
    """Convert a plant to SX."""
    columns = {kind: [ca.SX.sym(name) for name in plant.names(kind)] for kind in _KINDS}
    symbols: dict[sp.Symbol, ca.SX] = {}
    for kind in _KINDS:
        signals = getattr(plant, kind)
        symbols.update({s.symbol: sx for s, sx in zip(signals, columns[kind], strict=True)})
    columns["c"] = []
    rows = [list(plant.rhs), list(plant.output)]
    if constants == "symbol":
        columns["c"] = [ca.SX.sym(s.name) for s in plant.constants]
        symbols.update(dict(zip(plant.constant_values, columns["c"], strict=True)))
    else:
        rows = [[row.xreplace(plant.constant_values) for row in block] for block in rows]
    rhs = to_sx(rows[0], symbols, "dynamics")
    y = to_sx(rows[1], symbols, "outputs")
    stacked = {kind: _column(items) for kind, items in columns.items()}
    name = re.sub(r"\W+", "_", plant.name, flags=re.ASCII).strip("_") or "plant"
    name = name if name[0].isalpha() else f"plant_{name}"
    return SxModel(name=name, rhs=_column(rhs), y=_column(y), **stacked)


def _column(items: list[ca.SX]) -> ca.SX:
    return ca.vertcat(*items) if items else ca.SX(0, 1)
