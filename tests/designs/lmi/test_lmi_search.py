"""Bisection, line search, the smallest change that helps."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

from obsynth.designs.core.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.lmi import search
from obsynth.designs.lmi.search import (
    Knob,
    bisect_feasible,
    search_line,
    search_log_convex,
    smallest_changes,
)
from obsynth.symbolic.errors import ObsynthError


@pytest.mark.parametrize("logarithmic", [False, True])
def test_bisection_brackets_the_limit_with_few_evaluations(logarithmic):
    limit = 0.00903
    found = bisect_feasible(lambda g: g <= limit, 1e-5, 0.2, rtol=1e-4, logarithmic=logarithmic)
    assert found.feasible <= limit < found.infeasible
    assert found.infeasible - found.feasible <= 1e-4 * found.infeasible
    assert found.evaluations < 40


def test_bisection_knows_both_ends():
    assert bisect_feasible(lambda g: True, 0.0, 1.0).feasible == 1.0
    assert bisect_feasible(lambda g: True, 0.0, 1.0).infeasible is None
    assert bisect_feasible(lambda g: False, 0.0, 1.0) is None
    # From below and from above.
    found = bisect_feasible(lambda g: g >= 3.0, 10.0, 0.0, rtol=1e-5)
    assert found.feasible == pytest.approx(3.0, rel=1e-4) and found.feasible >= 3.0
    with pytest.raises(ObsynthError, match="positive"):
        bisect_feasible(lambda g: True, 0.0, 1.0, logarithmic=True)


def test_a_limit_at_zero_ends():
    found = bisect_feasible(lambda g: g <= 0.0, 0.0, 1.0, rtol=1e-3)
    assert found.feasible == 0.0 and found.evaluations < 40


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


def test_a_log_convex_objective_is_searched_with_a_bound_of_what_is_left():
    fine = min(lyapunov_trace(g) for g in np.linspace(1e-3, 0.35, 20001))
    found = search_log_convex(lyapunov_trace, float, 0.0, 1.0, rtol=1e-4)
    assert fine * (1 - 1e-6) <= found.objective <= fine * (1 + 1e-4)
    assert found.objective * (1 - 1e-4) <= found.lower_bound <= fine * (1 + 1e-9)
    assert len(found.tried) < 40


def test_a_bound_that_is_too_high_would_be_seen(monkeypatch):
    """A bound that takes the best value tried for the optimum stops at once, above the truth."""

    def overconfident(record, low, high):
        return 0.0 if record.best is None else record.best[1]

    monkeypatch.setattr(search, "_lower_bound", overconfident)
    found = search_log_convex(lyapunov_trace, float, 0.0, 1.0, rtol=1e-4)
    fine = min(lyapunov_trace(g) for g in np.linspace(1e-3, 0.35, 2001))
    assert found.lower_bound > fine * 1.001


def test_an_objective_that_is_not_log_convex_is_refused():
    with pytest.raises(ObsynthError, match="not log-convex") as caught:
        search_log_convex(lambda g: np.exp(-20.0 * (g - 0.45) ** 2), float, 0.0, 1.0)
    assert caught.value.tried


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
