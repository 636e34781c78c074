"""Plants that differ from another in the ranges of their signals."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from obsynth.symbolic.errors import PlantError

if TYPE_CHECKING:
    from obsynth.symbolic.plant import Plant


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
    return type(self).from_dict(data)
