"""What a plant's user declares: one function per role, the methods of ``Plant``.

Names are as in ``sympy.symbols`` ("h1:5", "a b"). Every keyword takes one value for all
symbols or a list with one each; ``range`` takes one pair (lower, upper) or a list of
pairs. All functions return a tuple of real SymPy symbols and raise ``PlantError`` for
what cannot be accepted, leaving the plant as it was.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import sympy as sp

from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.signals import Role

if TYPE_CHECKING:
    from obsynth.symbolic.plant import Plant


Names = str | Sequence[str]
Symbols = tuple[sp.Symbol, ...]


def states(
    self: "Plant", names: Names, *, range: Any = None, unit: Any = "", nominal: Any = None
) -> Symbols:
    """Declare states."""
    if self.has_dynamics:
        raise PlantError("states are declared before the dynamics, one row for each")
    return self.declare(Role.STATE, names, limits=range, unit=unit, nominal=nominal)


def inputs(
    self: "Plant", names: Names, *, range: Any = None, unit: Any = "", nominal: Any = None
) -> Symbols:
    """Declare known inputs."""
    return self.declare(Role.INPUT, names, limits=range, unit=unit, nominal=nominal)


def unknown_inputs(
    self: "Plant", names: Names, *, range: Any = None, unit: Any = "", nominal: Any = None
) -> Symbols:
    """Declare unknown inputs, which observers decouple; equilibria and scenarios use the nominal.

    What they are is not asked: no guarantee rests on a nominal value.
    """
    return self.declare(Role.UNKNOWN_INPUT, names, limits=range, unit=unit, nominal=nominal)


def params(
    self: "Plant",
    names: Names,
    value: Any = None,
    *,
    tolerance: Any = None,
    range: Any = None,
    unit: Any = "",
    constant: Any = True,
) -> Symbols:
    """Declare parameters by value, by value and tolerance, or by range.

    One with nothing but a value is among the plant's ``constants``; the others are its ``p``.
    """
    keywords = {"value": value, "tolerance": tolerance, "unit": unit, "constant": constant}
    return self.declare(Role.PARAM, names, limits=range, **keywords)


def scheduling(
    self: "Plant",
    names: Names,
    *,
    range: Any = None,
    unit: Any = "",
    measured: Any = True,
    nominal: Any = None,
) -> Symbols:
    """Declare scheduling variables."""
    keywords = {"unit": unit, "measured": measured, "nominal": nominal}
    return self.declare(Role.SCHEDULING, names, limits=range, **keywords)


def disturbances(
    self: "Plant", names: Names, *, bound: Any = None, range: Any = None, unit: Any = ""
) -> Symbols:
    """Declare disturbances and noise; where they stand in the equations makes W1 and W2."""
    return self.declare(Role.DISTURBANCE, names, bound=bound, limits=range, unit=unit)


def actuator_faults(
    self: "Plant",
    names: Names,
    *,
    of: Any,
    range: Any = None,
    rate: Any = None,
    constant: Any = False,
    unit: Any = None,
) -> Symbols:
    """Declare actuator faults: an input v becomes v + fault wherever it stands."""
    keywords = {"limits": range, "rate": rate, "constant": constant, "unit": unit}
    return self.declare(Role.ACTUATOR_FAULT, names, of=of, **keywords)


def sensor_faults(
    self: "Plant",
    names: Names,
    *,
    of: Any,
    range: Any = None,
    rate: Any = None,
    constant: Any = False,
    unit: Any = None,
) -> Symbols:
    """Declare sensor faults: an output y becomes y + fault."""
    keywords = {"limits": range, "rate": rate, "constant": constant, "unit": unit}
    return self.declare(Role.SENSOR_FAULT, names, of=of, **keywords)


def process_faults(
    self: "Plant",
    names: Names,
    *,
    range: Any = None,
    rate: Any = None,
    constant: Any = False,
    unit: Any = "",
) -> Symbols:
    """Declare faults whose symbols stand in the equations (``faults`` is the same method)."""
    keywords = {"limits": range, "rate": rate, "constant": constant, "unit": unit}
    return self.declare(Role.PROCESS_FAULT, names, **keywords)
