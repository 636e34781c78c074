"""Records: what was measured of a plant, one row for each instant."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, overload

import numpy as np

from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import RecordError
from obsynth.symbolic.findings import Finding, find, quantum
from obsynth.symbolic.shown import card
from obsynth.symbolic.table import Table

GROUPS = ("u", "rho", "y", "reference")


@dataclass(frozen=True, eq=False)
class Record:
    """Measured inputs and outputs of a plant; rows are instants, NaN is a missing reading.

    Parameters
    ----------
    time : array (N,)
        In seconds, increasing.
    u, y, reference : array (N, number of channels)
        Inputs and outputs in the plant's order and units, and channels that no observer reads.
    names, units : mapping of "u", "y", "reference" and, if there are any, "rho" to tuples of str
    source : str
        Where it came from.
    rho : array (N, number of channels), optional
        Measured scheduling.
    notes : tuple of str
        What was assumed or seen when it was read, a sentence each.
    start : numpy.datetime64, optional
        The clock at time 0, in universal time where the source had a zone.

    Raises
    ------
    RecordError
        If the arrays do not fit each other or the names, or the time does not increase.

    Notes
    -----
    ``record["y1"]`` is a channel, ``record[36:217]`` the record of these rows, with their times.
    """

    time: FloatArray
    u: FloatArray
    y: FloatArray
    reference: FloatArray
    names: Mapping[str, tuple[str, ...]]
    units: Mapping[str, tuple[str, ...]]
    source: str
    rho: Any = ()
    notes: tuple[str, ...] = ()
    start: Any = None

    def __post_init__(self) -> None:
        for field in ("names", "units"):
            object.__setattr__(self, field, dict.fromkeys(GROUPS, ()) | getattr(self, field))
        for group in ("time", *GROUPS):
            array = np.array(getattr(self, group), dtype=float)
            if len(self.time) and not array.size:
                array = np.zeros((len(self.time), 0))
            array.flags.writeable = False
            object.__setattr__(self, group, array)
            shape = (len(self.time), len(self.names.get(group, ())))
            if group != "time" and (array.shape != shape or len(self.units[group]) != shape[1]):
                raise RecordError(
                    f"record {self.source!r}: {group} has shape {array.shape}; {shape} is needed, "
                    "a row for each instant, and a name and a unit for each column",
                    field=group,
                )
        if self.time.ndim != 1 or len(self) < 2 or not np.all(np.diff(self.time) > 0):
            raise RecordError(
                f"record {self.source!r}: the time has to increase, over two instants at least",
                field="time",
            )

    def __len__(self) -> int:
        return len(self.time)

    @property
    def _channels(self) -> dict[str, tuple[str, int, str]]:
        """Name -> group, column and unit of every channel."""
        return {
            name: (group, j, self.units[group][j])
            for group in GROUPS
            for j, name in enumerate(self.names[group])
        }

    def _place(self, name: str) -> tuple[str, int, str]:
        if name not in self._channels:
            known = ", ".join(self._channels)
            raise RecordError(f"no channel is called {name!r}; there are {known}", symbol=name)
        return self._channels[name]

    @overload
    def __getitem__(self, key: str) -> FloatArray: ...
    @overload
    def __getitem__(self, key: slice) -> "Record": ...
    def __getitem__(self, key: str | slice) -> "FloatArray | Record":
        if isinstance(key, slice):
            rows = {group: getattr(self, group)[key] for group in ("time", *GROUPS)}
            return replace(self, **rows)
        group, column, _ = self._place(key)
        channel: FloatArray = getattr(self, group)[:, column]
        return channel

    def split(self, *rows: int) -> "tuple[Record, ...]":
        """Return the records before, between and from these rows on."""
        return tuple(self[a:b] for a, b in pairwise([0, *rows, len(self)]))

    def windows(self, length: int) -> "tuple[Record, ...]":
        """Return as many windows of `length` instants as there are, one after the other."""
        starts = range(0, len(self) - length + 1, length)
        return tuple(self[a : a + length] for a in starts)

    def findings(self, *kinds: str) -> tuple[Finding, ...]:
        """Return what the readings show before any model, of these kinds or all.

        "stuck", "saturated", "outlier" and "missing"; each says what it means and what to do.
        """
        return tuple(f for f in self._findings if not kinds or f.kind in kinds)

    @property
    def quanta(self) -> dict[str, float]:
        """Step of each output's readings, NaN where there is none; half of it is noise at least."""
        return {name: quantum(self[name]) for name in self.names["y"]}

    @cached_property
    def _findings(self) -> tuple[Finding, ...]:
        inputs = np.hstack([self.u, self.rho])
        return tuple(
            found for name in self.names["y"] for found in find(name, self[name], self.time, inputs)
        )

    def without(self, name: str | Finding, rows: Any = slice(None)) -> "Record":
        """Return the record with NaN in an output or reference, at these rows or all.

        Parameters
        ----------
        name : str or Finding
            A channel, or what was found in one, with its rows.
        rows : int, slice, sequence of int or array (N,) of bool
        """
        channel, at = (name, rows) if isinstance(name, str) else (name.channel, name.rows)
        group, column, _ = self._place(channel)
        if group in ("u", "rho"):
            raise RecordError(
                f"{channel} is known to the plant, and no observer can do without it; leave the "
                "instants out: record[a:b]",
                symbol=channel,
            )
        array = np.array(getattr(self, group))
        before = np.isnan(array).sum()
        array[at, column] = np.nan
        note = f"{channel}: readings were taken out at {np.isnan(array).sum() - before} instants"
        changed: dict[str, Any] = {group: array}
        return replace(self, **changed, notes=(*self.notes, note))

    def to_frame(self) -> Any:
        """Return a pandas DataFrame, units in ``attrs``, which `read_record` takes back.

        Its index is the time: in seconds, or the clock's where it is known.
        """
        import pandas as pd

        seconds = pd.to_timedelta(self.time, unit="s")
        time = pd.Index(self.time if self.start is None else seconds + self.start, name="time")
        values = np.hstack([getattr(self, group) for group in GROUPS])
        frame = pd.DataFrame(values, index=time, columns=list(self._channels))
        frame.attrs["units"] = {name: unit for name, (_, _, unit) in self._channels.items()}
        return frame

    def __repr__(self) -> str:
        u, y = (", ".join(self.names[group]) for group in ("u", "y"))
        return f"<Record {self.source!r}, {len(self)} samples, inputs {u}, outputs {y}>"

    def _repr_html_(self) -> str:
        heads = ("channel", "role", "unit", "range", "missing", "quantum", "findings")
        words = {"u": "input", "rho": "scheduling", "y": "output", "reference": "reference"}
        rows = []
        for name, (group, _, unit) in self._channels.items():
            values = self[name][np.isfinite(self[name])]
            span = f"[{values.min():g}, {values.max():g}]" if values.size else "none"
            step = f"{self.quanta[name]:.4g}".replace("nan", "") if group == "y" else ""
            kinds = [f.kind for f in self.findings() if f.channel == name]
            found = ", ".join(f"{kinds.count(k)} {k}" for k in dict.fromkeys(kinds))
            rows.append((name, words[group], unit, span, str(len(self) - values.size), step, found))
        title = f"{self.source}, {len(self)} instants, {self.time[0]:g} to {self.time[-1]:g} s"
        return card(title, Table("", heads, rows), [*self.findings(), *self.notes])

    def plot(self, names: Sequence[str] | None = None, ax: Any = None) -> Any:
        """Plot channels over time, by default all; findings are marked.

        Parameters
        ----------
        names : str or sequence of str, optional
        ax : Axes or array of Axes, optional
            One for each channel.

        Returns
        -------
        ndarray of Axes, one for each channel
        """
        import matplotlib.pyplot as plt

        chosen = [names] if isinstance(names, str) else list(names or self._channels)
        if ax is None:
            figure = plt.figure(figsize=(5.4, 0.6 + 1.1 * len(chosen)), layout="constrained")
            ax = figure.subplots(len(chosen), 1, sharex=True)
        axes = np.atleast_1d(np.asarray(ax, dtype=object)).ravel()
        if len(axes) != len(chosen):
            raise RecordError(f"{len(axes)} axes were given for {len(chosen)} channels")
        for panel, name in zip(axes, chosen, strict=True):
            group, _, unit = self._place(name)
            held = group in ("u", "rho")
            style = {"drawstyle": "steps-post"} if held else {"marker": ".", "markersize": 3}
            panel.plot(self.time, self[name], color="#1b1d21", linewidth=0.8, **style)
            panel.set_ylabel(f"{name} [{unit}]" if unit else name)
            rows = [f.rows for f in self.findings() if f.channel == name]
            marks = {"marker": "|", "linestyle": "", "color": "#d55e00", "clip_on": False}
            if rows:
                at = self.time[np.concatenate(rows)]
                panel.plot(at, 0 * at, transform=panel.get_xaxis_transform(), **marks)
        axes[-1].set_xlabel("time [s]")
        return axes
