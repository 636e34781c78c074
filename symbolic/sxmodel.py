"""A plant as CasADi SX expressions: what derivatives, bounds, simulation and code use."""

import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import casadi as ca
import numpy as np

from obsynth.symbolic.convert import to_sx
from obsynth.symbolic.discretise import runge_kutta
from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.parity import check_parity, sample_box
from obsynth.symbolic.signals import KINDS

if TYPE_CHECKING:
    from obsynth.symbolic.plant import Plant


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
        kinds = [*KINDS, "c"] if self.c.numel() else list(KINDS)
        arguments = [getattr(self, kind) for kind in kinds]
        return ca.Function(self.name, arguments, [self.rhs, self.y], kinds, ["rhs", "y"])


def build_sx(plant: "Plant", constants: Literal["value", "symbol"]) -> SxModel:
    """Convert a complete plant to SX and compare the two forms at random points.

    A Runge-Kutta step is composed in SX from the derivatives of the continuous plant,
    which keeps the graph small; these are what is compared then.
    """
    if constants not in ("value", "symbol"):
        raise PlantError(f"constants= is 'value' or 'symbol', not {constants!r}")
    original = plant.continuous
    if original is not None and plant.Ts is not None and plant.discretisation == "rk4":
        return _composed(original.sx(constants), plant.Ts)
    columns = {kind: [ca.SX.sym(name) for name in plant.names(kind)] for kind in KINDS}
    values = plant.constant_values
    columns["c"] = []
    rows = [*plant.rhs, *plant.output]
    signals = [signal for kind in KINDS for signal in getattr(plant, kind)]
    if constants == "symbol":
        columns["c"] = [ca.SX.sym(str(symbol)) for symbol in values]
        signals += plant.constants
    else:
        rows = [row.xreplace(values) for row in rows]
    flat = [item for column in columns.values() for item in column]
    n = len(plant.x)
    labels = [f"dynamics row {k}" for k in range(1, n + 1)]
    labels += [f"outputs row {k}" for k in range(1, len(rows) - n + 1)]
    symbols = dict(zip((signal.symbol for signal in signals), flat, strict=True))
    found = to_sx(rows, symbols, labels)

    function = ca.Function("rows", [_column(flat)], [ca.densify(_column(found))])
    box = np.array([(signal.lower, signal.upper) for signal in signals])
    centre = [0.0 if signal.nominal is None else signal.nominal for signal in signals]
    points = sample_box(box, around=centre)
    check_parity(rows, list(symbols), lambda point: np.array(function(point)), points, labels)

    stacked = {kind: _column(items) for kind, items in columns.items()}
    name = _identifier(plant.name)
    return SxModel(name=name, rhs=_column(found[:n]), y=_column(found[n:]), **stacked)


def _composed(model: SxModel, step: float) -> SxModel:
    """Return the model whose right-hand side is one Runge-Kutta step of another's."""
    others = [getattr(model, kind) for kind in (*KINDS, "c") if kind != "x"]
    rates = ca.Function("rates", [model.x, *others], [model.rhs])
    rhs = runge_kutta(lambda x: rates(x, *others), model.x, step)
    return replace(model, rhs=rhs)


def _identifier(name: str) -> str:
    plain = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_")
    return plain if plain[:1].isalpha() else f"plant_{plain}".strip("_")


def _column(items: list[ca.SX]) -> ca.SX:
    return ca.vertcat(*items) if items else ca.SX(0, 1)
