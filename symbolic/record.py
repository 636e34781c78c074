"""Records: what was measured of a plant, one row for each instant."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import PlantError


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
    """

    time: FloatArray
    u: FloatArray
    y: FloatArray
    reference: FloatArray
    names: Mapping[str, tuple[str, ...]]
    units: Mapping[str, tuple[str, ...]]
    source: str

    def __post_init__(self) -> None:
        for group in ("time", *self.names):
            array = np.array(getattr(self, group), dtype=float)
            array.flags.writeable = False
            object.__setattr__(self, group, array)
            shape = (len(self.time), len(self.names.get(group, ())))
            if group != "time" and (array.shape != shape or len(self.units[group]) != shape[1]):
                raise PlantError(
                    f"record {self.source!r}: {group} has shape {array.shape}; {shape} is needed, "
                    "a row for each instant, and a name and a unit for each column",
                    field=group,
                )
        if self.time.ndim != 1 or len(self) < 2 or not np.all(np.diff(self.time) > 0):
            raise PlantError(f"record {self.source!r}: the time has to increase", field="time")

    def __len__(self) -> int:
        return len(self.time)

    def __getitem__(self, name: str) -> FloatArray:
        """Return a channel by its name, shape (N,)."""
        names = [n for group in self.names.values() for n in group]
        if name not in names:
            known = ", ".join(names)
            raise PlantError(f"no channel is called {name!r}; there are {known}", symbol=name)
        return np.hstack([getattr(self, g) for g in self.names])[:, names.index(name)]

    def __repr__(self) -> str:
        u, y = (", ".join(self.names[group]) for group in ("u", "y"))
        return f"<Record {self.source!r}, {len(self)} samples, inputs {u}, outputs {y}>"
