"""The scalars in which a design is not convex: bisection, line search, nearest feasible value."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
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
    """

    value: float
    result: Result
    objective: float
    tried: tuple[tuple[float, float], ...]


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


def search_scale(
    design: Callable[[float], Result],
    objective: Callable[[Result], float],
    low: float,
    high: float,
    *,
    rtol: float = 0.005,
    most: int = 40,
) -> Search[Result]:
    """Minimise a positive objective with one minimum between positive ends, to some share of it."""
    from scipy.optimize import minimize_scalar

    record = _Record(design, objective)

    def size(logarithm: float) -> float:
        return float(np.log(record.measure(float(np.exp(logarithm)))))

    options = {"xatol": rtol, "maxiter": most}
    with np.errstate(invalid="ignore"):
        minimize_scalar(size, bounds=np.log([low, high]), method="bounded", options=options)
    if record.best is None:
        raise record.refusal(f"no value between {low:.4g} and {high:.4g} gives a design")
    value, least, result = record.best
    return Search(value, result, least, tuple(record.tried))


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


def _refine(measure: Callable[[float], float], low: float, high: float, steps: int) -> None:
    """Golden sections of [low, high], one evaluation per step."""
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_left, at_right = measure(left), measure(right)
    for _ in range(steps - 2):
        if at_left <= at_right:
            high, right, at_right = right, left, at_left
            left = high - _GOLDEN * (high - low)
            at_left = measure(left)
        else:
            low, left, at_left = left, right, at_right
            right = low + _GOLDEN * (high - low)
            at_right = measure(right)
