"""Where a contradiction between a record, a plant and bounds lies."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from obsynth.evaluate.bounds.boxes import enclose
from obsynth.evaluate.bounds.certified import Least, least
from obsynth.evaluate.bounds.linear import assemble
from obsynth.evaluate.bounds.problem import Problem
from obsynth.symbolic import Record
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.shown import Shown, card
from obsynth.symbolic.table import Table

WIDER = 1e3
"""Up to how many times its bound a disturbance that is freed is looked for."""


@dataclass(frozen=True, eq=False, repr=False)
class Attribution(Shown):
    """What of a record contradicts bounds, four ways of saying where.

    scale: certified and attained: the factor of the bounds that explains the whole record. Above 1
        the bounds are refuted
    first: index of the first instant up to which the record contradicts the bounds for certain;
        None where it does not
    before, after: certified and attained factor up to the instant before the first, and up to it;
        of the whole record where there is none
    excess (N, n_w): by how much disturbances are past their bounds, least in sum: a share of the
        blame
    alone: for every disturbance the factor of all others where it is free; among those that need no
        more than 1, its own factor with all others at their bounds
    """

    scale: tuple[float, float]
    first: int | None
    before: tuple[float, float]
    after: tuple[float, float]
    excess: FloatArray
    alone: Table
    record: Record
    names: tuple[str, ...]

    @property
    def blamed(self) -> Table:
        """Disturbances by what they are past their bounds in sum, with the first instant."""
        rows: list[list[Any]] = []
        for j, name in enumerate(self.names):
            when = np.flatnonzero(self.excess[:, j] > 1e-9)
            if len(when):
                total = float(self.excess[:, j].sum())
                rows.append([name, len(when), float(self.record.time[when[0]]), total])
        rows.sort(key=lambda row: -float(row[3]))
        return Table(
            "Past the bounds, least in sum",
            ["disturbance", "instants", "first at [s]", "in sum"],
            rows,
            note="Where a fault or a part of the model is missing shows in the row that it is "
            "missing from.",
        )

    def __str__(self) -> str:
        return f"{self._sentence}\n{self.blamed}\n{self.alone}"

    def _repr_html_(self) -> str:
        return card("", self._sentence, self.blamed, self.alone)

    @property
    def _sentence(self) -> str:
        if self.first is None:
            return f"The bounds times {self.scale[1]:.4g} explain the record."
        return (
            f"The record contradicts the bounds for certain from t = "
            f"{self.record.time[self.first]:g} s on: up to it they would have to be "
            f"{self.after[0]:.4g} times as large, up to the instant before {self.before[1]:.4g}."
        )


def attribute(problem: Problem, record: Record, bounds: FloatArray) -> Attribution:
    """Look for what contradicts bounds of the groups."""
    scaled = problem.scaled(bounds)
    whole = _scale(scaled)
    first, before, after = None, whole, whole
    if whole.lower > 1.0:
        first, before, after = _first(scaled, whole)
    return Attribution(
        (whole.lower, whole.upper),
        first,
        (before.lower, before.upper),
        (after.lower, after.upper),
        _excess(problem, bounds),
        _alone(scaled),
        record,
        problem.plant.names("w"),
    )


def _scale(problem: Problem) -> Least:
    """Return the factor of the bounds; more is done for it only where it may decide."""
    found = least(problem, np.ones(1), contractions=0)
    return least(problem, np.ones(1)) if found.lower <= 1.0 < found.upper else found


def _first(problem: Problem, whole: Least) -> tuple[int, Least, Least]:
    """Return the first instant up to which one factor is certified to be above 1, by bisection."""
    low, high = 0, len(problem) - 1
    found = {high: whole}
    while high - low > 1:
        k = (low + high) // 2
        found[k] = _scale(problem.window(0, k + 1))
        low, high = (low, k) if found[k].lower > 1.0 else (k, high)
    if low not in found:
        found[low] = _scale(problem.window(0, low + 1))
    return high, found[low], found[high]


def _excess(problem: Problem, bounds: FloatArray) -> FloatArray:
    """Return what disturbances are past bounds, (N, n_w)."""
    wide = WIDER * bounds
    boxes = enclose(problem, wide)
    if boxes.empty is not None:
        return np.full((len(problem), len(problem.group)), np.inf)
    return assemble(problem, boxes, wide).elastic(bounds)


def _alone(scaled: Problem) -> Table:
    """Return what is left to the others where one disturbance is free."""
    rows = []
    for j, name in enumerate(scaled.plant.names("w")):
        if scaled.group[j] != 0 or scaled.shape[j] == 0.0:
            continue
        group = scaled.group + (scaled.group > 0)
        group[j] = 1
        apart = replace(scaled, groups=("scale", "own"), group=group)
        top = np.array([np.inf, WIDER])
        others = least(apart, np.array([1.0, 0.0]), top)
        own = None
        if others.upper <= 1.0:
            own = least(apart, np.array([0.0, 1.0]), np.array([1.0, np.inf])).upper
        rows.append([name, others.upper, others.lower, own])
    return Table(
        "One disturbance free",
        ["free", "factor of the others", "certified", "its own factor"],
        rows,
        note="What leaves the others at most 1 with the least factor of its own explains the "
        "record best.",
    )
