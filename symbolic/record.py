"""Records: what was measured of a plant, one row for each instant."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, overload

import numpy as np

from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import RecordError

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
            if group != "time" and not array.size:
                array = array.reshape(len(self.time), -1)
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

    def _place(self, name: str) -> tuple[str, int]:
        """Return group and column of a channel."""
        for group in GROUPS:
            if name in self.names[group]:
                return group, self.names[group].index(name)
        known = ", ".join(n for group in GROUPS for n in self.names[group])
        raise RecordError(f"no channel is called {name!r}; there are {known}", symbol=name)

    @overload
    def __getitem__(self, key: str) -> FloatArray: ...
    @overload
    def __getitem__(self, key: slice) -> "Record": ...
    def __getitem__(self, key: str | slice) -> "FloatArray | Record":
        if isinstance(key, slice):
            rows = {group: getattr(self, group)[key] for group in ("time", *GROUPS)}
            return replace(self, **rows)
        group, column = self._place(key)
        channel: FloatArray = getattr(self, group)[:, column]
        return channel

    def split(self, *rows: int) -> "tuple[Record, ...]":
        """Return the records before, between and from these rows on."""
        ends = [0, *rows, len(self)]
        if not all(a + 2 <= b for a, b in pairwise(ends)):
            raise RecordError(
                f"record {self.source!r}: rows {', '.join(map(str, rows))} do not divide "
                f"{len(self)} instants into parts of two or more, one after the other",
                rows=rows,
            )
        return tuple(self[a:b] for a, b in pairwise(ends))

    def windows(self, length: int) -> "tuple[Record, ...]":
        """Return as many windows of `length` instants as there are, one after the other."""
        count = len(self) // length if length >= 2 else 0
        if not count:
            raise RecordError(
                f"record {self.source!r}: {len(self)} instants have no window of {length}; give 2 "
                f"to {len(self)}",
                length=length,
            )
        return tuple(self[a : a + length] for a in range(0, count * length, length))

    def without(self, name: str, rows: Any = slice(None)) -> "Record":
        """Return the record with NaN in an output or reference, at these rows or all.

        rows: a row, a slice, a sequence of rows or an array of bool (N,)
        """
        group, column = self._place(name)
        if group in ("u", "rho"):
            raise RecordError(
                f"{name} is known to the plant, and no observer can do without it; leave the "
                "instants out: record[a:b]",
                symbol=name,
            )
        array = np.array(getattr(self, group))
        try:
            array[rows, column] = np.nan
        except IndexError as error:
            raise RecordError(
                f"{name}: rows {rows!r} are not among 0 to {len(self) - 1}", symbol=name
            ) from error
        note = f"{name}: readings were taken out at {np.isnan(array[:, column]).sum()} instants"
        changed: dict[str, Any] = {group: array}
        return replace(self, **changed, notes=(*self.notes, note))

    def to_frame(self) -> Any:
        """Return a pandas DataFrame, units in ``attrs``, which `read_record` takes back.

        Its index is the time: in seconds, or the clock's where it is known.
        """
        import pandas as pd

        time = pd.Index(self.time, name="time")
        if self.start is not None:
            time = (pd.to_timedelta(self.time, unit="s") + self.start).rename("time")
        names = [name for group in GROUPS for name in self.names[group]]
        frame = pd.DataFrame(
            np.hstack([getattr(self, group) for group in GROUPS]), index=time, columns=names
        )
        frame.attrs["units"] = dict(
            zip(names, (u for group in GROUPS for u in self.units[group]), strict=True)
        )
        return frame

    def __repr__(self) -> str:
        u, y = (", ".join(self.names[group]) for group in ("u", "y"))
        return f"<Record {self.source!r}, {len(self)} samples, inputs {u}, outputs {y}>"
