"""What choosing gives: one row for everything tried, the recommended observer, and why."""

import html
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from obsynth.designs.core.observer import Observer
from obsynth.evaluate.choosing.tries import Try
from obsynth.evaluate.table import Table, text
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray, IntArray

NEAR = 1.05
"""What is wider by less than this counts as as narrow; the cheapest of them is recommended."""
EMPTY = 0.95
"""Of a half range: what is as wide says hardly anything."""


@dataclass(frozen=True, eq=False)
class Choice:
    """Every method on one plant, what it guarantees and what it showed in one common run.

    Attributes
    ----------
    model : Plant
        The discrete plant.
    criterion : tuple of str
        States and faults whose half widths, as shares of the declared half ranges (of the
        narrowest that was found where there is none), are averaged.
    budget : int or None
        Operations that a step may take.
    tries : tuple of Try
        Of each method ``name``, ``observer`` (None where it was refused), ``run``, ``reason``,
        ``seconds``, ``operations``, ``missed``.
    kalman : Try
        The extended Kalman filter: three sigma, without guarantee.
    """

    model: Plant
    criterion: tuple[str, ...]
    budget: int | None
    tries: tuple[Try, ...]
    kalman: Try

    @property
    def made(self) -> tuple[Try, ...]:
        """The tries that gave an observer."""
        return tuple(one for one in self.tries if one.observer is not None)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """States, then faults."""
        return (*self.model.names("x"), *self.model.names("f"))

    @cached_property
    def _counted(self) -> IntArray:
        return np.array([self.names.index(name) for name in self.criterion], dtype=np.int64)

    @cached_property
    def _ranges(self) -> FloatArray:
        """Half of the declared ranges, infinite where there is none."""
        boxes = np.vstack([self.model.box("x"), self.model.box("f").reshape(-1, 2)])
        half: FloatArray = 0.5 * np.diff(boxes, axis=1)[:, 0]
        return np.where(half > 0, half, np.inf)

    @cached_property
    def _units(self) -> FloatArray:
        least = np.min([_settled(one) for one in (*self.made, self.kalman)], axis=0)
        half = np.where(np.isfinite(self._ranges), self._ranges, least)
        return np.where(np.isfinite(half) & (half > 0), half, 1.0)

    def online(self, one: Try) -> FloatArray:
        """Return the mean half widths of the second half of the run, as shares, (n + n_f,)."""
        return _settled(one) / self._units

    def guaranteed(self, one: Try) -> FloatArray:
        """Return the guaranteed steady half widths as shares, infinite where there are none."""
        told = one.observer.half_widths
        return np.full(len(self.names), np.inf) if told is None else told / self._units

    def score(self, one: Try) -> float:
        """Return the criterion: the smaller, the better."""
        return float(np.mean(self.online(one)[self._counted]))

    def transient(self, one: Try) -> int:
        """Return from which call on no counted width is a tenth above the settled ones."""
        half = one.half_widths[:, self._counted]
        wide = ~(half <= 1.1 * half[len(half) // 2 :].max(axis=0)).all(axis=1)
        return int(np.flatnonzero(wide)[-1]) + 1 if wide.any() else 0

    @cached_property
    def _allowed(self) -> list[Try]:
        """What may be recommended: finite intervals that missed nothing, within the budget."""
        most = np.inf if self.budget is None else self.budget
        kept = [one for one in self.made if _operations(one) <= most and not one.missed]
        return [one for one in kept if np.isfinite(self.score(one))]

    @cached_property
    def best(self) -> Try | None:
        """The recommended try: the cheapest of those within 5 per cent of the narrowest.

        Where these say nothing of what counts, of those narrowest over all states and faults.
        """
        near = _nearest(self._allowed, self.score)
        if all(map(self._says_nothing, near)):
            near = _nearest(near, lambda one: float(np.mean(self.online(one))))
        return min(near, key=_operations, default=None)

    @property
    def recommended(self) -> Observer | None:
        """The recommended observer, or None."""
        return None if self.best is None else self.best.observer

    @cached_property
    def reason(self) -> str:
        """Why this one, or why none."""
        best, spoken = self.best, ", ".join(self.criterion)
        if best is None:
            if not self.made:
                return "Nothing is recommended: no method gives a certified observer."
            least = min(self.made, key=_operations)
            return (
                f"Nothing is recommended: no observer has finite intervals of {spoken} within the "
                f"budget; {least.name} has the fewest operations, {least.operations}."
            )
        narrowest = min(self._allowed, key=self.score)
        if best is narrowest:
            why = "the narrowest of what was tried"
        else:
            share = text(self.score(narrowest), 3)
            why = f"within 5 % of {narrowest.name} ({share}, {narrowest.operations} operations)"
        said = (
            f"{best.name} is recommended: its intervals of {spoken} are "
            f"{text(self.score(best), 3)} of the half range in the mean, {why}, at "
            f"{best.operations} operations a step."
        )
        if self._says_nothing(best):
            said += " They say hardly more than the declared ranges."
        others = [o.name for o in self.made if o is not best and self._says_nothing(o)]
        if others:
            said += f" Hardly more than is declared is told by {', '.join(others)}."
        return said

    def _says_nothing(self, one: Try) -> bool:
        """Whether no counted interval is narrower than its declared range, or hardly."""
        known = np.isfinite(self._ranges)[self._counted]
        return bool(np.all(known & (self.online(one)[self._counted] >= EMPTY)))

    def _row(self, one: Try) -> list[Any]:
        """Return the row of a try in the table."""
        if one.run is None:
            return [one.name, False, None, None, None, None, one.seconds, one.reason]
        said = ["recommended"] if one is self.best else []
        said += ["its faults are means over time"] if one.means else []
        missed = one.missed or (one.missed == 0 and one is self.kalman)
        said += [f"misses {100 * (one.missed or 0):.3g} % of the instants"] if missed else []
        voids = sum(void.count for void in one.run.domain.voids)
        said += [f"void at {voids} calls, which contradicts the assumptions"] if voids else []
        counted = float(self.guaranteed(one)[self._counted].mean())
        numbers = [self.score(one), counted, self.transient(one), one.operations, one.seconds]
        return [one.name, True, *numbers, "; ".join(said)]

    @property
    def table(self) -> Table:
        """One row for everything tried."""
        rows = [self._row(one) for one in self.tries]
        name, _, score, _, call, count, _, said = self._row(self.kalman)
        rows.append([name, "no guarantee", score, None, call, count, None, said])
        columns = ["observer", "certified", "in the run", "guaranteed", "settled at call"]
        columns += ["operations", "design [s]", "remark"]
        run = self.kalman.run
        where = "" if run is None else f", {run.scenario}, {len(run.t)} instants"
        title = f"Half width / half range of {', '.join(self.criterion)}{where}"
        marked = [i for i, one in enumerate(self.tries) if one is self.best]
        return Table(title, columns, rows, self.reason, marked)

    @property
    def widths(self) -> Table:
        """The shares of every state and fault: in the run, and guaranteed in brackets."""
        shown = [*zip(*map(self._cells, (*self.made, self.kalman)), strict=True)]
        rows = [[name, *cells] for name, cells in zip(self.names, shown, strict=True)]
        columns = ["signal", *(one.name for one in self.made), "Kalman, no guarantee"]
        note = "Half width / half range: mean of the second half of the run (guaranteed)"
        note += "" if np.isfinite(self._ranges).all() else "; without a range, / the narrowest"
        return Table("Every state and fault", columns, rows, note)

    def _cells(self, one: Try) -> list[str]:
        pairs = zip(self.online(one), self.guaranteed(one), strict=True)
        return [
            text(float(a), 3) + (f" ({text(float(b), 3)})" if np.isfinite(b) else "")
            for a, b in pairs
        ]

    @property
    def assumptions(self) -> Table:
        """What the guarantees of all observers rest on."""
        told: dict[str, list[str]] = {}
        for one in self.made:
            for said in one.observer.guarantee.assumptions:
                told.setdefault(said, []).append(one.name)
        rows = [[said, ", ".join(names)] for said, names in told.items()]
        return Table("Assumptions", ["what is assumed", "by"], rows)

    def plot(self, ax: Any = None) -> Any:
        """Draw half width / half range of every signal and observer; returns the axes."""
        from obsynth.evaluate.plotting.choice import plot_choice

        return plot_choice(self, ax)

    def __str__(self) -> str:
        return f"{self.table}\n\n{self.widths}"

    def _repr_html_(self) -> str:
        name, assumed = html.escape(self.model.name), self.assumptions._repr_html_()
        return (
            f"<p><b>Observers for {name}</b></p>{self.table._repr_html_()}"
            f"{self.widths._repr_html_()}<details><summary>Assumptions</summary>{assumed}</details>"
        )


def _settled(one: Try) -> FloatArray:
    half = one.half_widths
    settled: FloatArray = half[len(half) // 2 :].mean(axis=0)
    return settled


def _operations(one: Try) -> float:
    return one.operations or 0


def _nearest(tries: Sequence[Try], score: Callable[[Try], float]) -> list[Try]:
    """Return what is at most 5 per cent wider than the narrowest."""
    least = min(map(score, tries), default=np.inf)
    return [one for one in tries if score(one) <= NEAR * least]
