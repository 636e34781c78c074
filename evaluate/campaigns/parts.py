"""Rows of a campaign in a folder: a file for some runs, whole or not there; read on resuming."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.designs.core.files import write_whole
from obsynth.evaluate.campaigns.facts import KEYS, Job, Row
from obsynth.evaluate.data.tables import write_columns
from obsynth.evaluate.errors import ReportError, SimulationError
from obsynth.symbolic.arrays import FloatArray

_PLAN = "campaign.json"


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
