"""Bisection, line search, the smallest change that helps."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

from obsynth.designs.core.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.lmi.search import (
    Knob,
    bisect_feasible,
    search_line,
    search_scale,
    smallest_changes,
)
from obsynth.symbolic.errors import ObsynthError


@pytest.mark.parametrize("logarithmic", [False, True])
def test_bisection_brackets_the_limit_with_few_evaluations(logarithmic):
    limit, tried = 0.00903, []

    def feasible(g):
        tried.append(g)
        return g <= limit

    found = bisect_feasible(feasible, 1e-5, 0.2, rtol=1e-4, logarithmic=logarithmic)
    least = min(g for g in tried if g > limit)
    assert found == max(g for g in tried if g <= limit)
    assert least - found <= 1e-4 * least
    assert len(tried) < 40


def test_bisection_knows_both_ends():
    assert bisect_feasible(lambda g: True, 0.0, 1.0) == 1.0
    assert bisect_feasible(lambda g: False, 0.0, 1.0) is None
    # From below and from above.
    found = bisect_feasible(lambda g: g >= 3.0, 10.0, 0.0, rtol=1e-5)
    assert found == pytest.approx(3.0, rel=1e-4) and found >= 3.0
    with pytest.raises(ObsynthError, match="positive"):
        bisect_feasible(lambda g: True, 0.0, 1.0, logarithmic=True)


def test_a_limit_at_zero_ends():
    assert bisect_feasible(lambda g: g <= 0.0, 0.0, 1.0, rtol=1e-3) == 0.0


def design(value):
    if value > 0.8:
        raise InfeasibleDesign("no room")
    if value < 0.05:
        raise SolverTrouble("stuck")
    return value


def cost(value):
    return (value - 0.37) ** 2 + 1.0


def test_the_line_search_refines_around_the_best_value():
    grid = [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]
    found = search_line(design, cost, grid, refine=15)
    assert found.value == pytest.approx(0.37, abs=2e-3)
    assert found.result == found.value and found.objective == cost(found.value)
    assert len(found.tried) == len(grid) + 15
    assert dict(found.tried)[1.0] == float("inf")


def test_a_search_without_a_design_says_what_happened():
    """It is infeasible only where every value is. Mutant: infeasible whatever the troubles."""
    with pytest.raises(SolverTrouble, match="gamma") as caught:
        search_line(design, cost, [0.01, 0.9], name="gamma")
    assert "stuck" in str(caught.value) and "no room" in str(caught.value)
    with pytest.raises(InfeasibleDesign, match="gamma"):
        search_line(design, cost, [0.85, 0.9], name="gamma")


def lyapunov_trace(gamma):
    """Least trace of X >= A X A' / (1 - gamma) + I / gamma, log-convex in gamma."""
    A = np.array([[0.8, 0.3], [0.0, 0.7]]) / np.sqrt(1.0 - gamma)
    if np.abs(np.linalg.eigvals(A)).max() >= 1.0:
        raise InfeasibleDesign("unstable")
    return float(np.trace(solve_discrete_lyapunov(A, np.eye(2) / gamma)))


def test_one_minimum_is_found_next_to_values_without_a_design():
    """Mutant: the last value that was tried in place of the best."""
    fine = min(lyapunov_trace(g) for g in np.linspace(1e-3, 0.35, 20001))
    found = search_scale(lyapunov_trace, float, 0.1, 0.999)
    assert fine * (1 - 1e-6) <= found.objective <= fine * (1 + 1e-4)
    assert found.objective == min(objective for _, objective in found.tried)
    assert np.inf in dict(found.tried).values() and len(found.tried) < 25
    with pytest.raises(InfeasibleDesign, match="gives a design"):
        search_scale(lyapunov_trace, float, 0.5, 0.999)


@pytest.mark.parametrize("largest", [0.3, 0.003, 2e-4])
def test_designs_far_below_what_is_refused_are_found(largest):
    """Mutant: all that is refused as bad as all else that is."""

    def design(gamma):
        if gamma > largest:
            raise InfeasibleDesign("too large")
        return 1.0 / gamma + 1.0 / (1.01 * largest - gamma)

    found = search_scale(design, float, 1e-4, 1.0)
    assert found.objective < 1.01 * 4.0 / (1.01 * largest)


def test_changes_are_listed_and_what_does_not_help_is_said():
    lines = smallest_changes(
        [
            Knob("gamma", 0.01, 1e-4, lambda g: g < 0.00903),
            Knob("box of h3", 47.5, 0.0, lambda w: w < 30.0),
            Knob("noise", 0.1, 0.0, lambda w: False),
        ]
    )
    assert lines[0].startswith("gamma: 0.01 is infeasible, 0.00")
    assert "29." in lines[1]
    assert "does not enter feasibility" in lines[2]
