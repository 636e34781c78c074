"""`campaign`: what a design is worth over many runs, on one machine or several."""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.designs.core.observer import Observer
from obsynth.designs.detection.detector import FaultDetector
from obsynth.evaluate.campaigns.parts import Job, Parts, Row, fingerprint
from obsynth.evaluate.errors import SimulationError
from obsynth.evaluate.progress import bar
from obsynth.evaluate.run import percent
from obsynth.evaluate.simulate import instants
from obsynth.evaluate.truth import Truth
from obsynth.symbolic import ObsynthError, Plant, Scenario
from obsynth.symbolic.table import Table, Tabled
from obsynth.symbolic.taking import takes

_TOGETHER = 200_000
"""Instants of the runs that are one piece of work."""
_LEVEL = 0.95

Designs = Observer | FaultDetector | Mapping[str, Observer | FaultDetector]


@dataclass(frozen=True, eq=False, repr=False)
class Campaign(Tabled):
    """Rows of runs, and what they say together.

    Attributes
    ----------
    rows : tuple of mappings
        One for every run: ``design``, ``scenario``, ``truth``, ``seed``, ``refused``, ``instants``,
        ``kept`` (whether the assumptions held), counts of status bits, and of every signal s
        ``"s: missed"`` (instants outside its interval), ``"s: half width"`` and ``"s: rms error"``
        (means over the second half), ``"s: widest"``; of a detector's faults ``"s: delay"`` (in
        instants; infinite without an alarm, no number without a fault) and ``"s: false alarms"``.
    signals : tuple of str
    """

    rows: tuple[Row, ...]
    signals: tuple[str, ...]

    @property
    def groups(self) -> dict[tuple[str, str, str], list[Row]]:
        """The rows by design, scenario and truth."""
        found: dict[tuple[str, str, str], list[Row]] = {}
        for row in self.rows:
            found.setdefault((row["design"], row["scenario"], row["truth"]), []).append(row)
        return found

    def table(self) -> Table:
        """Tabulate coverage and widths, a row for every design, scenario and truth.

        ``held`` are the runs in which no interval missed its signal, of those that kept the
        assumptions, with the interval in which the probability of that is, at 95 % confidence
        (Clopper and Pearson): the runs are independent, the instants of one run are not.
        """
        head = ["design", "scenario", "truth", "runs", "kept", "held", "from", "to"]
        rows: list[list[Any]] = []
        for key, group in self.groups.items():
            kept = [row for row in group if row["kept"]]
            held = sum(not any(self._missed(row)) for row in kept)
            low, high = interval(held, len(kept))
            widths = [
                _mean(row.get(f"{name}: half width") for row in group) for name in self.signals
            ]
            share = "n/a" if not kept else percent(held / len(kept))
            rows.append([*key, len(group), len(kept), share, low, high, *widths])
        names = [f"half width of {name}" for name in self.signals]
        refused = sum(bool(row["refused"]) for row in self.rows)
        note = f"{refused} runs were refused. " if refused else ""
        return Table(
            "Campaign",
            [*head, *names],
            rows,
            note=f"{note}Held: runs without a single instant outside, and where the probability of "
            "that is at 95 % confidence; half widths are means over the second halves.",
        )

    def __repr__(self) -> str:
        return f"<Campaign: {len(self.rows)} runs in {len(self.groups)} groups>"

    def alarms(self) -> Table:
        """Tabulate alarms of detectors: false ones, and how long a fault was there before one."""
        rows: list[list[Any]] = []
        for key, group in self.groups.items():
            for name in self.signals:
                told = [row for row in group if f"{name}: delay" in row]
                delays = np.array([row[f"{name}: delay"] for row in told], dtype=float)
                delays = delays[~np.isnan(delays)]
                false = sum(row[f"{name}: false alarms"] > 0 for row in told)
                if told:
                    found = delays[np.isfinite(delays)]
                    middle = float(np.median(found)) if found.size else None
                    most = float(found.max()) if found.size else None
                    counts = f"{found.size} of {delays.size}"
                    rows.append([*key, name, len(told), false, counts, middle, most])
        columns = ["design", "scenario", "truth", "fault", "runs", "with false alarms", "found"]
        return Table("Alarms", [*columns, "median delay", "longest delay"], rows)

    def _missed(self, row: Row) -> Iterator[int]:
        return (row[f"{s}: missed"] for s in self.signals if row.get(f"{s}: bounded"))

    def to_frame(self) -> Any:
        """Return the rows as a pandas.DataFrame."""
        import pandas as pd

        return pd.DataFrame(list(self.rows))


def interval(successes: int, trials: int) -> tuple[float, float]:
    """Return the Clopper-Pearson interval of a probability at 95 % confidence."""
    from scipy.stats import binomtest

    if trials == 0:
        return 0.0, 1.0
    found = binomtest(successes, trials).proportion_ci(_LEVEL, method="exact")
    return float(found.low), float(found.high)


@takes(designs="Observer FaultDetector dict")
def campaign(
    designs: Designs,
    scenarios: Scenario | Sequence[Scenario],
    seeds: int | Iterable[int] = 20,
    *,
    truth: Plant | Mapping[str, Plant] | None = None,
    substeps: int | None = None,
    folder: str | os.PathLike[str] | None = None,
    client: Any = None,
    workers: int = -1,
) -> Campaign:
    """Run designs through scenarios over seeds and truths.

    Parameters
    ----------
    designs : Observer or FaultDetector, or mapping of label to them
        Steps run in double precision, see `simulate`.
    scenarios : Scenario or sequence of them
        Told apart by their names.
    seeds : int or iterable of int
        Of the disturbances; a number n stands for 0..n-1.
    truth : Plant, or mapping of label to Plant, optional
        What is simulated: the design's own model by default, plants with other parameters.
    substeps : int, optional
        See `simulate`.
    folder : path, optional
        Where rows are written as Parquet while it runs (needs pyarrow); what is there already is
        not run again, so that a campaign that was interrupted goes on.
    client : dask.distributed.Client, optional
        Runs on its workers; by default in processes of this machine.
    workers : int
        Processes of this machine, -1: as many as there are cores.

    Returns
    -------
    Campaign

    Raises
    ------
    SimulationError
        If two scenarios have one name, or the folder holds a campaign of other designs, scenarios
        or truths. A run that is refused is a row that says why.

    Examples
    --------
    >>> import obsynth as ob
    >>> plant = ob.plants.cruise_control().discretise("euler", Ts=0.1)
    >>> observer = ob.BoundedErrorUIO(bounds="peak").design(plant)
    >>> found = campaign(observer, ob.scenarios.gentle(plant), seeds=3, workers=1)
    >>> len(found.rows), sum(row["f: missed"] for row in found.rows)
    (3, 0)
    """
    jobs = _jobs(_labelled(designs), scenarios, seeds, truth, substeps)
    parts = Parts(None if folder is None else Path(folder), fingerprint(jobs))
    todo = [piece for job in jobs for piece in _pieces(replace(job, seeds=parts.left(job)))]
    wanted = [key for job in jobs for key in job.keys]
    for job in {(job.design, job.truth): job for job in todo}.values():
        # so that processes find it compiled instead of all compiling it
        same = [j for j in todo if (j.design, j.truth) == (job.design, job.truth)]
        with suppress(ObsynthError):  # a run that is refused says so itself
            pair = Truth(job.plant, job.observer, job.substeps)
            instants(pair, job.observer, sum((j.given.steps + 1) * len(j.seeds) for j in same))
    with bar() as say:
        for rows in _here(todo, workers) if client is None else _there(todo, client):
            parts.add(rows)
            done = sum(key in parts.rows for key in wanted)
            say(f"{done} of {len(wanted)} runs", done / len(wanted))
    names = dict.fromkeys(
        signal.name for job in jobs for kind in "xf" for signal in getattr(job.observer.model, kind)
    )
    return Campaign(tuple(parts.rows[key] for key in wanted), tuple(names))


def _labelled(designs: Designs) -> dict[str, Observer | FaultDetector]:
    return dict(designs) if isinstance(designs, Mapping) else {designs.method: designs}


def _jobs(
    designs: Mapping[str, Observer | FaultDetector],
    scenarios: Scenario | Sequence[Scenario],
    seeds: int | Iterable[int],
    truth: Plant | Mapping[str, Plant] | None,
    substeps: int | None,
) -> list[Job]:
    several = [scenarios] if isinstance(scenarios, Scenario) else list(scenarios)
    names = [scenario.name for scenario in several]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise SimulationError(f"two scenarios are called {twice!r}: give them names of their own.")
    numbers = tuple(range(seeds) if isinstance(seeds, int) else map(int, seeds))
    if not (designs and several and numbers):
        raise SimulationError("a campaign needs a design, a scenario and a seed at least.")
    found = []
    for label, observer in designs.items():
        given = truth if isinstance(truth, Mapping) else {"": truth or observer.model}
        found += [
            Job(label, scenario.name, named, numbers, observer, plant, scenario, substeps)
            for scenario in several
            for named, plant in given.items()
        ]
    return found


def _pieces(job: Job) -> list[Job]:
    """Divide a job into pieces of some hundred thousand instants."""
    size = max(1, _TOGETHER // (job.given.steps + 1))
    return [replace(job, seeds=job.seeds[k : k + size]) for k in range(0, len(job.seeds), size)]


def _here(jobs: Sequence[Job], workers: int) -> Iterator[Sequence[Row]]:
    from joblib import Parallel, delayed

    if len(jobs) < 2 or workers == 1:
        return (job.run() for job in jobs)
    parallel = Parallel(n_jobs=workers, return_as="generator_unordered")
    found: Iterator[Sequence[Row]] = parallel(delayed(_run)(job) for job in jobs)
    return found


def _there(jobs: Sequence[Job], client: Any) -> Iterator[Sequence[Row]]:
    """Run on the workers of Dask, which runs again what was on one that is gone."""
    from distributed import as_completed

    futures = [client.submit(_run, job, pure=False) for job in jobs]
    for future in as_completed(futures):
        yield future.result()


def _run(job: Job) -> Sequence[Row]:
    return job.run()


def _mean(values: Iterable[Any]) -> Any:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
