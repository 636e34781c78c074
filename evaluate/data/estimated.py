"""What an estimate from a record says: sets, how wide they are, and what contradicts what."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.designs.core.observer import STATUS
from obsynth.designs.detection.comparison import find_voids, list_voids
from obsynth.designs.detection.detector import SKIPPED
from obsynth.designs.detection.observed import core_of
from obsynth.evaluate.data.allowed import allowed
from obsynth.evaluate.data.meter import compare
from obsynth.evaluate.data.tables import to_dataset, write_columns
from obsynth.evaluate.domain import count_status
from obsynth.evaluate.errors import SimulationError
from obsynth.evaluate.trace import Trace, take
from obsynth.symbolic import Record
from obsynth.symbolic.arrays import BoolArray, FloatArray, IntArray
from obsynth.symbolic.shown import plain
from obsynth.symbolic.table import Table, text


@dataclass(frozen=True)
class Refutation:
    """Where a record and the assumptions of an observer cannot both be right, first, and why.

    signals: the readings each of which makes the instant void; else the signals whose sets miss
        their declared ranges. Empty where no single reading does
    """

    instant: int
    time: float
    signals: tuple[str, ...]
    why: str

    def __str__(self) -> str:
        at = f"k = {self.instant} ({self.time:g} s)"
        return f"the record refutes the assumptions at {at}: {self.why}"


@dataclass(frozen=True, eq=False, repr=False)
class Estimate:
    """What an observer says of a record; arrays are (N, ...), time first, read-only.

    Attributes
    ----------
    observer : Observer or FaultDetector
    record : Record
    time (or t), u, rho, y, reference : (N,), (N, channels)
        Those of the record.
    xhat, fhat, x_lower, x_upper, f_lower, f_upper : (N, n or n_f)
        What ``observer.step`` returned at that instant; with ``fault_delay = 1`` the fault columns
        at k speak of instant k - 1, and ``estimate[name]`` aligns them.
    status : (N,) int
        Bit mask of the step.
    alarm : (N, n_f) bool or None
        Alarms of a fault detector; None where an observer ran alone.
    mean_lower, mean_upper : (N, n_f) or None, mean_status : (N,) int or None
        Of a detector with a window m: means of the faults over k - m..k - 1, and the status.
    windows : tuple of FaultDetector
        Of the windows that were asked for, see `means`.
    blamed : tuple of str
        Outputs without each of which the first void instant would not be void.
    names, units : dict
        By group: "x", "f" and those of the record; ``estimated`` are states, then faults.
    fault_delay, method, scenario : int and str
        Of the observer; the source of the record.
    """

    observer: Any
    record: Record
    xhat: FloatArray
    fhat: FloatArray
    x_lower: FloatArray
    x_upper: FloatArray
    f_lower: FloatArray
    f_upper: FloatArray
    status: NDArray[np.int64]
    alarm: BoolArray | None = None
    mean_lower: FloatArray | None = None
    mean_upper: FloatArray | None = None
    mean_status: IntArray | None = None
    blamed: tuple[str, ...] = ()
    windows: tuple[Any, ...] = ()
    time: FloatArray = field(init=False)
    t: FloatArray = field(init=False)
    u: FloatArray = field(init=False)
    rho: FloatArray = field(init=False)
    y: FloatArray = field(init=False)
    reference: FloatArray = field(init=False)
    names: Mapping[str, tuple[str, ...]] = field(init=False)
    units: Mapping[str, tuple[str, ...]] = field(init=False)
    estimated: tuple[str, ...] = field(init=False)
    fault_delay: int = field(init=False)
    method: str = field(init=False)
    scenario: str = field(init=False)

    def __post_init__(self) -> None:
        model, record = self.observer.model, self.record
        own = {kind: tuple(s.unit for s in getattr(model, kind)) for kind in ("x", "f")}
        names = {"x": model.names("x"), "f": model.names("f"), **record.names}
        told = {group: getattr(record, group) for group in ("time", *record.names)}
        told |= {"t": record.time, "names": names, "units": {**own, **record.units}}
        told |= {"estimated": names["x"] + names["f"], "scenario": record.source}
        told |= {name: getattr(self.observer, name) for name in ("fault_delay", "method")}
        for name, value in told.items():
            object.__setattr__(self, name, value)

    def __getitem__(self, name: str) -> Trace:
        return take(self, name)

    @property
    def status_shares(self) -> dict[str, float]:
        """Shares of the instants with status 0 ("ok") and with each bit, by its name."""
        bits = {name: float(np.mean(self.status & bit > 0)) for name, bit in STATUS.items()}
        return {"ok": float(np.mean(self.status == 0)), **bits}

    @property
    def first(self) -> dict[str, int | None]:
        """The first instant with each bit of the status; None where it was never set."""
        at = {name: np.flatnonzero(self.status & bit) for name, bit in STATUS.items()}
        return {name: int(k[0]) if k.size else None for name, k in at.items()}

    @cached_property
    def means(self) -> Mapping[int, Mapping[str, Trace]]:
        """Means of the faults over the m instants before that of the row, by m and name."""
        found: dict[int, dict[str, Trace]] = {}
        none = np.full(len(self.t), np.nan)
        for detector in self.windows:
            m, (lower, upper, status) = detector.window, detector.means(self)
            for s, low, high in zip(detector.model.f, lower.T, upper.T, strict=True):
                given = f"mean of {s.name} over {m}", s.unit, self.t, none, None, low, high
                found.setdefault(m, {})[s.name] = Trace(*given, status=status)
        return found

    @property
    def _traces(self) -> list[Trace]:
        own = [self[name] for name in self.estimated]
        return own + [trace for told in self.means.values() for trace in told.values()]

    def widths(self) -> dict[str, dict[str, float]]:
        """Half widths of every state and fault over the record, and of means of faults.

        Returns
        -------
        dict of name to dict
            ``median`` and ``largest`` half width of the finite intervals, the share of instants at
            which it is ``finite``, and the median as a share ``of_range`` of the half range.
        """
        found = {}
        kinds = ("x", *["f"] * (1 + len(self.means)))
        boxes = np.vstack([self.observer.model.box(k).reshape(-1, 2) for k in kinds])
        for trace, box in zip(self._traces, boxes, strict=True):
            half = trace.half_width
            known = half[np.isfinite(half) & trace.valid]
            middle, most = (np.median(known), known.max()) if known.size else (np.inf, np.inf)
            size = 0.5 * (box[1] - box[0])
            share = middle / size if 0 < size < np.inf else np.nan
            numbers = (middle, most, known.size / len(half), share)
            words = ("median", "largest", "finite", "of_range")
            found[trace.name] = dict(zip(words, map(float, numbers), strict=True))
        return found

    @cached_property
    def y_range(self) -> tuple[FloatArray, FloatArray]:
        """What the sets and the bounds of the noise allow of every reading, (N, m) twice.

        Intervals of nonlinear outputs are proved, too. Faults run over their sets of that instant,
        over their ranges where there is none or it holds a mean.
        """
        model, core = self.observer.model, core_of(self.observer)
        known = {"x": (self.x_lower, self.x_upper), "u": (self.u, self.u)}
        if core is None or not core.mean_fault:
            f = np.repeat(model.box("f").reshape(-1, 2).T[:, None, :], len(self.t), axis=1)
            for j, trace in enumerate(self[name] for name in self.names["f"]):
                ends = np.array([trace.lower, trace.upper])
                f[:, : len(trace.t), j] = np.where(trace.valid, ends, f[:, : len(trace.t), j])
            known["f"] = (f[0], f[1])
        if model.rho:
            rho = np.repeat(model.box("rho").T[:, None, :], len(self.t), axis=1)
            rho[:, :, [s.measured for s in model.rho]] = self.rho
            known["rho"] = (rho[0], rho[1])
        return allowed(model, **known)

    @property
    def consistent(self) -> float:
        """Share of readings inside of what the sets allow, of those that sets say anything of."""
        lower, upper = self.y_range
        said = np.isfinite(self.y) & (np.isfinite(lower) | np.isfinite(upper))
        inside = (lower <= self.y) & (self.y <= upper)
        return float(inside[said].mean()) if said.any() else float("nan")

    @property
    def use(self) -> dict[str, float]:
        """How much of what the sets allow the readings took, by the names of the outputs.

        The largest distance of a reading from the middle of its interval, as a share of the half
        width: above 1 is a contradiction; far below 1 says that the bounds are loose.
        """
        lower, upper = self.y_range
        with np.errstate(invalid="ignore"):
            share = np.abs(self.y - 0.5 * (lower + upper)) / (0.5 * (upper - lower))
        share = np.where(np.isfinite(share), share, 0.0)
        return dict(zip(self.names["y"], share.max(axis=0).tolist(), strict=True))

    @cached_property
    def _missed(self) -> BoolArray:
        """Where a valid interval of this call misses the declared range, (N, n + n_f)."""
        low, high = np.hstack([self.x_lower, self.f_lower]), np.hstack([self.x_upper, self.f_upper])
        boxes = np.vstack([self.observer.model.box(k).reshape(-1, 2) for k in ("x", "f")])
        missed = (low > boxes[:, 1]) | (high < boxes[:, 0])
        missed[self.status & STATUS["fault_not_valid"] > 0, len(self.names["x"]) :] = False
        return np.asarray(missed)

    @property
    def conflict(self) -> IntArray:
        """Instants at which an interval misses its declared range: an assumption is broken."""
        return np.flatnonzero(self._missed.any(axis=1))

    @property
    def refuted(self) -> Refutation | None:
        """The first instant that is void or in conflict, with the signals; None if none is."""
        void = np.flatnonzero(self.status & STATUS["void"])
        both = np.concatenate([void, self.conflict])
        if not both.size:
            return None
        k = int(both.min())
        if k in void:
            names, alone = self.blamed, f"without {', '.join(self.blamed)} it would not be"
            why = (
                f"a set is empty or a reading impossible; {alone if names else 'not by one alone'}"
            )
        else:
            missed = zip(self.estimated, self._missed[k], strict=True)
            names = tuple(name for name, out in missed if out)
            why = f"the set of {', '.join(names)} misses the declared range"
        return Refutation(k, float(self.t[k]), names, why)

    def alarms(self, persistence: int = 1) -> dict[str, IntArray]:
        """Return the instants at which each fault was there for certain.

        Parameters
        ----------
        persistence : int
            Consecutive samples that count, as `FaultDetector` counts them, at which zero has to be
            outside of the fault's interval.

        Returns
        -------
        dict of name to (count,) int
            Instants of the fault, which is known `fault_delay` samples later; of means of faults
            those at which they are known.
        """
        if persistence < 1:
            raise SimulationError(f"persistence={persistence!r} is no number of samples from 1 on.")
        skip = sum(STATUS[name] for name in SKIPPED)
        ends = zip(self.names["f"], self.f_lower.T, self.f_upper.T, strict=True)
        told: list[Any] = [(*one, self.status, self.fault_delay) for one in ends]
        traces = self._traces[len(self.estimated) :]
        told += [(trace.name, trace.lower, trace.upper, trace.status, 0) for trace in traces]
        found = {}
        for name, low, high, status, late in told:
            valid, void = status & skip == 0, status & STATUS["void"] > 0
            kept = np.flatnonzero(valid | void)
            order = np.arange(len(kept))
            hit = (((low > 0) | (high < 0)) & valid)[kept]
            since = order - np.maximum.accumulate(np.where(hit, -1, order))
            at = kept[hit & (since >= persistence)] - late
            found[name] = at[at >= 0]
        return found

    compare = compare

    def summary(self) -> Table:
        """Widths of every state and fault, and when a fault was certain."""
        alarms, rows = self.alarms(), []
        for trace, width in zip(self._traces, self.widths().values(), strict=True):
            at = alarms.get(trace.name)
            since = float(self.t[at[0]]) if at is not None and at.size else None
            share = width["of_range"]
            rows.append([trace.label, width["median"], width["largest"], width["finite"]])
            rows[-1] += [None if np.isnan(share) else share, since]
        columns = ["signal", "median half width", "largest", "finite", "of the range"]
        title = f"{self.method} on {self.record.source}, {len(self.t)} instants"
        return Table(title, [*columns, "certain from [s]"], rows, "; ".join(self.said))

    @property
    def said(self) -> list[str]:
        """What there is to know beside the widths, in sentences."""
        agree = f"{text(100 * self.consistent, 4)} % of the readings are inside of what sets allow"
        took = ", ".join(f"{text(share, 2)} of {name}" for name, share in self.use.items())
        lines = [f"{agree}, of whose half widths they take {took}"]
        lines += map(str, count_status(self.status))
        lines += list_voids(find_voids(self.status))
        lines += [str(self.refuted)] if self.refuted else []
        return [*lines, *self.record.notes]

    def to_dict(self) -> dict[str, Any]:
        """Return what the estimate says as numbers for JSON; what is no finite number is None."""
        names = ("method", "fault_delay", "status_shares", "first", "consistent", "use")
        refuted = self.refuted
        told: dict[str, Any] = {
            **{name: getattr(self, name) for name in names},
            "model": self.observer.model.name,
            "source": self.record.source,
            "instants": len(self.t),
            "widths": self.widths(),
            "conflict": self.conflict.tolist(),
            "alarms": {name: at.tolist() for name, at in self.alarms().items()},
            "refuted": None if refuted is None else {**vars(refuted), "said": str(refuted)},
            "notes": list(self.record.notes),
        }
        return dict(plain(told))

    def columns(self) -> dict[str, FloatArray]:
        """Return every signal by its name, (N,) each, all about the instant of their row.

        Faults that are known a call late stand in the row of their own instant, and are no number
        in the last row.
        """
        found = {"time": self.t}
        for group in self.record.names:
            found |= zip(self.names[group], getattr(self, group).T, strict=True)
        late, gap = self.fault_delay, np.full(self.fault_delay, np.nan)
        for key, labels in self.observer.outputs.items():
            array = getattr(self, key)
            if key[0] == "f":
                array = np.vstack([array[late:], np.repeat(gap[:, None], array.shape[1], axis=1)])
            found |= zip(labels, array.reshape(len(self.t), -1).T, strict=True)
        for m, means in self.means.items():
            for name, trace in means.items():
                labels = (f"{name}_mean_{m}_lower", f"{name}_mean_{m}_upper", f"mean_{m}_status")
                told = np.array([trace.lower, trace.upper, trace.status], dtype=float)
                found |= zip(labels, told, strict=True)
        return found

    def to_frame(self) -> Any:
        """Return a ``pandas.DataFrame``: rows are instants, see `columns`."""
        import pandas as pd

        return pd.DataFrame(self.columns()).set_index("time")

    def to_xarray(self) -> Any:
        """Return an ``xarray.Dataset`` as `Run.to_xarray` does; faults as the step gave them."""
        attrs = {"model": self.observer.model.name, "method": self.method}
        attrs |= {"source": self.record.source, "fault_delay": self.fault_delay}
        return to_dataset(self, attrs)

    def write(self, path: str | os.PathLike[str]) -> Path:
        """Write `columns` as .parquet (with pyarrow) or .csv; replaced only when complete."""
        return write_columns(path, self.columns())

    def plot(self, signals: tuple[str, ...] | None = None) -> Any:
        """Plot all estimated signals in a grid; see :func:`obsynth.evaluate.plot_run`."""
        from obsynth.evaluate.plotting.plots import plot_run

        return plot_run(self, signals)

    def report(self, path: str | os.PathLike[str], **channels: Any) -> Path:
        """Write one self-contained HTML page as `report` does; `channels` as in `compare`."""
        from obsynth.evaluate.report import report

        lead = str(self.compare(**channels)) if channels else ""
        return report(path, self.observer, self, lead=lead)

    @property
    def verdict(self) -> str:
        """Whether the record refutes the assumptions, in a sentence."""
        return str(self.refuted or f"nothing in {self.record.source} refutes the assumptions")

    def __repr__(self) -> str:
        return f"<Estimate by {self.method} on {self.record.source!r}, {self.verdict}>"

    def __str__(self) -> str:
        return str(self.summary())

    def _repr_html_(self) -> str:
        return self.summary()._repr_html_()
