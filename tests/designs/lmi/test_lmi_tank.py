"""The layer on the quadruple tank of the bounded-error paper: gamma, margins, refusals."""

import json
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from obsynth.derive.rigour import Enclosure, prove_positive_definite
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.lmi.expression import full, symmetric, trace
from obsynth.designs.lmi.margin import largest_margin, solve_with_margin
from obsynth.designs.lmi.problem import Problem, symmetric_block
from obsynth.designs.lmi.search import Knob, bisect_feasible, smallest_changes

REFERENCE = json.loads(
    (Path(__file__).parents[2] / "reference" / "bounded_error_uio.json").read_text("utf-8")
)
MODEL = {name: np.array(value) for name, value in REFERENCE["model"].items()}
T, C = np.diag([1.0, 1.0, 0.0, 1.0]), np.hstack([np.eye(3, 4), np.zeros((3, 2))])
# One level enters two rows: four parameters, sixteen vertices.
LEVELS = [((0, 0, 1),), ((1, 1, 1),), ((0, 2, 1), (2, 2, -1)), ((1, 3, 1), (3, 3, -1))]


def vertices(share=1.0):
    """Augmented dynamics at the vertices, the Jacobian's deviation scaled by a share."""
    family = []
    for ends in product(("Jmin", "Jmax"), repeat=4):
        M = np.zeros((4, 4))
        for end, entries in zip(ends, LEVELS, strict=True):
            i, j, _ = entries[0]
            middle = 0.5 * (MODEL["Jmin"][i, j] + MODEL["Jmax"][i, j])
            value = middle + share * (MODEL[end][i, j] - middle)
            for row, column, sign in entries:
                M[row, column] = sign * value
        family.append(np.block([[T @ (MODEL["A"] + M), T @ MODEL["B"]], [np.eye(2, 6, 4)]]))
    return np.array(family)


def invariance(P, H, A, keep):
    return symmetric_block([[P * keep], [P @ A - H @ C, P]])


def feasible(gamma, share=1.0):
    problem = Problem(f"gamma = {gamma}")
    P, H = symmetric("P", 6), full("H", 6, 3)
    problem.add_lmi("invariance", invariance(P, H, vertices(share), 1.0 - gamma), ">>")
    return largest_margin(problem, caps={"size": trace(P) <= 6.0}, explain=False).feasible


def test_the_largest_gamma_is_found_within_two_percent():
    found = bisect_feasible(feasible, 1e-3, 0.05, rtol=2e-3, logarithmic=True)
    assert found == pytest.approx(REFERENCE["gamma_max"]["poly_jac"], rel=0.02)
    assert found < 0.01 < 1.13 * found


def test_the_refusal_names_what_would_help():
    lines = smallest_changes(
        [
            Knob("gamma", 0.01, 1e-3, feasible),
            Knob("share of the box", 1.0, 0.0, lambda share: feasible(0.01, share)),
        ],
        rtol=0.05,
    )
    assert "gamma: 0.01 is infeasible, 0.00" in lines[0]
    assert "share of the box: 1 is infeasible, 0." in lines[1]


def test_an_infeasible_gamma_is_refused_with_an_exact_bound():
    problem = Problem("gamma = 0.011")
    P, H = symmetric("P", 6), full("H", 6, 3)
    problem.add_lmi("invariance", invariance(P, H, vertices(), 1.0 - 0.011), ">>")
    problem.add_lmi("floor", P - np.eye(6), ">>", strict=False)
    problem.minimise(trace(P))
    with pytest.raises(InfeasibleDesign, match="no room") as caught:
        solve_with_margin(problem, prove=lambda values: None)
    assert caught.value.margin < -1e-4
    assert caught.value.bound.size_excluded > 1e3
    assert caught.value.binding[0].block == "invariance"


def test_a_design_is_proved_for_the_stored_gain():
    gamma = 0.005
    noise = np.diag([1 / 9] * 3 + [1 / 6] * 2 + [1 / 9] * 3)
    E = np.zeros((4, 3))
    E[2, 2] = -0.1
    W = np.block([[np.zeros((4, 5)), E], [np.zeros((2, 3)), 0.05 * np.eye(2), np.zeros((2, 3))]])
    V = np.hstack([0.1 * np.eye(3), np.zeros((3, 5))])

    def block_of(P, H, A, W, V, noise, C):
        rows = [[P * (1.0 - gamma)], [0, noise], [P @ A - H @ C, P @ W - H @ V, P]]
        return symmetric_block(rows)

    data = (vertices(), W, V, noise, C)
    P, H = symmetric("P", 6), full("H", 6, 3)
    problem = Problem("tank")
    problem.add_lmi("invariance", block_of(P, H, *data), ">>")
    problem.minimise_trace_inverse(P)

    def prove(values):
        P, K = Enclosure.of(values["P"]), np.linalg.solve(values["P"], values["H"])
        return prove_positive_definite(block_of(P, P @ K, *map(Enclosure.of, data)))

    found = solve_with_margin(problem, prove=prove)
    assert found.proof.proved.tolist() == [True] * 16
    # P stands for the paper's over gamma.
    assert found.objective / gamma == pytest.approx(95.412, rel=1e-3)
    wrong = dict(found.values, H=found["H"] * 1.05)
    assert not prove(wrong).all_proved
