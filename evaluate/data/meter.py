"""An estimated signal against a meter that no observer reads."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.evaluate.errors import SimulationError

KINDS = (("rate",), ("level",))


@dataclass(frozen=True)
class Comparison:
    """A signal in units of the plant beside a channel in units of its own.

    scale: units of the signal in a unit of the channel: as given, or least squares of the middles
    scales: the scales with which every reading of the channel lies in its interval; None: none does
    inside: share of instants at which the channel, times `scale`, lies in the interval
    false_alarms: instants at which zero was outside of the interval and the channel was at zero
    first, known: first instant at which zero was outside and the channel was not at zero, and at
        which that was known
    certain: share of the instants at which the channel was not at zero that zero was outside at
    """

    signal: str
    channel: str
    kind: str
    scale: float
    scales: tuple[float, float] | None
    inside: float
    false_alarms: int
    first: int | None
    known: int | None
    certain: float

    def __str__(self) -> str:
        every = "no scale holds all readings"
        if self.scales is not None:
            every = "all are inside for {:.4g} to {:.4g}".format(*self.scales)
        since = "never certain" if self.first is None else f"certain from k = {self.first}"
        late = f" (known at {self.known})" if self.known != self.first else ""
        return (
            f"{self.signal} beside {self.channel}: {self.scale:.4g} a unit, "
            f"{100 * self.inside:.4g} % inside, {every}; {since}{late}, at "
            f"{100 * self.certain:.3g} % of its instants; {self.false_alarms} false alarms"
        )


def compare(told: Any, scale: float | None = None, **channels: tuple[str, str]) -> Comparison:
    """Compare a state or a fault with a channel of the record that no observer reads.

    Parameters
    ----------
    scale : float, optional
        Units of the signal in a unit of the channel; by default least squares of the middles of the
        intervals.
    **channels
        One signal with its channel: ``leak=("pulses", "rate")`` for a counter, whose increase from
        instant k to k + 1 is compared, ``leak=("flow", "level")`` for its values.

    Returns
    -------
    Comparison

    Examples
    --------
    >>> told.compare(leak=("pulses", "rate"))      # doctest: +SKIP
    """
    name, pair = next(iter(channels.items()), ("", ("", "")))
    if len(channels) != 1 or name not in told.estimated or tuple(pair[1:]) not in KINDS:
        raise SimulationError(
            f"compare takes one of {', '.join(told.estimated)} with its channel and 'rate' (of a "
            f"counter) or 'level', as {told.estimated[-1]}=('meter', 'rate'); got {channels}.",
            symbol=name,
        )
    channel, kind = pair
    trace, values = told[name], told.record[channel]
    true = np.append(np.diff(values), np.nan) if kind == "rate" else values
    true, low, high = true[: len(trace.t)], trace.lower, trace.upper
    known = trace.valid & np.isfinite(true) & np.isfinite(low) & np.isfinite(high)
    there = known & (true != 0)
    if scale is None:
        if not there.any():
            raise SimulationError(
                f"{channel} is nowhere other than zero where {name} has an interval: give scale=.",
                symbol=channel,
            )
        middle = 0.5 * (low + high)[there]
        scale = float(middle @ true[there] / (true[there] @ true[there]))
    ends = np.sort([low[there] / true[there], high[there] / true[there]], axis=0)
    least, most = ends[0].max(initial=-np.inf), ends[1].min(initial=np.inf)
    quiet = known & (true == 0)
    right = least <= most and bool(np.all((low <= 0) & (high >= 0) | ~quiet))
    inside = (low <= scale * true) & (scale * true <= high)
    outside = np.zeros(len(true), dtype=bool)
    at = told.alarms().get(name)
    outside[np.flatnonzero(known & ((low > 0) | (high < 0))) if at is None else at] = True
    first = np.flatnonzero(outside & there)
    late = told.fault_delay if name in told.names["f"] else 0
    return Comparison(
        name,
        channel,
        kind,
        scale,
        (float(least), float(most)) if right else None,
        float(inside[known].mean()),
        int((outside & quiet).sum()),
        int(first[0]) if first.size else None,
        int(first[0]) + late if first.size else None,
        float((outside & there).sum() / max(there.sum(), 1)),
    )
