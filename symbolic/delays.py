"""Delays by whole steps, as states that hold a signal back."""

import builtins
from typing import TYPE_CHECKING, Any

import sympy as sp

from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.signals import Role

if TYPE_CHECKING:
    from obsynth.symbolic.plant import Plant


def delayed(
    plant: "Plant", signal: Any, steps: int, *, range: Any = None
) -> tuple[sp.Symbol, list[sp.Expr]]:
    """Add the states that hold a signal back for a number of steps.

    Parameters
    ----------
    plant : Plant
        Whose equations are those of next values; its dynamics are not stated yet.
    signal : symbol
        A state or an input of the plant.
    steps : int
        At least 1.
    range : pair of float, optional
        Of the states in the chain; by default the signal's own.

    Returns
    -------
    late : sympy.Symbol
        The signal of ``steps`` calls ago.
    rows : list of expressions, shape (steps,)
        The dynamics of the new states, in their order: they go behind the others.

    Raises
    ------
    PlantError
        What is no signal of the plant, or no number of steps.

    Examples
    --------
    >>> from obsynth import Plant
    >>> plant = Plant("pipe")
    >>> (T,) = plant.states("T", range=(10, 90))
    >>> (v,) = plant.inputs("v", range=(0, 5))
    >>> late, rows = delayed(plant, v, 2)
    >>> plant.dynamics([T / 2 + late, *rows], Ts=1)
    >>> plant.rhs.T
    Matrix([[T/2 + v_late2, v, v_late1]])
    """
    delays = Delays(plant)
    return delays(signal, steps, range), delays.rows


class Delays:
    """The states that hold signals of a plant back, as many as are asked for, and their rows."""

    def __init__(self, plant: "Plant") -> None:
        self.plant = plant
        self.rows: list[sp.Expr] = []
        self._chains: dict[str, list[sp.Symbol]] = {}

    def __call__(self, signal: Any, steps: Any, range: Any = None) -> sp.Symbol:
        """Return the signal of so many calls ago."""
        plant = self.plant
        found = next((s for s in plant.signals if s.name == str(signal)), None)
        if found is None or found.role not in (Role.STATE, Role.INPUT):
            known = ", ".join((*plant.names("x"), *plant.names("u")))
            raise PlantError(f"delayed takes a state or an input ({known}), not {signal!r}")
        if isinstance(steps, bool) or not isinstance(steps, int | sp.Integer) or steps < 1:
            raise PlantError(f"{found.name} is delayed by {steps!r}; give a number of steps from 1")
        chain = self._chains.setdefault(found.name, [found.symbol])
        names = [f"{found.name}_late{k}" for k in builtins.range(len(chain), int(steps) + 1)]
        if names:
            limits = range or ((found.lower, found.upper) if found.bounded else None)
            chain += plant.states(names, range=limits, unit=found.unit, nominal=found.nominal)
            self.rows += chain[-len(names) - 1 : -1]
        return chain[int(steps)]
