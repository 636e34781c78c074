"""Solver trouble: scaled, handed to a second solver, and told."""

import numpy as np
import pytest

from obsynth.designs.core.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.lmi import conic, solve
from obsynth.designs.lmi.cvxpy_backend import solve_with_cvxpy
from obsynth.designs.lmi.expression import symmetric, trace
from obsynth.designs.lmi.problem import Problem
from obsynth.designs.lmi.solve import solve_reliably, solve_with_retries


def problem():
    scale = np.diag([1.0, 1e4, 1e-3])
    A = np.linalg.inv(scale) @ (np.diag([0.5, 0.4, 0.3]) + 0.1) @ scale
    P = symmetric("P", 3)
    stated = Problem("badly scaled")
    stated.add("decay", P - A.T @ P @ A >> scale @ scale)
    stated.minimise(trace(P))
    return stated


def test_scaling_keeps_the_problem():
    stated = problem()
    form = conic.conic_form(stated.statement)
    scaled = conic.rescaled(form)
    for factors in (scaled.columns, scaled.rows):
        assert np.abs(np.log2(factors) - np.round(np.log2(factors))).max() == 0
    spread = abs(form.A).max() / abs(form.A.data).min()
    assert abs(scaled.A).max() / abs(scaled.A.data).min() < 1e-3 * spread
    plain = conic.solve_form(form, {})
    other = conic.solve_form(scaled, {})
    assert other.solved
    # The second state has the unit 1e-4: its entry of P carries the objective.
    assert other.objective == pytest.approx(plain.objective, rel=1e-2)
    decay = stated.blocks["decay"].expression
    inner = np.sum(other.value(decay) * other.duals["decay"])
    assert abs(inner) < 1e-5 * abs(other.objective)
    assert np.linalg.eigvalsh(other.duals["decay"])[0] > -1e-9


def stubborn(monkeypatch, fails):
    """Let the first attempts of Clarabel run out of iterations."""
    calls = []
    whole = solve.solve_form

    def limited(form, settings):
        calls.append(form)
        if len(calls) <= fails:
            settings = {**settings, "max_iter": 2}
        return whole(form, settings)

    monkeypatch.setattr(solve, "solve_form", limited)
    return calls


def test_the_scaled_problem_is_tried_second(monkeypatch):
    calls = stubborn(monkeypatch, 1)
    solution = solve_with_retries(problem())
    assert len(calls) == 2 and solution.solved
    assert solution.attempts == ("Clarabel: MaxIterations", "Clarabel, scaled: Solved")


def test_another_solver_is_tried_third(monkeypatch):
    pytest.importorskip("scs")
    stubborn(monkeypatch, 2)
    P = symmetric("P", 2)
    easy = Problem("easy")
    easy.add("floor", P >> np.eye(2))
    easy.minimise(trace(P))
    solution = solve_with_retries(easy, second_solvers=("NO SUCH SOLVER", "SCS"))
    assert solution.solver == "SCS" and solution.objective == pytest.approx(2.0, abs=1e-3)
    assert solution.attempts[2] == "NO SUCH SOLVER: not installed"


def test_when_all_fail_every_attempt_is_told(monkeypatch):
    stubborn(monkeypatch, 2)
    with pytest.raises(SolverTrouble, match="badly scaled") as caught:
        solve_with_retries(problem(), second_solvers=())
    assert len(caught.value.attempts) == 2 and "MaxIterations" in str(caught.value)


def test_an_answer_good_enough_ends_the_attempts(monkeypatch):
    stubborn(monkeypatch, 2)
    solution = solve_with_retries(problem(), good_enough=lambda solution: True)
    assert not solution.solved and len(solution.attempts) == 1


@pytest.mark.parametrize("gap", [1e-12, np.inf])
def test_a_small_duality_gap_decides_what_serves(monkeypatch, gap):
    stubborn(monkeypatch, 2)
    if np.isfinite(gap):
        with pytest.raises(SolverTrouble):
            solve_reliably(problem(), floor=-np.inf, gap=gap)
    else:
        assert not solve_reliably(problem(), floor=-np.inf, gap=gap).solved


def infeasible():
    P = symmetric("P", 2)
    stated = Problem("empty")
    stated.add("low", P << -np.eye(2))
    stated.add("high", P >> np.eye(2))
    stated.minimise(trace(P))
    return stated


def test_infeasibility_is_final():
    with pytest.raises(InfeasibleDesign, match="empty") as caught:
        solve_with_retries(infeasible())
    assert caught.value.attempts == ("Clarabel: PrimalInfeasible",)
    assert solve_with_cvxpy(infeasible().statement, "CLARABEL").infeasible


def test_a_report_of_infeasibility_is_checked(monkeypatch):
    """A solver that reports a feasible problem infeasible, with whatever duals, is not believed.

    Mutant: the report alone refuses.
    """
    from dataclasses import replace

    from obsynth.designs.lmi import solve as module

    run = module.solve_form

    def liar(form, settings):
        return replace(run(form, settings), solved=False, infeasible=True)

    monkeypatch.setattr(module, "solve_form", liar)
    with pytest.raises(SolverTrouble):
        solve_with_retries(problem(), ())
    with pytest.raises(InfeasibleDesign, match="exact arithmetic"):
        solve_with_retries(infeasible(), ())


@pytest.mark.parametrize("name", ["SDPA", "SCS"])
def test_second_solvers_agree_with_clarabel(name):
    pytest.importorskip({"SDPA": "sdpap", "SCS": "scs"}[name])
    A = np.array([[0.7, 0.3], [-0.2, 0.6]])
    P = symmetric("P", 2)
    stated = Problem("Lyapunov")
    stated.add("decay", P - A.T @ P @ A >> np.eye(2))
    stated.minimise(trace(P))
    other = solve_with_cvxpy(stated.statement, name)
    assert other.objective == pytest.approx(stated.solve().objective, rel=1e-3)
    assert other.solver == name
