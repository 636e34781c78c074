"""The way from inequalities to values that can be proved.

Phase 1 maximises the margin t of the strict blocks and refuses where there is none; phase 2
minimises the objective with a small part of t kept as margin; the result is moved towards the
phase 1 point until the proof goes through.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.designs.core.errors import CertificateError, InfeasibleDesign, SolverTrouble
from obsynth.designs.lmi.conic import Solution
from obsynth.designs.lmi.expression import Inequality, scalar
from obsynth.designs.lmi.problem import Problem
from obsynth.designs.lmi.proof import Binding, MarginBound, binding_blocks, bound_margin
from obsynth.designs.lmi.solve import LazySolution, solve_lazily, solve_with_retries

Values = Mapping[str, NDArray[np.float64]]

_MARGIN = "margin.t"

# Below this the margin is no more than the accuracy of a solver.
_LEAST_MARGIN = 1e-9

# An answer that the solver does not call solved serves if it is within this of the optimum and
# violates nothing by more than a back-off repairs: the proof decides, not the solver.
_GAP = 1e-4

# The largest share of the phase 1 point that is mixed in.
_BACK_OFF = 0.3

# The largest violation of a solver's answer, as a share of the margin, that a back-off repairs.
_REPAIRABLE = 1e-2


@dataclass(frozen=True, eq=False)
class Margin:
    """The largest margin of a set of inequalities.

    value: largest t with every strict block >= t I, within the caps (at most 1)
    binding, bound: blocks and vertices that limit it, and what exact arithmetic says of it
    found: where it was found
    """

    value: float
    binding: tuple[Binding, ...]
    bound: MarginBound | None
    found: LazySolution

    @property
    def feasible(self) -> bool:
        """Whether the margin is more than a solver's accuracy."""
        return self.value > _LEAST_MARGIN

    def lines(self) -> list[str]:
        """Sentences for a report."""
        text = [f"largest margin: {self.value:.3g} (smallest eigenvalue over all blocks)"]
        if self.binding:
            text.append("binding: " + "; ".join(str(binding) for binding in self.binding))
        if self.bound is not None:
            sizes = [np.abs(value).max() for value in self.found.solution.values.values()]
            size = 1e3 * max(1.0, *sizes)
            excluded = self.bound.size_excluded
            if excluded > size:
                text.append(f"exact arithmetic: no solution with entries below {excluded:.3g}")
            else:
                text.append(
                    f"exact arithmetic: with entries below {size:.3g} no margin above "
                    f"{self.bound.at(size):.3g}"
                )
        return text


@dataclass(frozen=True, eq=False)
class MarginSolution:
    """Values that passed the proof, and how they came about.

    back_off: share of the phase 1 point mixed in
    chosen: vertices stated in phase 2, by family
    proof: what ``prove`` returned for the values
    """

    values: Values
    objective: float
    back_off: float
    chosen: Mapping[str, NDArray[np.intp]]
    proof: Any

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        return self.values[name]


def largest_margin(
    problem: Problem, *, caps: Mapping[str, Inequality] | None = None, explain: bool = True
) -> Margin:
    """Phase 1: the largest t with every strict block >= t I, measured at the point found."""
    t = scalar(_MARGIN)
    first = problem.tightened(t)
    first.add("margin.limit", t <= 1.0)
    for name, cap in (caps or {}).items():
        first.add(name, cap)
    first.maximise(t)
    found = solve_lazily(first, floor=_phase_one_floor, solve=_phase_one)
    value = _measured(found.problem, found.solution)
    binding: tuple[Binding, ...] = ()
    bound = None
    if explain and value <= _LEAST_MARGIN:
        binding = binding_blocks(found.problem, found.solution, found.chosen)
        bound = bound_margin(found.problem, found.solution, _MARGIN)
    return Margin(value, binding, bound, found)


def solve_with_margin(
    problem: Problem, *, prove: Callable[[Values], Any], fraction: float = 1e-4
) -> MarginSolution:
    """Phase 1, phase 2, back-off and proof."""
    margin = largest_margin(problem)
    if not margin.feasible:
        raise InfeasibleDesign(
            f"{problem.name}: the inequalities leave no room",
            margin.lines(),
            margin=margin.value,
            binding=margin.binding,
            bound=margin.bound,
        )
    kept = fraction * margin.value
    inner = margin.found.solution.values
    second = _phase_two(problem, kept, margin)
    outer = second.solution.values
    proof: Any = None
    for share in _shares(_lowest(second.problem, second.solution) + kept, margin.value):
        values = {
            name: (1.0 - share) * outer[name] + share * inner[name]
            for name in second.problem.variables
        }
        proof = prove(values)
        if proof.all_proved:
            return MarginSolution(
                values=values,
                objective=problem.evaluate(values),
                back_off=share,
                chosen=second.chosen,
                proof=proof,
            )
    raise CertificateError(
        f"{problem.name}: solved with margin {margin.value:.3g}, but not proved",
        [f"even {100 * _BACK_OFF:.0f} % of the way back to the point of largest margin"],
        margin=margin.value,
        proof=proof,
    )


def _shares(lowest: float, margin: float) -> list[float]:
    """Shares of the phase 1 point to try, from what the violation calls for upwards."""
    violation = max(-lowest, 0.0)
    share = max(1.1 * violation / (margin + violation), 1e-8)
    shares = [] if violation else [0.0]
    while share < _BACK_OFF:
        shares.append(share)
        share *= 3.0
    return [*shares, _BACK_OFF]


def _phase_one(problem: Problem) -> Solution:
    return solve_with_retries(problem, good_enough=lambda s: _measured(problem, s) > _LEAST_MARGIN)


def _nearly_optimal(problem: Problem, solution: Solution, margin: float) -> bool:
    return solution.gap < _GAP and _lowest(problem, solution) > -_REPAIRABLE * margin


def _measured(problem: Problem, solution: Solution) -> float:
    """Smallest eigenvalue of the strict blocks at a point, their margin added back."""
    return float(solution.values[_MARGIN].item()) + _lowest(problem, solution)


def _lowest(problem: Problem, solution: Solution) -> float:
    """Smallest eigenvalue of the strict blocks as stated."""
    lowest = np.inf
    for item in problem.blocks.values():
        if item.asks_margin:
            matrices = solution.value(item.expression)
            lowest = min(lowest, float(np.linalg.eigvalsh(matrices).min()))
    return lowest


def _phase_one_floor(problem: Problem, solution: Solution) -> float:
    """Half the margin may be lost at vertices that are not stated; without one, stop."""
    least = float(solution.values[_MARGIN].item())
    return -0.5 * least if least > _LEAST_MARGIN else -np.inf


def _phase_two(problem: Problem, kept: float, margin: Margin) -> LazySolution:
    if not problem.objective.terms:
        return margin.found
    try:
        return solve_lazily(
            problem.tightened(kept),
            start=margin.found.chosen,
            # No vertex is left much worse than the solver leaves those it knows.
            floor=lambda stated, solution: min(-2.0 * kept, 1.5 * _lowest(stated, solution)),
            solve=lambda stated: solve_with_retries(
                stated, good_enough=lambda s: _nearly_optimal(stated, s, margin.value)
            ),
        )
    except InfeasibleDesign as trouble:
        raise SolverTrouble(
            f"{problem.name}: infeasible with {kept:.3g} of a margin of {margin.value:.3g}",
            ["the constraints are badly scaled: scale the unknowns"],
            margin=margin.value,
        ) from trouble
