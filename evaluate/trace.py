"""One signal of a run, and where it was outside of its interval."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.designs.core.observer import STATUS
from obsynth.evaluate.errors import SimulationError
from obsynth.symbolic.arrays import BoolArray, FloatArray
from obsynth.symbolic.table import Table, Tabled


@dataclass(frozen=True, eq=False, repr=False)
class Trace(Tabled):
    """One signal over time: truth, estimate and interval, all about the same instants.

    Signals without an estimate (inputs, outputs, disturbances) have None there. With ``fault_delay
    = 1`` a fault's trace ends one sample before the run, as its claims arrive one sample late;
    ``alarm`` is about the instant ``fault_delay`` earlier.
    """

    name: str
    unit: str
    t: FloatArray
    true: FloatArray
    estimate: FloatArray | None = None
    lower: FloatArray | None = None
    upper: FloatArray | None = None
    alarm: NDArray[np.bool_] | None = None
    status: NDArray[np.int64] | None = None

    def table(self) -> Table:
        """Tabulate the ends of what there is."""
        kinds = {"truth": self.true, "estimate": self.estimate}
        kinds |= {"lower bound": self.lower, "upper bound": self.upper}
        rows = [
            [kind, float(np.nanmin(values)), float(np.nanmax(values))]
            for kind, values in kinds.items()
            if values is not None and not np.isnan(values).all()
        ]
        title = f"Trace of {self.label}, {len(self.t)} instants"
        return Table(title, ["", "least", "largest"], rows)

    @property
    def label(self) -> str:
        """Name with its unit, for axes and heads."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    @property
    def bounded(self) -> bool:
        """Whether the interval excludes anything at any instant."""
        if self.lower is None or self.upper is None:
            return False
        return bool(np.any(~(np.isneginf(self.lower) & np.isposinf(self.upper))))

    @property
    def valid(self) -> BoolArray:
        """Where the status allows the interval to be relied upon."""
        bits = STATUS["not_initialised"] | STATUS["fault_not_valid"]
        none = np.zeros(len(self.t), dtype=np.int64)
        return np.asarray((none if self.status is None else self.status) & bits == 0)

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Where the truth is inside the interval, tolerance zero; no number is outside."""
        if self.lower is None or self.upper is None:
            raise SimulationError(f"{self.name} has no interval.", symbol=self.name)
        return np.asarray((self.lower <= self.true) & (self.true <= self.upper))

    @property
    def error(self) -> FloatArray:
        """Truth minus estimate."""
        if self.estimate is None:
            raise SimulationError(f"{self.name} is not estimated.", symbol=self.name)
        return np.asarray(self.true - self.estimate)

    @property
    def half_width(self) -> FloatArray:
        """Half the length of the interval."""
        if self.lower is None or self.upper is None:
            raise SimulationError(f"{self.name} has no interval.", symbol=self.name)
        return np.asarray(0.5 * (self.upper - self.lower))


def as_told(claims: Mapping[str, FloatArray]) -> dict[str, Any]:
    """Return what a step told at every instant, words of bits whole and alarms true or false."""
    told: dict[str, Any] = dict(claims)
    for key in {"status", "mean_status"} & told.keys():
        told[key] = told[key].reshape(-1).astype(np.int64)
    return told | ({"alarm": told["alarm"] > 0.5} if "alarm" in told else {})


def take(run: Any, name: str) -> Trace:
    """Return a signal of a run or of an estimate, whose truth is no number where it is unknown."""
    group = next((key for key, names in run.names.items() if name in names), None)
    if group is None:
        known = ", ".join(n for names in run.names.values() for n in names)
        raise SimulationError(f"no signal is called {name!r}; there are {known}.", symbol=name)
    i = run.names[group].index(name)
    unit, true = run.units[group][i], getattr(run, group, None)
    true = np.full(len(run.t), np.nan) if true is None else true[:, i]
    if group not in ("x", "f"):
        return Trace(name, unit, run.t, true)
    late = run.fault_delay if group == "f" else 0
    until = len(run.t) - late
    told = (getattr(run, key) for key in (f"{group}hat", f"{group}_lower", f"{group}_upper"))
    estimate, lower, upper = (array[late:, i] for array in told)
    t, true, alarm = run.t[:until], true[:until], None
    status = run.status[late:]
    if group == "x":
        status = status & ~STATUS["fault_not_valid"]
    elif run.alarm is not None:
        alarm = run.alarm[:until, i]
    return Trace(name, unit, t, true, estimate, lower, upper, alarm, status)


@dataclass(frozen=True)
class Violation:
    """A signal that was outside its interval at so many instants of the whole run.

    instants, amounts: the first few instants k, and how far outside the truth was
    worst, worst_at: the largest amount and its instant
    """

    signal: str
    count: int
    instants: tuple[int, ...]
    amounts: tuple[float, ...]
    worst: float
    worst_at: int

    def __str__(self) -> str:
        first = ", ".join(
            f"k = {k} by {a:.3g}" for k, a in zip(self.instants, self.amounts, strict=True)
        )
        more = ", ..." if self.count > len(self.instants) else ""
        return (
            f"{self.signal}: {self.count} instants outside ({first}{more}; "
            f"worst {self.worst:.3g} at k = {self.worst_at})"
        )
