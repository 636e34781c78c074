"""What choosing gives: one row for everything tried, the recommended observer, and why."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from obsynth.designs.core.observer import Observer
from obsynth.designs.detection.comparison import find_voids
from obsynth.evaluate.choosing.tries import Try
from obsynth.evaluate.data.estimated import Estimate
from obsynth.evaluate.plotting.layout import BARS, INK, SOFT, name_lines, new_figure, style
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import BoolArray, FloatArray, IntArray
from obsynth.symbolic.shown import card, folded
from obsynth.symbolic.table import Table, text

NEAR = 1.05
"""What is wider by less than this counts as as narrow; the cheapest of them is recommended."""
EMPTY = 0.95
"""Of a half range: what is as wide says hardly anything."""


@dataclass(frozen=True, eq=False, repr=False)
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

    @cached_property
    def made(self) -> tuple[Try, ...]:
        """The tries that gave an observer."""
        return tuple(one for one in self.tries if one.observer is not None)

    @property
    def names(self) -> tuple[str, ...]:
        """States, then faults."""
        return (*self.model.names("x"), *self.model.names("f"))

    @cached_property
    def _counted(self) -> IntArray:
        return np.array([self.names.index(name) for name in self.criterion], dtype=np.int64)

    @cached_property
    def _declared(self) -> FloatArray:
        """Half of the declared ranges, infinite (or 0, of a point) where there is none."""
        boxes = np.vstack([self.model.box("x"), self.model.box("f").reshape(-1, 2)])
        half: FloatArray = 0.5 * np.diff(boxes, axis=1)[:, 0]
        return half

    @cached_property
    def _units(self) -> FloatArray:
        """Half of the declared ranges; the narrowest that was found where there is none."""
        least = np.min([_settled(one) for one in (*self.made, self.kalman)], axis=0)
        half = np.where(_usable(self._declared), self._declared, least)
        return np.where(_usable(half), half, 1.0)

    @property
    def _unit(self) -> str:
        """What the widths of the criterion are shares of, in words."""
        ranged = _usable(self._declared[self._counted])
        if ranged.all():
            return "half range"
        return "half range or narrowest found" if ranged.any() else "narrowest found"

    def online(self, one: Try) -> FloatArray:
        """Return the mean half widths of the second half of the run, as shares, (n + n_f,)."""
        return _settled(one) / self._units

    def guaranteed(self, one: Try) -> FloatArray:
        """Return the guaranteed steady half widths as shares, infinite where there are none."""
        told = one.observer.half_widths
        return np.full(len(self.names), np.inf) if told is None else told / self._units

    @property
    def shares(self) -> dict[str, dict[str, dict[str, float]]]:
        """By observer, ``run`` and ``guaranteed``, and signal: the shares as numbers."""
        told = {"run": self.online, "guaranteed": self.guaranteed}
        return {
            one.name: {
                kind: dict(zip(self.names, share(one).tolist(), strict=True))
                for kind, share in told.items()
            }
            for one in self.made
        }

    def score(self, one: Try) -> float:
        """Return the criterion: the smaller, the better."""
        return float(np.mean(self.online(one)[self._counted]))

    def transient(self, one: Try) -> int:
        """Return from which call on no counted width is a tenth above the settled ones."""
        half = one.half_widths[:, self._counted]
        wide = ~(half <= 1.1 * half[len(half) // 2 :].max(axis=0)).all(axis=1)
        return int(np.flatnonzero(wide)[-1]) + 1 if wide.any() else 0

    def says_nothing(self, one: Try) -> bool:
        """Whether no counted interval is narrower than its declared range, or hardly."""
        boxes = np.vstack([self.model.box("x"), self.model.box("f").reshape(-1, 2)])
        known = np.isfinite(boxes).all(axis=1) & (self.online(one) >= EMPTY)
        return bool(known[self._counted].all())

    @cached_property
    def _allowed(self) -> list[Try]:
        """What may be recommended: finite intervals that missed nothing, within the budget."""
        most = np.inf if self.budget is None else self.budget
        kept = [one for one in self.made if one.operations <= most and not one.missed]
        return [one for one in kept if np.isfinite(self.score(one))]

    @cached_property
    def best(self) -> Try | None:
        """The recommended try: the cheapest of those within 5 per cent of the narrowest.

        Where these say nothing of what counts, of those narrowest over all states and faults.
        """
        near = _nearest(self._allowed, self.score)
        if all(map(self.says_nothing, near)):
            near = _nearest(near, lambda one: float(np.mean(self.online(one))))
        return min(near, key=lambda one: one.operations, default=None)

    @property
    def recommended(self) -> Observer | None:
        """The recommended observer, or None."""
        return None if self.best is None else self.best.observer

    @property
    def reason(self) -> str:
        """Why this one, or why none."""
        best, spoken = self.best, ", ".join(self.criterion)
        if not self.made:
            return "Nothing is recommended: no method gives a certified observer."
        if best is None:
            least = min(self.made, key=lambda one: one.operations)
            return (
                f"Nothing is recommended: no observer has finite intervals of {spoken} within the "
                f"budget; {least.name} has the fewest operations, {least.operations}."
            )
        first = min(self._allowed, key=self.score)
        why = "the narrowest" + ("" if self.budget is None else " within the budget")
        if best is not first:
            narrow = text(self.score(first), 3)
            why = f"within 5 % of {first.name} ({narrow}, {first.operations} operations)"
        said = (
            f"{best.name} is recommended: half widths of {spoken} are "
            f"{text(self.score(best), 3)} of the {self._unit} in the mean, {why}, at "
            f"{best.operations} operations a step."
        )
        said += " Its intervals of faults hold means over time." if best.means else ""
        if isinstance(best.run, Estimate):
            verdict = best.run.verdict
            said += f" {verdict[0].upper()}{verdict[1:]}."
        if self.says_nothing(best):
            said += " They say hardly more than the declared ranges."
        others = ", ".join(o.name for o in self.made if o is not best and self.says_nothing(o))
        return said + (f" Hardly more than is declared is told by {others}." if others else "")

    def _row(self, one: Try) -> list[Any]:
        """Return the row of a try in the table."""
        if one.run is None:
            return [one.name, False, None, None, None, None, one.seconds, one.reason]
        said = ["recommended"] if one is self.best else []
        said += ["its faults are means over time"] if one.means else []
        if one.missed or (one.missed == 0 and one is self.kalman):
            said.append(f"misses {100 * one.missed:.3g} % of the instants")
        voids = sum(void.count for void in find_voids(one.run.status))
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
        run: Any = self.kalman.run
        title = f"Half width / {self._unit} of {', '.join(self.criterion)}, {run.scenario}, "
        title += f"{len(run.t)} instants"
        marked = [i for i, one in enumerate(self.tries) if one is self.best]
        return Table(title, columns, rows, self.reason, marked)

    @property
    def widths(self) -> Table:
        """The shares of every state and fault: in the run, and guaranteed in brackets.

        Observers are the rows, or the columns where there are fewer observers than signals.
        """

        def cell(now: float, ever: float) -> str:
            return text(now, 3) + (f" ({text(ever, 3)})" if np.isfinite(ever) else "")

        shown = (*self.made, self.kalman)
        observers = [*(one.name for one in self.made), "Kalman, no guarantee"]
        cells = [map(cell, self.online(one), self.guaranteed(one)) for one in shown]
        rows = [[name, *row] for name, row in zip(observers, cells, strict=True)]
        columns = ["observer", *self.names]
        if len(observers) < len(self.names):
            columns, *rows = map(list, zip(columns, *rows, strict=True))
            columns[0] = "signal"
        note = (
            "Means of the second half of the run (guaranteed once settled, which may take longer "
            "than the run); without a range, / the narrowest."
        )
        return Table("Half width / half range of every state and fault", columns, rows, note)

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
        """Draw a row for every signal: dots in the run, rings guaranteed, crosses for the filter.

        Returns the axes, those given or of a new figure.
        """
        rows, share = np.arange(len(self.names)), 0.5 / (len(self.made) + 1)
        with style():
            height = 1.0 + 0.4 * len(rows) + 0.17 * (len(self.made) + 1)
            ax = new_figure(height).subplots() if ax is None else ax
            for i, one in enumerate(self.made):
                at, color = rows + share * (i + 1) - 0.25, BARS[i % len(BARS)]
                label = f"{one.name} (recommended)" if one is self.best else one.name
                ax.plot(self.online(one), at, "o", color=color, markersize=4, label=label)
                ax.plot(self.guaranteed(one), at, "o", color=color, fillstyle="none")
            ax.plot(self.online(self.kalman), rows, "x", color=INK, label="Kalman, no guarantee")
            ax.axvline(1.0, color=SOFT, linewidth=0.8)
            ax.set_xscale("log")
            ax.set_yticks(rows, self.names)
            ax.invert_yaxis()
            ax.set_xlabel("half width / half range (dots: in the run, rings: guaranteed)")
            name_lines([ax], ax)
        return ax

    def __repr__(self) -> str:
        return f"<Choice for {self.model.name!r}: {self.reason}>"

    def __str__(self) -> str:
        return f"{self.table}\n\n{self.widths}"

    def _repr_html_(self) -> str:
        assumed = folded("Assumptions", self.assumptions)
        return card(f"Observers for {self.model.name}", self.table, self.widths, assumed)


def _usable(half: FloatArray) -> BoolArray:
    """Return which half ranges can be divided by."""
    usable: BoolArray = np.isfinite(half) & (half > 0)
    return usable


def _settled(one: Try) -> FloatArray:
    half = one.half_widths
    settled: FloatArray = half[len(half) // 2 :].mean(axis=0)
    return settled


def _nearest(tries: Sequence[Try], score: Callable[[Try], float]) -> list[Try]:
    """Return what is at most 5 per cent wider than the narrowest."""
    least = min(map(score, tries), default=np.inf)
    return [one for one in tries if score(one) <= NEAR * least]
