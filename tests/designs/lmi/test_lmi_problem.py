"""Problems solved directly and through cvxpy, and what happens when they are not solved."""

import numpy as np
import pytest

from obsynth.designs.core.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.lmi.expression import ExpressionError, full, scalar, symmetric, trace
from obsynth.designs.lmi.problem import Problem, block, he, symmetric_block


def scherer_gahinet_chilali() -> Problem:
    """Example 7 of IEEE TAC 42(7) 1997: H-infinity output feedback, change of variables."""
    A = np.array([[0.0, 10.0, 2.0], [-1.0, 1.0, 0.0], [0.0, 2.0, -5.0]])
    B1, B2 = np.array([[1.0], [0.0], [1.0]]), np.array([[0.0], [1.0], [0.0]])
    C1, C2 = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0]])
    D12, D21 = np.array([[0.0], [1.0]]), np.array([[2.0]])
    X, Y, gamma = symmetric("X", 3), symmetric("Y", 3), scalar("gamma")
    An, Bn, Cn, Dn = full("An", 3, 3), full("Bn", 3, 1), full("Cn", 1, 3), full("Dn", 1, 1)
    problem = Problem("example 7")
    problem.add("coupling", block([[X, np.eye(3)], [np.eye(3), Y]]) >> 0)
    rows = [
        [he(A @ X + B2 @ Cn)],
        [An + (A + B2 @ Dn @ C2).T, he(Y @ A + Bn @ C2)],
        [(B1 + B2 @ Dn @ D21).T, (Y @ B1 + Bn @ D21).T, -gamma * np.eye(1)],
        [C1 @ X + D12 @ Cn, C1 + D12 @ Dn @ C2, D12 @ Dn @ D21, -gamma * np.eye(2)],
    ]
    problem.add_lmi("bounded real", symmetric_block(rows), "<<")
    problem.minimise(gamma)
    return problem


def test_scherer_gahinet_chilali_1997_example_7():
    assert scherer_gahinet_chilali().solve().objective == pytest.approx(9.508101, abs=1e-5)


def random_problem(kind: str) -> Problem:
    rng = np.random.default_rng(7)
    n, m = 4, 2
    A, C = 0.5 * rng.normal(size=(n, n)), rng.normal(size=(m, n))
    family = A + 0.05 * rng.normal(size=(6, n, n))
    P, H, t = symmetric("P", n), full("H", n, m), scalar("t")
    X = P @ family - H @ C
    problem = Problem(kind)
    problem.add_lmi("decay", symmetric_block([[0.95 * P], [X, P]]), ">>", margin=1e-3)
    problem.add("cap", P << 10.0 * np.eye(n))
    problem.add("entries", H <= 2.0)
    problem.add_equality("tie", H[0, 0] - H[1, 1] - 0.1)
    if kind == "trace":
        problem.maximise(trace(P))
    elif kind == "trace_inverse":
        problem.minimise_trace_inverse(P)
    elif kind == "weighted":
        problem.minimise_trace_inverse(P, weight=np.diag([1.0, 2.0, 0.5, 1.0])[:, :3])
    elif kind == "log_det":
        problem.maximise_log_det(P)
    elif kind == "lambda_min":
        problem.maximise_lambda_min(P)
    else:
        problem.add("slack", t >= -(2.0 + 0.0))
        problem.add("bound", P << t * np.eye(n))
        problem.minimise(t + 1.5)
    return problem


KINDS = ["trace", "trace_inverse", "weighted", "log_det", "lambda_min", "scalar"]


@pytest.mark.parametrize("kind", KINDS)
def test_the_direct_path_and_cvxpy_agree(kind):
    problem = random_problem(kind)
    direct = problem.solve()
    other = problem.to_cvxpy()
    other.solve(solver="CLARABEL")
    assert direct.objective == pytest.approx(other.value, rel=1e-5, abs=1e-6)
    assert set(other.var_dict) == set(problem.variables)
    # The optimum of log det is unique, so the matrices agree as well.
    if kind == "log_det":
        assert np.allclose(direct["P"], other.var_dict["P"].value, atol=1e-4)


@pytest.mark.parametrize(
    ("kind", "measure"),
    [
        ("trace", np.trace),
        ("trace_inverse", lambda P: np.trace(np.linalg.inv(P))),
        ("log_det", lambda P: np.linalg.slogdet(P)[1]),
        ("lambda_min", lambda P: np.linalg.eigvalsh(P)[0]),
    ],
)
def test_the_objective_is_what_its_name_says(kind, measure):
    solution = random_problem(kind).solve()
    assert solution.objective == pytest.approx(measure(solution["P"]), rel=1e-5)
    values = solution.values
    assert random_problem(kind).evaluate(values) == pytest.approx(measure(values["P"]), rel=1e-12)


def test_constraints_hold_and_duals_have_the_shape_of_their_blocks():
    problem = random_problem("trace")
    solution = problem.solve()
    for name, item in problem.blocks.items():
        value = solution.value(item.expression)
        dual = solution.duals[name]
        assert dual.shape == value.shape
        if item.cone == "psd":
            assert np.linalg.eigvalsh(value).min() > -1e-6
            assert np.linalg.eigvalsh(dual).min() > -1e-6
            assert abs(np.sum(value * dual)) < 1e-4
        elif item.cone == "zero":
            assert np.abs(value).max() < 1e-7
        else:
            assert value.min() > -1e-7 and abs(np.sum(value * dual)) < 1e-4


def test_a_sub_problem_keeps_some_vertices():
    problem = random_problem("trace")
    fewer = problem.members({"decay": [0, 3]})
    assert fewer.blocks["decay"].expression.members == 2
    assert fewer.solve().objective >= problem.solve().objective - 1e-6


def test_an_infeasible_problem_is_refused_by_name():
    problem = Problem("unstable")
    P = symmetric("P", 2)
    A = np.diag([1.1, 0.5])
    problem.add("floor", P >> np.eye(2))
    problem.add_lmi("decay", A.T @ P @ A - P, "<<")
    problem.minimise(trace(P))
    with pytest.raises(InfeasibleDesign, match="unstable") as caught:
        problem.solve()
    assert caught.value.status == "PrimalInfeasible"
    assert set(caught.value.duals) == {"floor", "decay"}


@pytest.mark.parametrize(
    ("settings", "status"), [({"max_iter": 2}, "MaxIterations"), ({}, "DualInfeasible")]
)
def test_only_solved_is_solved(settings, status):
    problem = Problem("trouble")
    P = symmetric("P", 3)
    problem.add("floor", P >> np.eye(3))
    problem.maximise(trace(P))
    with pytest.raises(SolverTrouble, match=status) as caught:
        problem.solve(**settings)
    assert caught.value.status == status
    assert "floor" in str(caught.value)
    flagged = problem.solve(accept_inaccurate=True, **settings)
    assert flagged.status == status and not flagged.solved


def test_an_almost_solved_answer_is_not_solved():
    problem = random_problem("trace_inverse")
    too_tight = {"tol_gap_abs": 1e-16, "tol_gap_rel": 1e-16, "tol_feas": 1e-16}
    with pytest.raises(SolverTrouble) as caught:
        problem.solve(**too_tight)
    assert caught.value.status != "Solved"
    assert not caught.value.solution.solved


@pytest.mark.parametrize(
    ("attempt", "word"),
    [
        (lambda p, P: p.add_lmi("b", P @ np.array([[1.0, 2.0], [0.0, 1.0]]), "<<"), "symmetric"),
        (lambda p, P: p.add_lmi("b", P[:1, :], ">>"), "square"),
        (lambda p, P: p.add_lmi("b", P, ">"), "sense"),
        (lambda p, P: p.add("b", P), "no inequality"),
        (lambda p, P: p.minimise(P), "trace"),
        (lambda p, P: block([[P, P], [P]]), r"rows of \[2, 1\] blocks"),
    ],
)
def test_misuse_is_named(attempt, word):
    problem, P = Problem("misuse"), symmetric("P", 2)

    def build_and_solve():
        attempt(problem, P)
        problem.solve()

    with pytest.raises(ExpressionError, match=word):
        build_and_solve()


def test_an_unknown_setting_is_refused():
    problem = random_problem("trace")
    with pytest.raises(SolverTrouble, match="tol_typo"):
        problem.solve(tol_typo=1.0)
