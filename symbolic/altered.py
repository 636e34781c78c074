"""Plants that differ from another in the ranges of their signals."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import sympy as sp

from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.serialize import signal_to_dict
from obsynth.symbolic.signals import Role, Signal

if TYPE_CHECKING:
    from obsynth.symbolic.plant import Plant

MISMATCHES: list[Callable[[Any, Mapping[str, float]], Any]] = []
"""Bounds of what parameters in intervals do to equations, (n + m, 2): `derive` puts it here."""
MISMATCH = "mismatch_"
"""What the names of disturbances that carry it begin with; that of the state or output follows."""


def with_ranges(self: "Plant", ranges: Mapping[str, tuple[float, float]]) -> "Plant":
    """Return the same plant with other ranges of some signals, of parameters as well.

    Parameters
    ----------
    ranges : mapping of str to (float, float)
        Lower and upper end in the unit of each signal. A parameter with two equal ends has that
        value; one with a range keeps its value as the nominal one where it lies inside.

    Returns
    -------
    Plant
        Made by the same discretisation where this one was discretised.

    Raises
    ------
    PlantError
        A name that is no signal, a range that is none.

    Examples
    --------
    >>> from obsynth import plants
    >>> plants.leaking_tanks().with_ranges({"a1": (0.02, 0.03)}).names("p")
    ('a1',)
    """
    known = {signal.name for signal in self.signals}
    for name in ranges:
        if name not in known:
            raise PlantError(
                f"{self.name!r} has no signal {name!r}; it has {', '.join(sorted(known))}",
                symbol=name,
            )
    if carried := set(ranges) & {signal.name for signal in self.remainder or ()}:
        raise PlantError(
            f"{min(carried)} carries what the discretisation of {self.name!r} leaves out: its "
            "range is derived, not given",
            symbol=min(carried),
        )
    if self.continuous is not None and self.step is not None:
        order = self.step.order if self.step.method == "taylor" else None
        other = with_ranges(self.continuous, ranges)
        kept = self.remainder is not None
        return other.discretise(self.step.method, self.exact_Ts, order, remainder=kept)
    data = self.to_dict()
    own = {signal["name"]: signal for signal in data["signals"]}
    for name, (lower, upper) in ranges.items():
        signal = own[name]
        value = signal["lower"] if signal["nominal"] is None else signal["nominal"]
        signal |= {"lower": float(lower), "upper": float(upper), "value": None}
        if signal["role"] == "parameter":
            inside = value is not None and lower <= value <= upper
            signal["nominal"] = value if inside else 0.5 * (lower + upper)
        elif signal["nominal"] is not None and not lower <= signal["nominal"] <= upper:
            signal["nominal"] = None
    return type(self).from_dict(data)


def with_params(self: "Plant", **values: Any) -> "Plant":
    """Return the same plant with other parameters.

    Parameters
    ----------
    **values : float, (float, float) or (float, float, float), by name
        A value; a range, in which the parameter is only known to lie; or value, lower and upper
        end: the equations have the value, and what the range makes of them, bounded over the
        ranges of all signals, is a disturbance ``mismatch_x`` of every equation x that it changes,
        so that what holds for the plant holds for every parameter in the range.

    Returns
    -------
    Plant

    Raises
    ------
    PlantError
        A name that is no parameter, a value outside of its range, a mismatch in a plant that was
        discretised (give it to the continuous plant).
    UnboundedError
        A mismatch that has no bound, as a signal has none.

    Examples
    --------
    >>> from obsynth import plants
    >>> tanks = plants.leaking_tanks().with_params(b1=(0.0364, 0.036, 0.037))
    >>> tanks.names("w")[-1], tanks.w[-1].upper < 0.0007
    ('mismatch_e1', True)
    """
    able = [s.name for s in (*self.p, *self.constants)]
    ranges: dict[str, tuple[float, float]] = {}
    kept: dict[str, float] = {}
    for name, given in values.items():
        if name not in able:
            raise PlantError(
                f"{self.name!r} has no parameter {name!r}; it has {', '.join(able) or 'none'}",
                symbol=name,
            )
        numbers = [float(v) for v in (given if isinstance(given, tuple | list) else [given])]
        if len(numbers) == 3:
            kept[name], *numbers = numbers
        if len(numbers) > 2 or not numbers[0] <= kept.get(name, numbers[0]) <= numbers[-1]:
            raise PlantError(
                f"parameter {name}: give a value, (lower, upper) or (value, lower, upper), "
                f"not {given!r}",
                symbol=name,
            )
        ranges[name] = numbers[0], numbers[-1]
    if not kept:
        return with_ranges(self, ranges)
    if self.continuous is not None:
        raise PlantError(
            f"{self.name!r} was discretised: give values with ranges to the continuous plant, or "
            "ranges alone to this one",
            symbol=min(kept),
        )
    wide = {name: ranges[name] for name in kept if ranges[name][0] < ranges[name][1]}
    found = MISMATCHES[-1](with_ranges(self, wide), {name: kept[name] for name in wide})
    held = {name: (value, value) for name, value in kept.items()}
    return _carrying(with_ranges(self, {**ranges, **held}), found.tolist())


def _carrying(plant: "Plant", bounds: list[list[float]]) -> "Plant":
    """Return a plant with a disturbance more in every row that has bounds other than zero."""
    data = plant.to_dict()
    n = len(data["dynamics"])
    for i, (lower, upper) in enumerate(bounds):
        if lower == upper == 0.0:
            continue
        state = i < n
        of = plant.x[i].name if state else plant.output_names[i - n]
        name = MISMATCH + of
        unit = plant.x[i].unit if state else plant.output_units[i - n]
        signal = Signal(name, sp.Symbol(name, real=True), Role.DISTURBANCE, lower, upper, unit)
        data["signals"].append(signal_to_dict(signal))
        if state:
            data["dynamics"][i] = f"{data['dynamics'][i]} + {name}"
        else:
            data["outputs"][i - n]["expression"] += f" + {name}"
    return type(plant).from_dict(data)
