"""What is kept of one run of a campaign: a row of numbers."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.designs.core.observer import STATUS, Observer
from obsynth.designs.detection.detector import FaultDetector
from obsynth.evaluate.run import Run
from obsynth.evaluate.simulate import simulate
from obsynth.evaluate.trace import Trace
from obsynth.symbolic import ObsynthError, Plant, Scenario

Row = dict[str, Any]
KEYS = ("design", "scenario", "truth", "seed")


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
