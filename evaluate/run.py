"""What a simulation gives: the truth, the claims about it, and whether they hold."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.designs.core.observer import Observer
from obsynth.designs.detection.comparison import list_voids
from obsynth.designs.detection.detector import FaultDetector
from obsynth.evaluate.checked import broken_assumptions, finite, state_box
from obsynth.evaluate.data.tables import to_dataset
from obsynth.evaluate.domain import Domain
from obsynth.evaluate.errors import SimulationError
from obsynth.evaluate.trace import Trace, Violation, as_told, take
from obsynth.symbolic import Plant, Scenario
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.shown import card
from obsynth.symbolic.table import Table
from obsynth.symbolic.taking import takes

# Instants listed for each violated signal; the count is always complete.
LISTED = 5


@dataclass(frozen=True, eq=False)
class Run:
    """A simulated scenario; arrays are (N + 1, ...), time first, read-only.

    Attributes
    ----------
    t : (N + 1,)
        Time in seconds.
    x, y, u, d, f, w, rho : (N + 1, number of signals)
        The truth at every instant.
    xhat, fhat, x_lower, x_upper, f_lower, f_upper : (N + 1, n_x or n_f)
        What ``Observer.step`` returned at that instant. A set carries the
        index of the state that it encloses; with ``fault_delay = 1`` the fault
        columns at k speak of instant k - 1, and ``run[name]`` aligns them.
    status : (N + 1,) int
        Bit mask of the step, explained by :attr:`domain`.
    alarm : (N + 1, n_f) bool or None
        Alarms of a fault detector; None where an observer ran alone.
    mean_lower, mean_upper : (N + 1, n_f) or None, mean_status : (N + 1,) int or None
        Of a detector with a window m: means of the faults over k - m..k - 1, and the status.
    names, units : dict
        Signal names and units by group ("x", "y", "u", "d", "f", "w", "rho").
    box : (n_x, 2)
        Box of the states over which the guarantee holds.
    half_widths : (n_x + n_f,) or None
        Steady half widths that the observer promises.
    scenario, seed, model, method, truth : str and int
        Where the run came from.
    outside : tuple of str
        Why the guarantee does not cover this run: another truth, or a declared range or rate
        that a signal did not keep, with the first instant, how often and how far; empty when
        it does.
    """

    t: FloatArray
    x: FloatArray
    y: FloatArray
    u: FloatArray
    d: FloatArray
    f: FloatArray
    w: FloatArray
    rho: FloatArray
    xhat: FloatArray
    fhat: FloatArray
    x_lower: FloatArray
    x_upper: FloatArray
    f_lower: FloatArray
    f_upper: FloatArray
    status: NDArray[np.int64]
    names: Mapping[str, tuple[str, ...]]
    units: Mapping[str, tuple[str, ...]]
    box: FloatArray
    half_widths: FloatArray | None
    fault_delay: int
    model: str
    scenario: str
    seed: int
    method: str
    truth: str
    outside: tuple[str, ...]
    alarm: NDArray[np.bool_] | None = None
    mean_lower: FloatArray | None = None
    mean_upper: FloatArray | None = None
    mean_status: NDArray[np.int64] | None = None

    @classmethod
    def collect(
        cls,
        *,
        model: Plant,
        observer: Observer | FaultDetector,
        scenario: Scenario,
        seed: int,
        truth: str,
        outside: tuple[str, ...],
        Ts: float,
        truths: Mapping[str, FloatArray],
        claims: Mapping[str, FloatArray],
    ) -> "Run":
        """Label what the simulation loop recorded; refuse a truth that is no number any more."""
        finite(truths["x"], model.names("x"))
        finite(truths["y"], tuple(model.output_names))
        t = np.arange(scenario.steps + 1, dtype=np.float64) * np.float64(Ts)
        groups = {key: getattr(model, key) for key in ("x", "u", "d", "f", "w", "rho")}
        names = {key: tuple(s.name for s in signals) for key, signals in groups.items()}
        units = {key: tuple(s.unit for s in signals) for key, signals in groups.items()}
        names["y"], units["y"] = tuple(model.output_names), tuple(model.output_units)
        arrays: dict[str, Any] = {**as_told(claims), **truths}
        for array in (t, *arrays.values()):
            array.setflags(write=False)
        half_widths = observer.half_widths
        return cls(
            t=t,
            names=names,
            units=units,
            box=state_box(observer),
            half_widths=None if half_widths is None else np.asarray(half_widths, dtype=float),
            fault_delay=int(observer.fault_delay),
            model=model.name,
            scenario=scenario.name,
            seed=int(seed),
            method=observer.method,
            truth=truth,
            outside=(*outside, *broken_assumptions(observer, scenario, truths)),
            **arrays,
        )

    @property
    def estimated(self) -> tuple[str, ...]:
        """Names of all signals with an estimate: states, then faults."""
        return self.names["x"] + self.names["f"]

    def __getitem__(self, name: str) -> Trace:
        return take(self, name)

    @cached_property
    def bounded(self) -> tuple[str, ...]:
        """Names of the estimated signals that the observer bounds at any instant at all."""
        return tuple(name for name in self.estimated if self[name].bounded)

    @cached_property
    def coverage(self) -> dict[str, float]:
        """Fraction of all instants at which each state and fault is inside its interval.

        Counted at tolerance zero over every instant, the transient included;
        a bound that is no number counts as outside. An infinite interval holds every truth
        and says nothing; see :attr:`bounded`.
        """
        return {name: float(np.mean(self[name].inside)) for name in self.estimated}

    @cached_property
    def violations(self) -> tuple[Violation, ...]:
        """Every signal that was outside its interval, with first instants and amounts."""
        found = []
        for name in self.estimated:
            trace = self[name]
            at = np.flatnonzero(~trace.inside)
            if at.size:
                lower, upper = _bounds(trace)
                amount = np.maximum(lower - trace.true, trace.true - upper)[at]
                amount = np.where(np.isnan(amount), np.inf, amount)
                worst = int(np.argmax(amount))
                found.append(
                    Violation(
                        name,
                        int(at.size),
                        tuple(int(k) for k in at[:LISTED]),
                        tuple(float(a) for a in amount[:LISTED]),
                        float(amount[worst]),
                        int(at[worst]),
                    )
                )
        return tuple(found)

    @property
    def reasons(self) -> tuple[str, ...]:
        """What :attr:`outside` says and :attr:`domain` does not."""
        return tuple(reason for reason in self.outside if reason not in self.domain.left)

    def rms(self, from_step: int = 0) -> dict[str, float]:
        """Root mean square of truth minus estimate, from instant `from_step` on.

        Raises
        ------
        SimulationError
            If no instant is left.
        """
        if not 0 <= from_step < len(self.t) - self.fault_delay:
            raise SimulationError(
                f"from_step={from_step} leaves no instant of 0..{len(self.t) - 1}.",
                from_step=from_step,
            )
        errors = {name: self[name].error[from_step:] for name in self.estimated}
        return {name: float(np.sqrt(np.mean(e**2))) for name, e in errors.items()}

    @cached_property
    def widths(self) -> dict[str, FloatArray]:
        """Half the length of each interval at every instant."""
        return {name: self[name].half_width for name in self.estimated}

    @cached_property
    def domain(self) -> Domain:
        """Whether truth and estimate stayed inside the box, and the status bits in words."""
        return Domain.of(self.x, self.xhat, self.box, self.status, self.names["x"])

    @property
    def kept(self) -> bool:
        """Whether the run kept the assumptions of the guarantee, as far as is known.

        Nothing left its range or broke a declared bound, and the observer was never void.
        """
        return self.domain.ok and not self.outside and not self.domain.refuted

    def summary(self, from_step: int = 0) -> Table:
        """Coverage, rms error and half widths of every estimated signal; first alarms.

        Coverage of a signal without bounds is ``n/a``. Below stands what left its range, where
        the observer was void, and which signals were outside their intervals.
        """
        rms = self.rms(from_step)
        rows: list[list[Any]] = []
        for name in self.estimated:
            trace, width = self[name], self.widths[name]
            ends = float(width[0]), float(width[-1])
            rows.append([trace.label, covered([self], name), rms[name], *ends])
            if self.alarm is not None:
                raised = None if trace.alarm is None else np.flatnonzero(trace.alarm)
                first = None if raised is None or not raised.size else float(trace.t[raised[0]])
                rows[-1].append(first)
        since = f", rms from k = {from_step}" if from_step else ""
        title = f"{self.scenario}, seed {self.seed}, {len(self.t)} instants{since}"
        columns = ["signal", "inside", "rms error", "half width at k = 0", "at the end"]
        columns += [] if self.alarm is None else ["first alarm [s]"]
        said = (*self.outside, *list_voids(self.domain.voids), *self.violations)
        note = "; ".join(map(str, said))
        return Table(title, columns, rows, note=note)

    def to_xarray(self) -> Any:
        """Return an ``xarray.Dataset`` with labelled dimensions and units.

        Variables are those of the run; dimensions are ``time`` and ``state``,
        ``fault``, ``output``, ``input``, ``unknown_input``, ``disturbance``,
        ``scheduling``; units stand in coordinates such as ``state_unit``.
        """
        attrs = {
            "model": self.model,
            "scenario": self.scenario,
            "seed": self.seed,
            "method": self.method,
            "truth": self.truth,
            "outside_guarantee": "; ".join(self.outside),
            "fault_delay": self.fault_delay,
        }
        return to_dataset(self, attrs)

    def plot(self, signals: tuple[str, ...] | None = None) -> Any:
        """Plot all estimated signals in a grid; see :func:`obsynth.evaluate.plot_run`."""
        from obsynth.evaluate.plotting.plots import plot_run

        return plot_run(self, signals)

    def __repr__(self) -> str:
        found = [self.coverage[name] for name in self.bounded]
        inside = f"inside at {percent(min(found))} or more" if found else "without set bounds"
        return (
            f"<Run of {self.method} on {self.model!r}, {self.scenario}, seed {self.seed}, "
            f"{len(self.t)} instants, {inside}>"
        )

    def _repr_html_(self) -> str:
        # What the note of the table says of ranges and voids stands in the lists below it.
        table = replace(self.summary(), note="; ".join(map(str, self.violations)))
        outside = "Outside the guarantee:" if self.reasons else ""
        return card("", table, f"Truth: {self.truth}.", outside, self.reasons, self.domain)


def _bounds(trace: Trace) -> tuple[FloatArray, FloatArray]:
    if trace.lower is None or trace.upper is None:
        raise SimulationError(f"{trace.name} has no interval.", symbol=trace.name)
    return trace.lower, trace.upper


def covered(runs: Sequence[Run], name: str) -> str:
    """Write the smallest coverage of a signal; ``n/a`` where the method does not bound it."""
    found = [run.coverage[name] for run in runs if name in run.bounded]
    return percent(min(found)) if found else "n/a"


def percent(fraction: float) -> str:
    """Write a fraction as per cent; never 100 % when one instant is missing."""
    if fraction == 1.0:
        return "100 %"
    return f"{np.floor(fraction * 1e4) / 1e2:.2f} %"


@takes(runs="dict")
def coverage_table(runs: Mapping[str, Sequence[Run]]) -> Table:
    """Tabulate the coverage of all signals for every scenario, design and seed.

    Parameters
    ----------
    runs : mapping of design label to runs

    Returns
    -------
    Table
        With a last column that says whether the run kept the assumptions of the
        guarantee, which is what makes its coverage a test of it.
    """
    names, rows = _tabulated(runs, apart=True)
    return Table(
        "Coverage",
        ["scenario", "design", "seed", *names, "assumptions kept"],
        rows,
        note="Fraction of all instants, the first included, at which the truth is inside its "
        "interval; counted at tolerance zero.",
    )


def coverage_summary(runs: Mapping[str, Sequence[Run]]) -> Table:
    """Tabulate the smallest coverage over the seeds, one row for each scenario and design."""
    names, rows = _tabulated(runs, apart=False)
    return Table(
        "Inside the guaranteed interval, smallest over the seeds",
        ["scenario", "design", "seeds", *names, "assumptions kept"],
        rows,
    )


def _tabulated(
    runs: Mapping[str, Sequence[Run]], apart: bool
) -> tuple[tuple[str, ...], list[list[Any]]]:
    """Return the signals and a row for every run, or for all of a scenario and design."""
    groups: dict[tuple[str, str, int], list[Run]] = {}
    for label, several in runs.items():
        for run in several:
            groups.setdefault((run.scenario, label, apart * len(groups)), []).append(run)
    order = list(dict.fromkeys(scenario for scenario, *_ in groups))
    names = next(iter(groups.values()))[0].estimated if groups else ()
    rows = [
        [
            scenario,
            label,
            group[0].seed if apart else len(group),
            *(covered(group, name) for name in names),
            all(run.kept for run in group),
        ]
        for (scenario, label, _), group in sorted(
            groups.items(), key=lambda g: order.index(g[0][0])
        )
    ]
    return names, rows
