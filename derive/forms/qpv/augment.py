"""Faults as further states: process faults, and losses of actuator effectiveness."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import NDArray

from obsynth.derive.errors import DerivationError
from obsynth.derive.rigour import substitute
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.signals import Role, Signal


@dataclass(frozen=True, eq=False)
class Augmented:
    """A plant whose chosen faults and losses are states that do not change; `faults` are left."""

    model: Plant
    states: tuple[Signal, ...]
    faults: tuple[Signal, ...]
    rows: tuple[sp.Expr, ...]
    outputs: tuple[sp.Expr, ...]

    @property
    def box(self) -> NDArray[np.float64]:
        """Ranges of the augmented states, shape (number of states, 2)."""
        return np.array([(s.lower, s.upper) for s in self.states], dtype=float).reshape(-1, 2)


def augment_plant(model: Plant, augment: Any = "process", effectiveness: Any = ()) -> Augmented:
    """Turn faults into states with f' = 0; a loss phi_j of effectiveness is B (I - diag(phi)) u."""
    chosen = _faults(model, augment)
    losses, scaled = _losses(model, effectiveness)
    left = tuple(s for s in model.f if s not in chosen)
    rows = [substitute(row, model.constant_values).xreplace(scaled) for row in model.rhs]
    outputs = [substitute(row, model.constant_values).xreplace(scaled) for row in model.output]
    added = (*chosen, *losses)
    still = [sp.Integer(0) if model.Ts is None else s.symbol for s in added]
    return Augmented(model, (*model.x, *added), left, (*rows, *still), tuple(outputs))


def _faults(model: Plant, augment: Any) -> tuple[Signal, ...]:
    if isinstance(augment, str) and augment in ("process", "all", "none"):
        if augment == "none":
            return ()
        return tuple(s for s in model.f if augment == "all" or s.role is Role.PROCESS_FAULT)
    names = [str(n) for n in ([augment] if isinstance(augment, str) else augment)]
    known = {s.name: s for s in model.f}
    for name in names:
        if name not in known:
            raise DerivationError(
                f"augment= names {name!r}, which is no fault of {model.name!r}; there are "
                f"{', '.join(known) or 'none'} (or 'process', 'all', 'none')",
                symbol=name,
            )
    return tuple(known[name] for name in names)


def _losses(
    model: Plant, effectiveness: Any
) -> tuple[tuple[Signal, ...], dict[sp.Symbol, sp.Expr]]:
    inputs = {s.name: s for s in model.u}
    if effectiveness is True:
        effectiveness = tuple(inputs)
    if isinstance(effectiveness, str | sp.Symbol):
        effectiveness = (effectiveness,)
    ranges: Mapping[str, Sequence[float]] = (
        {str(k): v for k, v in effectiveness.items()}
        if isinstance(effectiveness, Mapping)
        else {str(name): (0.0, 1.0) for name in effectiveness or ()}
    )
    losses, scaled = [], {}
    for name, (lower, upper) in ranges.items():
        if name not in inputs:
            raise DerivationError(
                f"effectiveness= names {name!r}, which is no input of {model.name!r}; there are "
                f"{', '.join(inputs) or 'none'}",
                symbol=name,
            )
        label = f"loss_{name}"
        if any(s.name == label for s in model.signals):
            raise DerivationError(
                f"the loss of {name} would be called {label}, which is taken; rename the signal",
                symbol=label,
            )
        symbol = sp.Symbol(label, real=True)
        losses.append(
            Signal(label, symbol, Role.PROCESS_FAULT, float(lower), float(upper), nominal=None)
        )
        scaled[inputs[name].symbol] = inputs[name].symbol * (1 - symbol)
    return tuple(losses), scaled
