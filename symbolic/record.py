"""Records: what was measured of a plant, one row for each instant."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import PlantError

GROUPS = ("u", "y", "reference")


@dataclass(frozen=True, eq=False)
class Record:
    """Measured inputs and outputs of a plant; rows are instants, NaN is a missing reading.

    Parameters
    ----------
    time : array (N,)
        In seconds, increasing.
    u, y, reference : array (N, number of channels)
        Inputs and outputs in the plant's order and units, and channels that no observer reads.
    names, units : mapping of "u", "y", "reference" to tuples of str
    source : str
        Where it came from.

    Raises
    ------
    PlantError
        If the arrays do not fit each other or the names, or the time does not increase.

    Examples
    --------
    >>> names = {"u": ("v",), "y": ("h",), "reference": ()}
    >>> units = {"u": ("V",), "y": ("cm",), "reference": ()}
    >>> record = Record([0, 1], [[5], [5]], [[40], [41]], np.empty((2, 0)), names, units, "by hand")
    >>> record["h"].tolist()
    [40.0, 41.0]
    """

    time: FloatArray
    u: FloatArray
    y: FloatArray
    reference: FloatArray
    names: Mapping[str, tuple[str, ...]]
    units: Mapping[str, tuple[str, ...]]
    source: str

    def __post_init__(self) -> None:
        time = np.array(self.time, dtype=float)
        if time.ndim != 1 or time.size < 2 or not np.all(np.diff(time) > 0):
            raise PlantError(f"record {self.source!r}: the time has to increase", field="time")
        for group in GROUPS:
            array = np.array(getattr(self, group), dtype=float)
            shape = (time.size, len(self.names[group]))
            if array.shape != shape or len(self.units[group]) != shape[1]:
                raise PlantError(
                    f"record {self.source!r}: {group} has shape {array.shape}; {shape} is needed, "
                    f"a row for each instant, and a name and a unit for each column",
                    field=group,
                )
            array.flags.writeable = False
            object.__setattr__(self, group, array)
        time.flags.writeable = False
        object.__setattr__(self, "time", time)

    def __len__(self) -> int:
        return int(self.time.size)

    def __getitem__(self, name: str) -> FloatArray:
        """Return a channel by its name, shape (N,)."""
        for group in GROUPS:
            if name in self.names[group]:
                column: FloatArray = getattr(self, group)[:, self.names[group].index(name)]
                return column
        known = ", ".join(n for group in GROUPS for n in self.names[group])
        raise PlantError(f"no channel is called {name!r}; there are {known}", symbol=name)

    def __repr__(self) -> str:
        return (
            f"<Record {self.source!r}, {len(self)} samples, t = {self.time[0]:g} to "
            f"{self.time[-1]:g}, inputs {', '.join(self.names['u'])}, "
            f"outputs {', '.join(self.names['y'])}>"
        )
