"""Margin first, few vertices, back-off, proof; and refusals that say why."""

import numpy as np
import pytest

from obsynth.derive.rigour import (
    Enclosure,
    ExactMatrix,
    is_positive_definite,
    prove_positive_definite,
)
from obsynth.designs.core.errors import CertificateError, InfeasibleDesign, SolverTrouble
from obsynth.designs.lmi import margin, solve
from obsynth.designs.lmi.expression import full, symmetric, trace
from obsynth.designs.lmi.margin import largest_margin, solve_with_margin
from obsynth.designs.lmi.problem import Problem, symmetric_block
from obsynth.designs.lmi.proof import prove_family
from obsynth.designs.lmi.solve import solve_lazily

N, FAULTS = 4, 2
C = np.eye(3, N)


def vertices(spread):
    """A stable chain with every entry of its two diagonals uncertain: 2^7 vertices."""
    A = np.diag([0.9, 0.85, 0.8, 0.7]) + np.diag([0.05, 0.1, 0.08], 1)
    places = [(j, j) for j in range(N)] + [(j, j + 1) for j in range(N - 1)]
    bits = (np.arange(2 ** len(places))[:, None] >> np.arange(len(places))) & 1
    family = np.repeat(A[None], len(bits), axis=0)
    for k, (i, j) in enumerate(places):
        family[:, i, j] += spread * (2.0 * bits[:, k] - 1.0)
    return family


def decay(P, H, A, keep=0.95):
    W = 0.1 * np.eye(N)
    X = P @ A - H @ lift(C, P)
    noise = lift(0.05 * np.eye(N), P)
    return symmetric_block([[keep * P], [0, noise], [X, P @ lift(W, P), P]])


def lift(value, like):
    """Data in the arithmetic of the unknowns."""
    if isinstance(like, Enclosure):
        return Enclosure.of(value)
    return ExactMatrix.of(value) if isinstance(like, ExactMatrix) else value


def design(spread=0.02):
    family = vertices(spread)
    P, H = symmetric("P", N), full("H", N, 3)
    problem = Problem("chain")
    problem.add_lmi("decay", decay(P, H, family), ">>")
    problem.minimise_trace_inverse(P)

    def prove(values):
        K = np.linalg.solve(values["P"], values["H"])

        def matrices(k, kind):
            P = kind(values["P"])
            return decay(P, P @ kind(K), kind(family[k]))

        return prove_family(
            len(family),
            lambda k: matrices(k, Enclosure.of),
            lambda k: matrices(k, ExactMatrix.of),
        )

    return problem, prove, family


def test_the_recipe_returns_what_is_proved_at_hardly_any_loss():
    problem, prove, family = design()
    found = solve_with_margin(problem, prove=prove)
    assert found.proof.all_proved and len(family) == 128
    assert len(found.proof.exact) == 3
    plain = problem.solve()
    assert plain.objective * (1 - 1e-6) <= found.objective < plain.objective * (1 + 2e-3)
    assert found.objective == pytest.approx(np.trace(np.linalg.inv(found["P"])), rel=1e-4)
    # Lazy: a fraction of the vertices was enough.
    assert len(found.chosen["decay"]) < 100


def test_lazy_and_whole_have_the_same_optimum():
    problem, _, family = design()
    lazy = solve_lazily(problem, floor=-1e-7)
    whole = problem.solve()
    assert lazy.solution.objective == pytest.approx(whole.objective, rel=1e-5)
    assert lazy.rounds > 1 and len(lazy.chosen["decay"]) < len(family)
    values = lazy.solution.value(problem.blocks["decay"].expression)
    assert np.linalg.eigvalsh(values).min() > -2e-7
    # Without looking at the other vertices the answer would be wrong.
    few = problem.members({"decay": [0, 1]}).solve()
    values = few.value(problem.blocks["decay"].expression)
    assert np.linalg.eigvalsh(values).min() < -1e-4


def test_the_second_phase_states_the_vertices_of_the_first_at_once(monkeypatch):
    """Mutant: without `start=` it has to find them again, solve by solve."""
    stated = []
    original = Problem.members

    def listed(self, chosen):
        stated.append((self, chosen))
        return original(self, chosen)

    monkeypatch.setattr(Problem, "members", listed)
    draws = iter(([0, 5, 33, 127], [1, 2, 3, 4]))
    monkeypatch.setattr(solve, "_first_choice", lambda _: np.array(next(draws)))
    problem, prove, _ = design()
    solve_with_margin(problem, prove=prove)
    by_phase = {id(p): [c["decay"] for q, c in stated if q is p] for p, c in stated if c}
    first, second = by_phase.values()
    assert np.array_equal(second[0], first[-1])


@pytest.mark.long
def test_what_the_solver_cannot_reach_is_told():
    problem, _, _ = design()
    with pytest.raises(SolverTrouble, match="wider margin") as caught:
        solve_lazily(problem, floor=1e-3)
    assert caught.value.eigenvalue < 1e-3


def test_the_proof_refuses_a_perturbed_gain_and_names_the_vertices():
    problem, prove, family = design()
    found = solve_with_margin(problem, prove=prove)
    spoiled = dict(found.values)
    spoiled["H"] = found["H"] * 1.3
    proof = prove(spoiled)
    assert not proof.all_proved and proof.margin == -np.inf
    P, H = Enclosure.of(spoiled["P"]), Enclosure.of(spoiled["H"])
    worst = decay(P, H, Enclosure.of(family[list(proof.failed)])).mid
    assert np.linalg.eigvalsh(worst)[:, 0].max() < 1e-12


def test_back_off_leads_to_the_proof_and_failure_is_no_design(monkeypatch):
    problem, _, _ = design()
    calls = []

    def strict(values):
        calls.append(values)
        matrices = decay(values["P"], values["H"], vertices(0.02))
        lifted = matrices - 2e-4 * np.eye(matrices.shape[-1])
        return prove_positive_definite(0.5 * (lifted + np.swapaxes(lifted, 1, 2)))

    found = solve_with_margin(problem, prove=strict)
    assert found.back_off > 0 and len(calls) > 1
    monkeypatch.setattr(margin, "_BACK_OFF", 1e-7)
    with pytest.raises(CertificateError, match="not proved"):
        solve_with_margin(problem, prove=strict)


def test_the_margin_is_that_of_all_vertices():
    problem, _, family = design()
    margin = largest_margin(problem, caps={"size": trace(symmetric("P", N)) <= 20.0})
    assert margin.feasible and margin.bound is None
    values = decay(margin.found.solution["P"], margin.found.solution["H"], family)
    assert np.linalg.eigvalsh(values).min() > 0.45 * margin.value


def undetectable():
    """The last state cannot be seen and does not decay."""
    A = np.diag([0.5, 1.02])
    P, H = symmetric("P", 2), full("H", 2, 1)
    problem = Problem("undetectable")
    side = P @ A - H @ np.array([[1.0, 0.0]])
    problem.add_lmi("decay", symmetric_block([[P], [side, P]]), ">>")
    problem.add_lmi("floor", P - np.eye(2), ">>", strict=False)
    problem.minimise(trace(P))
    return problem


def test_infeasibility_is_explained_and_bounded_in_exact_arithmetic():
    with pytest.raises(InfeasibleDesign, match="no room") as caught:
        solve_with_margin(undetectable(), prove=lambda values: None)
    error = caught.value
    # [P p; p P] with p = 1.02 P has the eigenvalue -.02 P_22, and P_22 >= 1.
    assert error.margin == pytest.approx(-0.02, abs=1e-4)
    assert error.binding[0].block == "decay" and error.binding[0].share > 0.9
    assert error.bound.at(10.0) < -0.0199
    assert error.bound.size_excluded > 1e5
    assert "exact arithmetic" in str(error) and "decay" in str(error)


def test_the_exact_bound_is_true_whatever_the_multipliers():
    problem = undetectable()
    margin = largest_margin(problem)
    for name, multiplier in margin.bound.multipliers.items():
        if multiplier.shape[-1] > 1:
            assert is_positive_definite(multiplier), name
    # The bound holds at every point with entries below the size, feasible or not.
    rng = np.random.default_rng(0)
    blocks = {n: b for n, b in problem.blocks.items() if b.cone == "psd"}
    for _ in range(200):
        root = rng.normal(size=(2, 2))
        values = {"P": root @ root.T + np.eye(2), "H": rng.normal(size=(2, 1))}
        size = max(np.abs(v).max() for v in values.values())
        reached = np.linalg.eigvalsh(blocks["decay"].expression.value(values)).min()
        assert reached <= margin.bound.at(size) + 1e-12
    # A bound with a multiplier of the wrong sign would be beaten.
    assert margin.bound.at(10.0) > -1.0


def test_a_homogeneous_problem_without_room_has_no_margin():
    A = np.diag([0.5, 1.02])
    P = symmetric("P", 2)
    problem = Problem("homogeneous")
    problem.add_lmi("decay", P - A.T @ P @ A, ">>")
    problem.add_lmi("positive", P, ">>")
    margin = largest_margin(problem, caps={"size": trace(P) <= 2.0})
    assert not margin.feasible and abs(margin.value) < 1e-6
    assert margin.bound.at(2.0) < 1e-6


def test_family_proofs_of_many_vertices_agree_with_single_ones():
    rng = np.random.default_rng(1)
    base = np.eye(6) + 0.1 * np.ones((6, 6))
    matrices = base + np.diag(rng.random(6)) * rng.random((5000, 1, 1))
    matrices[1234] -= 0.9999 * np.eye(6)
    proof = prove_family(5000, lambda k: Enclosure.of(matrices[k], 1e-14))
    assert proof.all_proved and proof.worst[0] == 1234
    assert 0 < proof.margin <= np.linalg.eigvalsh(matrices[1234])[0]
    matrices[4321] -= 1.1 * np.eye(6)
    proof = prove_family(5000, lambda k: Enclosure.of(matrices[k], 1e-14))
    assert proof.failed == (4321,)


def test_the_exact_check_has_the_last_word():
    eye = Enclosure.of(np.eye(2))
    proof = prove_family(
        1, lambda k: Enclosure(eye.mid[None], eye.rad[None]), lambda k: -eye_exact()
    )
    assert proof.failed == (0,)


def eye_exact():
    return ExactMatrix.of(np.eye(2))
