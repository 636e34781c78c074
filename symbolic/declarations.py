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

__all__ = [
    "Names",
    "Symbols",
    "actuator_faults",
    "disturbances",
    "inputs",
    "params",
    "process_faults",
    "scheduling",
    "sensor_faults",
    "states",
    "unknown_inputs",
]

Names = str | Sequence[str]
Symbols = tuple[sp.Symbol, ...]


def states(
    self: "Plant", names: Names, *, range: Any = None, unit: Any = "", nominal: Any = None
) -> Symbols:
    """Declare states.

    Parameters
    ----------
    names : str or sequence of str
    range : pair or list of pairs, optional
        The box, in ``unit``, that bounds and guarantees are about.
    unit : str or list of str
        A label; no arithmetic is done with it.
    nominal : float or list of float, optional
        Where the search for an equilibrium starts.

    Returns
    -------
    tuple of sympy.Symbol

    Examples
    --------
    >>> from obsynth.symbolic import Plant
    >>> Plant("tanks").states("h1:3", range=[(60, 280), (5, 100)], unit="cm")
    (h1, h2)
    """
    if self.has_dynamics:
        raise PlantError("states are declared before the dynamics, one row for each")
    return self.declare(Role.STATE, names, limits=range, unit=unit, nominal=nominal)


def inputs(
    self: "Plant", names: Names, *, range: Any = None, unit: Any = "", nominal: Any = None
) -> Symbols:
    """Declare known inputs.

    Parameters
    ----------
    names : str or sequence of str
    range : pair or list of pairs, optional
    unit : str or list of str
    nominal : float or list of float, optional
        The values that define the equilibrium.

    Returns
    -------
    tuple of sympy.Symbol

    Examples
    --------
    >>> from obsynth.symbolic import Plant
    >>> Plant("tanks").inputs("v1:3", range=(0, 20), nominal=10, unit="V")
    (v1, v2)
    """
    return self.declare(Role.INPUT, names, limits=range, unit=unit, nominal=nominal)


def unknown_inputs(self: "Plant", names: Names, *, range: Any = None, unit: Any = "") -> Symbols:
    """Declare unknown inputs, which observers decouple.

    Parameters
    ----------
    names : str or sequence of str
    range : pair or list of pairs, optional
    unit : str or list of str

    Returns
    -------
    tuple of sympy.Symbol

    Examples
    --------
    >>> from obsynth.symbolic import Plant
    >>> Plant("tanks").unknown_inputs("d")
    (d,)
    """
    return self.declare(Role.UNKNOWN_INPUT, names, limits=range, unit=unit)


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

    Parameters
    ----------
    names : str or sequence of str
    value : number or list of numbers, optional
        Rationals stay exact, floats mean their double.
    tolerance : float or list of float, optional
        Relative: 0.05 is 5 % to either side of the value.
    range : pair or list of pairs, optional
        The interval itself; a value beside it is the nominal one.
    unit : str or list of str
    constant : bool or list of bool
        False for a parameter that may change inside its interval.

    Returns
    -------
    tuple of sympy.Symbol

    Examples
    --------
    >>> from obsynth.symbolic import Plant
    >>> plant = Plant("tank")
    >>> plant.params("k", 2.0, tolerance=0.1)
    (k,)
    >>> plant.box("p").tolist()
    [[1.8, 2.2]]
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
    """Declare scheduling variables.

    Parameters
    ----------
    names : str or sequence of str
    range : pair or list of pairs, optional
    unit : str or list of str
    measured : bool or list of bool
        False: bounded, but not known on line.
    nominal : float or list of float, optional

    Returns
    -------
    tuple of sympy.Symbol

    Examples
    --------
    >>> from obsynth.symbolic import Plant
    >>> Plant("arm").scheduling("load", range=(0, 5), unit="kg", measured=False)
    (load,)
    """
    keywords = {"unit": unit, "measured": measured, "nominal": nominal}
    return self.declare(Role.SCHEDULING, names, limits=range, **keywords)


def disturbances(
    self: "Plant", names: Names, *, bound: Any = None, range: Any = None, unit: Any = ""
) -> Symbols:
    """Declare disturbances and noise; where they stand in the equations makes W1 and W2.

    Parameters
    ----------
    names : str or sequence of str
    bound : float or list of float, optional
        b for the range (-b, b).
    range : pair or list of pairs, optional
        With neither, the disturbance has finite energy and no bound.
    unit : str or list of str

    Returns
    -------
    tuple of sympy.Symbol

    Examples
    --------
    >>> from obsynth.symbolic import Plant
    >>> Plant("tanks").disturbances("w1:4", bound=0.1)
    (w1, w2, w3)
    """
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
    """Declare actuator faults: an input v becomes v + fault wherever it stands.

    Parameters
    ----------
    names : str or sequence of str
    of : symbols or names
        One input for each fault.
    range : pair or list of pairs, optional
    rate : float or list of float, optional
        The largest change per second, per step in a discrete plant.
    constant : bool or list of bool
        True for a fault that does not change.
    unit : str or list of str, optional
        The input's by default.

    Returns
    -------
    tuple of sympy.Symbol

    Examples
    --------
    >>> from obsynth.symbolic import Plant
    >>> plant = Plant("tanks")
    >>> v = plant.inputs("v1:3", unit="V")
    >>> plant.actuator_faults("f1:3", of=v, rate=0.05)
    (f1, f2)
    """
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
    """Declare sensor faults: an output y becomes y + fault.

    Parameters
    ----------
    names : str or sequence of str
    of : names
        One output for each fault: y1, y2, ... or the names given to ``outputs``.
    range, rate, constant, unit
        As for actuator faults.

    Returns
    -------
    tuple of sympy.Symbol

    Examples
    --------
    >>> from obsynth.symbolic import Plant
    >>> Plant("tanks").sensor_faults("s", of="y2", range=(-1, 1))
    (s,)
    """
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
    """Declare faults whose symbols stand in the equations (``faults`` is the same method).

    Parameters
    ----------
    names : str or sequence of str
    range, rate, constant, unit
        As for actuator faults.

    Returns
    -------
    tuple of sympy.Symbol

    Examples
    --------
    >>> from obsynth.symbolic import Plant
    >>> Plant("tank").faults("leak", range=(0, 2), unit="cm^3/s")
    (leak,)
    """
    keywords = {"limits": range, "rate": rate, "constant": constant, "unit": unit}
    return self.declare(Role.PROCESS_FAULT, names, **keywords)
