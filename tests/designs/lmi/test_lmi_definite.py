"""What a solver hands back is accepted only where it is true."""

from dataclasses import replace

import numpy as np
import pytest

from obsynth.derive.rigour import (
    Enclosure,
    ExactMatrix,
    is_positive_definite,
    prove_positive_definite,
)
from obsynth.designs.lmi.expression import full, symmetric, trace
from obsynth.designs.lmi.problem import Problem, symmetric_block
from obsynth.designs.lmi.proof import _definite, _multipliers, inverse_bounds, prove_inverse


def decay_design():
    """A small family designed by the solver: rounded P, gain K, and the formula they obey."""
    rng = np.random.default_rng(5)
    n, m = 4, 2
    C = rng.normal(size=(m, n))
    family = 0.45 * rng.normal(size=(n, n)) + 0.03 * rng.normal(size=(16, n, n))
    P, H = symmetric("P", n), full("H", n, m)
    problem = Problem("decay")
    problem.add_lmi("decay", symmetric_block([[0.3 * P], [P @ family - H @ C, P]]), ">>")
    problem.add("floor", P >> np.eye(n))
    problem.minimise(trace(P))
    solution = problem.solve()
    P_value = solution["P"]
    K = np.linalg.solve(P_value, solution["H"])

    def enclosed(matrix):
        Pe = Enclosure.of(matrix)
        X = Pe @ Enclosure.of(family) - (Pe @ Enclosure.of(K)) @ Enclosure.of(C)
        return symmetric_block([[0.3 * Pe], [X, Pe]])

    return P_value, enclosed


def test_solver_outputs_with_planted_violations_are_refused():
    P, enclosed = decay_design()
    blocks = enclosed(P)
    eigenvalues, vectors = np.linalg.eigh(blocks.mid)
    for k in range(len(blocks.mid)):
        direction = vectors[k, :, :1]
        # Push the smallest eigenvalue of one vertex to -1e-9, and the same the other way.
        planted = blocks.mid.copy()
        push = direction @ direction.T * (eigenvalues[k, 0] + 1e-9)
        planted[k] -= 0.5 * (push + push.T)
        result = prove_positive_definite(planted, blocks.rad)
        assert not result.proved[k]
        repaired = blocks.mid.copy()
        push = direction @ direction.T * (eigenvalues[k, 0] - 1e-9)
        repaired[k] -= 0.5 * (push + push.T)
        assert prove_positive_definite(repaired, blocks.rad).proved[k]


def test_a_solution_on_the_boundary_is_accepted_only_where_it_is_true():
    P, enclosed = decay_design()
    blocks = enclosed(P)
    proved = prove_positive_definite(blocks).proved
    exact = np.array([is_positive_definite(0.5 * (m + m.T)) for m in blocks.mid])
    assert not np.any(proved & ~exact)
    # The optimum sits on the boundary: the solver's answer is no proof of all vertices.
    assert not proved.all()


@pytest.mark.timeout(60)
def test_a_multiplier_that_is_singular_is_moved_until_it_is_definite():
    """Mutant: a shift to the wrong side, which never ends."""
    for dual in (np.diag([1.0, 0.0]), np.ones((3, 3)), np.diag([2.0, -1e-9]), np.eye(2)):
        moved = _definite(dual, 0.0)
        assert is_positive_definite(moved)
        assert np.abs(moved - dual).max() <= 3e-9


def test_a_dual_solution_with_a_number_missing_proves_nothing():
    """Mutant: one finite entry is enough."""
    P = symmetric("P", 2)
    problem = Problem("both")
    problem.add("floor", P >> np.eye(2))
    problem.add("cap", P << 3.0 * np.eye(2))
    problem.minimise(trace(P))
    solution = problem.solve()
    assert set(_multipliers(problem, solution)) == {"floor", "cap"}
    spoiled = solution.duals["cap"].copy()
    spoiled.flat[0] = np.nan
    assert (
        _multipliers(problem, replace(solution, duals={**solution.duals, "cap": spoiled})) is None
    )


@pytest.mark.parametrize("seed", range(4))
def test_what_an_inverse_makes_of_rows_is_bounded_from_above_alone(seed):
    """Mutant: the row of the corner block times .99, which proves numbers that are too small."""
    rng = np.random.default_rng(seed)
    root, rows = rng.normal(size=(3, 3)), np.vstack([np.eye(3), rng.normal(size=(2, 3))])
    P = root @ root.T + 0.1 * np.eye(3)
    P, exact = 0.5 * (P + P.T), ExactMatrix.of(rows)
    values = (exact @ ExactMatrix.of(0.5 * (P + P.T)).inverse() @ exact.T).to_fractions()
    least = np.array([float(values[i][i]) for i in range(5)])
    bounds = inverse_bounds(P, rows)
    assert all(bounds[i] >= values[i][i] for i in range(5))
    assert np.all(bounds <= least * (1.0 + 1e-6))
    holds, margin = prove_inverse(P, rows, bounds)
    assert holds and margin > 0.0
    for i in range(5):
        short = np.where(np.arange(5) == i, least * (1.0 - 1e-9), bounds)
        assert not prove_inverse(P, rows, short)[0]
