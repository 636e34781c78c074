"""Rows of a campaign: what is kept of one run, in files that are whole or not there."""

import hashlib
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.designs.core.files import write_whole
from obsynth.designs.core.observer import STATUS, Observer
from obsynth.designs.detection.detector import FaultDetector
from obsynth.evaluate.data.tables import write_columns
from obsynth.evaluate.errors import ReportError, SimulationError
from obsynth.evaluate.run import Run
from obsynth.evaluate.simulate import simulate
from obsynth.evaluate.trace import Trace
from obsynth.symbolic import ObsynthError, Plant, Scenario
from obsynth.symbolic.arrays import FloatArray

Row = dict[str, Any]
KEYS = ("design", "scenario", "truth", "seed")
_PLAN = "campaign.json"


@dataclass(frozen=True, eq=False)
class Job:
    """Some runs of one design in one scenario against one truth."""

    design: str
    scenario: str
    truth: str
    seeds: tuple[int, ...]
    observer: Observer | FaultDetector
    plant: Plant
    given: Scenario
    substeps: int | None

    @property
    def keys(self) -> list[tuple[str, str, str, int]]:
        """What tells the runs apart."""
        return [(self.design, self.scenario, self.truth, seed) for seed in self.seeds]

    def run(self) -> list[Row]:
        """Return a row for every run; one that is refused says why."""
        return [dict(zip(KEYS, key, strict=True)) | self._facts(key[-1]) for key in self.keys]

    def _facts(self, seed: int) -> Row:
        start = time.perf_counter()
        try:
            run = simulate(self.plant, self.observer, self.given, seed, substeps=self.substeps)
        except ObsynthError as error:
            return {"refused": str(error), "kept": False, "seconds": time.perf_counter() - start}
        return {"refused": "", **facts(run), "seconds": time.perf_counter() - start}


def facts(run: Run) -> Row:
    """Return what is kept of a run, by the names of its signals."""
    found: dict[str, Any] = {
        "instants": len(run.t),
        "kept": run.kept,
        "outside": "; ".join(run.outside),
        **{name: int(np.sum(run.status & bit > 0)) for name, bit in STATUS.items()},
    }
    late = len(run.t) // 2
    for name in run.estimated:
        trace = run[name]
        half = trace.half_width[late:]
        found |= {
            f"{name}: bounded": trace.bounded,
            f"{name}: missed": int(np.sum(~trace.inside)),
            f"{name}: half width": float(np.mean(half)),
            f"{name}: widest": float(np.max(half)),
            f"{name}: rms error": float(np.sqrt(np.mean(trace.error[late:] ** 2))),
        }
        if trace.alarm is not None:
            found |= {f"{name}: {key}": value for key, value in _alarms(trace).items()}
    return found


def _alarms(trace: Trace) -> dict[str, float]:
    """Return instants from the fault to its alarm, and those with an alarm before any fault."""
    alarm = np.zeros(len(trace.t), dtype=bool) if trace.alarm is None else trace.alarm
    there = np.flatnonzero(trace.true != 0.0)
    first = int(there[0]) if there.size else len(alarm)
    raised = np.flatnonzero(alarm[first:])
    delay = float(raised[0]) if raised.size else (np.inf if there.size else np.nan)
    return {"delay": delay, "false alarms": int(np.sum(alarm[:first]))}


def fingerprint(jobs: Sequence[Job]) -> dict[str, str]:
    """Return SHA-256 of the designs, scenarios and truths of a campaign, by what they are called.

    Functions of a scenario are told apart by their samples.
    """
    found: dict[str, Any] = {}
    for job in jobs:
        found[f"design {job.design}"] = job.observer.step.serialize()
        found[f"truth {job.truth}"] = [job.plant.to_dict(), job.substeps]
        key = f"scenario {job.scenario}, {job.truth}"
        if key not in found:
            arrays = job.given.arrays(job.plant, seed=0)
            start = {"x0": job.given.x0, "guess": job.given.guess}
            found[key] = {k: _told(v) for k, v in (arrays | start).items()}
    return {key: hashlib.sha256(json.dumps(v).encode()).hexdigest() for key, v in found.items()}


def _told(array: FloatArray | None) -> str:
    whole = b"" if array is None else np.ascontiguousarray(array).tobytes()
    return hashlib.sha256(whole).hexdigest()


class Parts:
    """The folder of a campaign; rows stay in memory where there is none."""

    def __init__(self, folder: Path | None, plan: Mapping[str, str]) -> None:
        self.folder = folder
        self.rows: dict[tuple[Any, ...], Row] = {}
        if folder is None:
            return
        folder.mkdir(parents=True, exist_ok=True)
        known = folder / _PLAN
        if known.is_file():
            self._same(json.loads(known.read_text(encoding="utf-8")), plan)
        elif any(folder.iterdir()):
            raise ReportError(
                f"{str(folder)!r} holds something that is no campaign: give a folder of its own.",
                path=str(folder),
            )
        write_whole(known, json.dumps(dict(plan), indent=1) + "\n")
        for path in sorted(folder.glob("part-*.parquet")):
            self._read(path)

    def _same(self, before: Mapping[str, str], plan: Mapping[str, str]) -> None:
        other = [key for key, value in plan.items() if before.get(key, value) != value]
        if other:
            raise SimulationError(
                f"the campaign in {str(self.folder)!r} was run with another {other[0]}: give "
                "another folder, or what it was begun with.",
                path=str(self.folder),
            )

    def _read(self, path: Path) -> None:
        from pyarrow import parquet

        for row in parquet.read_table(path).to_pylist():
            self.rows[tuple(row[key] for key in KEYS)] = row

    def left(self, job: Job) -> tuple[int, ...]:
        """Return the seeds of a job that are not there."""
        pairs = zip(job.keys, job.seeds, strict=True)
        return tuple(seed for key, seed in pairs if key not in self.rows)

    def add(self, rows: Sequence[Row]) -> None:
        """Keep rows, in a file of their own."""
        new = {tuple(row[key] for key in KEYS): row for row in rows}
        self.rows.update(new)
        if self.folder is not None and rows:
            names = dict.fromkeys(name for row in rows for name in row)
            columns = {name: np.array([row.get(name) for row in rows]) for name in names}
            told = hashlib.sha256(repr(sorted(new)).encode()).hexdigest()[:16]
            write_columns(self.folder / f"part-{told}.parquet", columns)
