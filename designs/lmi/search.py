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
# above the logarithm of every double
_REFUSED = 1e4


def bisect_feasible(
    feasible: Callable[[float], bool],
    inside: float,
    outside: float,
    *,
    rtol: float = 1e-3,
    logarithmic: bool = False,
) -> float | None:
    """Return the feasible value closest to ``outside``, None where ``inside`` is not feasible."""
    if logarithmic and min(inside, outside) <= 0:
        raise ObsynthError(
            f"a logarithmic search needs positive ends, not {inside:.4g} and {outside:.4g}"
        )
    if feasible(outside):
        return outside
    if not feasible(inside):
        return None
    good, bad = inside, outside
    tiny = rtol * abs(outside - inside)
    while abs(bad - good) > max(rtol * max(abs(good), abs(bad)), 1e-3 * tiny):
        middle = (good * bad) ** 0.5 if logarithmic else 0.5 * (good + bad)
        if middle in (good, bad):
            break
        good, bad = (middle, bad) if feasible(middle) else (good, middle)
    return good


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
            lines.append(f"{knob.name}: {knob.current:.3g} is infeasible, {found:.3g} is feasible")
    return lines


class Search(Generic[Result]):
    """The best design along a line: the value, what the design returned there, its objective.

    tried: every value tried, in order, with its objective (inf where infeasible)
    """

    value: float
    result: Result

    def __init__(
        self, design: Callable[[float], Result], measured: Callable[[Result], float]
    ) -> None:
        self.design, self.measured, self.objective = design, measured, np.inf
        self.tried: list[tuple[float, float]] = []
        self.refusals: list[tuple[float, ObsynthError]] = []

    def measure(self, value: float) -> float:
        """Design at a value and return the objective, infinite where that is refused."""
        objective = np.inf
        try:
            result = self.design(value)
            objective = float(self.measured(result))
            if objective < self.objective:
                self.value, self.result, self.objective = value, result, objective
        except (InfeasibleDesign, SolverTrouble, CertificateError) as refusal:
            self.refusals.append((value, refusal))
        self.tried.append((value, objective))
        return objective

    def require(self, name: str, low: float, high: float) -> None:
        """Refuse a line without a design; it is infeasible only where every value is."""
        if self.objective < np.inf:
            return
        only = all(isinstance(refusal, InfeasibleDesign) for _, refusal in self.refusals)
        kind = InfeasibleDesign if only else SolverTrouble
        raise kind(
            f"{name}: no value between {low:.4g} and {high:.4g} gives a design",
            [f"{value:.4g}: {str(told).splitlines()[0]}" for value, told in self.refusals],
            tried=tuple(self.tried),
        )


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

    search = Search(design, objective)
    terminal = Console().is_terminal
    for value in track(grid, description=name, disable=not terminal, transient=True):
        search.measure(value)
    search.require(name, min(grid), max(grid))
    if refine:
        values = sorted(grid)
        place = values.index(search.value)
        low, high = values[max(place - 1, 0)], values[min(place + 1, len(values) - 1)]
        _refine(search.measure, low, high, refine)
    return search


def search_scale(
    design: Callable[[float], Result],
    objective: Callable[[Result], float],
    low: float,
    high: float,
    *,
    rtol: float = 0.005,
    name: str = "search",
) -> Search[Result]:
    """Minimise a positive objective with one minimum between positive ends, to some share of it.

    What is refused lies above what is not, so that it counts as the worse, the larger it is.
    """
    from scipy.optimize import minimize_scalar

    search = Search(design, objective)

    def height(logarithm: float) -> float:
        found = search.measure(float(np.exp(logarithm)))
        return float(np.log(found)) if found < np.inf else _REFUSED + logarithm

    minimize_scalar(
        height,
        bounds=np.log([low, high]),
        method="bounded",
        options={"xatol": rtol, "maxiter": 40},
    )
    search.require(name, low, high)
    return search


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
