"""The cap of the gain holds for what is computed from the solution, and binds where it should."""

import numpy as np
import pytest

from obsynth.designs.lmi.expression import full, symmetric
from obsynth.designs.lmi.problem import Problem, cap_gain, symmetric_block


def design(cap):
    A = np.array([[0.9, 0.4, 0.0], [0.0, 0.8, 0.3], [0.1, 0.0, 0.95]])
    C = np.array([[1.0, 0.0, 0.0]])
    P, H = symmetric("P", 3), full("H", 3, 1)
    problem = Problem("capped")
    rows = [[0.8 * P], [0, np.eye(3)], [P @ A - H @ C, 0.1 * P, P]]
    problem.add("decay", symmetric_block(rows) >> 0)
    cap(problem, P, H)
    problem.minimise_trace_inverse(P)
    solution = problem.solve()
    return solution, np.linalg.solve(solution["P"], solution["H"])


def test_the_gain_stays_below_its_cap_at_a_price():
    free, gain = design(lambda problem, P, H: None)
    largest = np.linalg.norm(gain, 2)
    limit = 0.9 * largest
    capped, smaller = design(lambda problem, P, H: cap_gain(problem, P, H, limit))
    assert np.linalg.norm(smaller, 2) <= limit * (1 + 1e-6) < largest
    assert capped.objective > free.objective * (1 + 1e-4)


def test_a_cap_that_is_wide_changes_nothing():
    free, gain = design(lambda problem, P, H: None)
    limit = 100.0 * np.linalg.norm(gain, 2)
    wide, _ = design(lambda problem, P, H: cap_gain(problem, P, H, limit))
    assert wide.objective == pytest.approx(free.objective, rel=1e-5)
