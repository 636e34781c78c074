"""The scalars in which a design is not convex: bisection, line search, nearest feasible value."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Generic, TypeVar

import numpy as np

from obsynth.designs.core.errors import CertificateError, InfeasibleDesign, SolverTrouble
from obsynth.symbolic.errors import ObsynthError

Result = TypeVar("Result")

_GOLDEN = (5.0**0.5 - 1.0) / 2.0


@dataclass(frozen=True)
class Bisection:
    """The limit of feasibility along a line; infeasible None if all of it is feasible."""

    feasible: float
    infeasible: float | None
    evaluations: int


def bisect_feasible(
    feasible: Callable[[float], bool],
    inside: float,
    outside: float,
    *,
    rtol: float = 1e-3,
    logarithmic: bool = False,
) -> Bisection | None:
    """Find the feasible value closest to ``outside``."""
    if logarithmic and min(inside, outside) <= 0:
        raise ObsynthError(
            f"a logarithmic search needs positive ends, not {inside:.4g} and {outside:.4g}"
        )
    if feasible(outside):
        return Bisection(outside, None, 1)
    if not feasible(inside):
        return None
    good, bad, count = inside, outside, 2
    tiny = rtol * abs(outside - inside)
    while abs(bad - good) > max(rtol * max(abs(good), abs(bad)), 1e-3 * tiny):
        middle = (good * bad) ** 0.5 if logarithmic else 0.5 * (good + bad)
        if middle in (good, bad):
            break
        good, bad = (middle, bad) if feasible(middle) else (good, middle)
        count += 1
    return Bisection(good, bad, count)


@dataclass(frozen=True)
class Knob:
    """One scalar that could be changed to make a design feasible, in the words of the user.

    current, limit: a value at which the design is infeasible, and as far as it may be changed
    feasible: whether the design is feasible at a value, all else being equal
    """

    name: str
    current: float
    limit: float
    feasible: Callable[[float], bool]


def smallest_changes(knobs: Sequence[Knob], rtol: float = 0.01) -> list[str]:
    """Say for each scalar how far it has to move, or that it does not help."""
    lines = []
    for knob in knobs:
        found = bisect_feasible(knob.feasible, knob.limit, knob.current, rtol=rtol)
        if found is None:
            way = "down to" if knob.limit < knob.current else "up to"
            lines.append(
                f"{knob.name}: does not enter feasibility; infeasible from "
                f"{knob.current:.3g} {way} {knob.limit:.3g}"
            )
        else:
            lines.append(
                f"{knob.name}: {knob.current:.3g} is infeasible, {found.feasible:.3g} is feasible"
            )
    return lines


@dataclass(frozen=True, eq=False)
class Search(Generic[Result]):
    """The best design along a line: the value, what the design returned there, its objective.

    tried: every value tried, in order, with its objective (inf where infeasible)
    lower_bound: what no value of the line can be below; 0 where only a grid speaks
    """

    value: float
    result: Result
    objective: float
    tried: tuple[tuple[float, float], ...]
    lower_bound: float = 0.0


def search_line(
    design: Callable[[float], Result],
    objective: Callable[[Result], float],
    grid: Sequence[float],
    *,
    refine: int = 0,
    name: str = "search",
) -> Search[Result]:
    """Design at every value of a grid, then refine around the best by golden sections."""
    from rich.console import Console
    from rich.progress import track

    record = _Record(design, objective)
    terminal = Console().is_terminal
    for value in track(grid, description=name, disable=not terminal, transient=True):
        record.measure(value)
    if record.best is None:
        raise record.refusal(
            f"{name}: no value between {min(grid):.4g} and {max(grid):.4g} gives a design"
        )
    if refine:
        values = sorted(grid)
        place = values.index(record.best[0])
        low, high = values[max(place - 1, 0)], values[min(place + 1, len(values) - 1)]
        _refine(record.measure, low, high, refine)
    value, least, result = record.best
    return Search(value, result, least, tuple(record.tried))


def search_log_convex(
    design: Callable[[float], Result],
    objective: Callable[[Result], float],
    low: float,
    high: float,
    *,
    rtol: float = 1e-3,
    most: int = 40,
) -> Search[Result]:
    """Minimise a log-convex objective along a line; chords say when to stop."""
    record = _Record(design, objective)

    def left_over() -> float:
        return _lower_bound(record, low, high)

    def enough() -> bool:
        return record.best is not None and left_over() >= (1.0 - rtol) * record.best[1]

    _refine(record.measure, low, high, most, enough)
    if record.best is None:
        raise record.refusal(f"no value between {low:.4g} and {high:.4g} gives a design")
    _require_log_convex(record, rtol)
    value, least, result = record.best
    return Search(value, result, least, tuple(record.tried), min(left_over(), least))


def _require_log_convex(record: _Record[Result], rtol: float) -> None:
    points = sorted((v, m) for v, m in record.tried if np.isfinite(m))
    for (a, at_a), (x, at_x), (b, at_b) in zip(points, points[1:], points[2:], strict=False):
        share = (x - a) / (b - a)
        chord = at_a ** (1.0 - share) * at_b**share
        if at_x > (1.0 + rtol) * chord:
            raise ObsynthError(
                f"the objective is not log-convex: it is {at_x:.6g} at {x:.4g}, but {at_a:.6g} at "
                f"{a:.4g} and {at_b:.6g} at {b:.4g} allow {chord:.6g} at most",
                tried=tuple(record.tried),
            )


def _lower_bound(record: _Record[Result], low: float, high: float) -> float:
    """Return what chords of log-convex values leave as the least value on [low, high]."""
    points = sorted((v, float(np.log(m))) for v, m in record.tried if np.isfinite(m))
    if len(points) < 2:
        return 0.0
    infeasible = [v for v, m in record.tried if not np.isfinite(m)]
    low = max([low, *(v for v in infeasible if v < points[0][0])])
    high = min([high, *(v for v in infeasible if v > points[-1][0])])
    slopes = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in pairwise(points)]
    least = np.inf
    for k in range(len(points) + 1):
        left = low if k == 0 else points[k - 1][0]
        right = high if k == len(points) else points[k][0]
        # left of the gap and right of it, a chord continued into the gap lies below
        lines = []
        if k >= 2:
            lines.append((points[k - 1], slopes[k - 2]))
        if k <= len(points) - 2:
            lines.append((points[k], slopes[k]))
        corners = {left, right}
        if len(lines) == 2 and lines[0][1] != lines[1][1]:
            (p, a), (q, b) = lines
            corners.add((q[1] - p[1] + a * p[0] - b * q[0]) / (a - b))
        heights = [
            max((p[1] + a * (x - p[0]) for p, a in lines), default=-np.inf)
            for x in corners
            if left <= x <= right
        ]
        least = min([least, *heights])
    return float(np.exp(least))


class _Record(Generic[Result]):
    """Everything tried so far and the best of it."""

    def __init__(
        self, design: Callable[[float], Result], objective: Callable[[Result], float]
    ) -> None:
        self.design, self.objective = design, objective
        self.tried: list[tuple[float, float]] = []
        self.troubles: list[str] = []
        self.best: tuple[float, float, Result] | None = None
        self.all_infeasible = True

    def measure(self, value: float) -> float:
        """Design at a value and return the objective, infinite where that is refused."""
        measured = np.inf
        try:
            result = self.design(value)
            measured = float(self.objective(result))
            if self.best is None or measured < self.best[1]:
                self.best = (value, measured, result)
        except (InfeasibleDesign, SolverTrouble, CertificateError) as refusal:
            self.troubles.append(f"{value:.4g}: {str(refusal).splitlines()[0]}")
            self.all_infeasible &= isinstance(refusal, InfeasibleDesign)
        self.tried.append((value, measured))
        return measured

    def refusal(self, headline: str) -> InfeasibleDesign | SolverTrouble:
        """Say that nothing was found; infeasible only where every value was."""
        kind = InfeasibleDesign if self.all_infeasible else SolverTrouble
        return kind(headline, self.troubles, tried=tuple(self.tried))


def _refine(
    measure: Callable[[float], float],
    low: float,
    high: float,
    steps: int,
    enough: Callable[[], bool] = lambda: False,
) -> None:
    """Golden sections of [low, high], one evaluation per step."""
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_left, at_right = measure(left), measure(right)
    for _ in range(steps - 2):
        if enough():
            return
        if at_left <= at_right:
            high, right, at_right = right, left, at_left
            left = high - _GOLDEN * (high - low)
            at_left = measure(left)
        else:
            low, left, at_left = left, right, at_right
            right = low + _GOLDEN * (high - low)
            at_right = measure(right)
