"""Reductions say the same as what they reduce."""

from itertools import product

import numpy as np
import pytest

from obsynth.designs.lmi.expression import full, symmetric
from obsynth.designs.lmi.problem import Problem, symmetric_block
from obsynth.designs.lmi.reductions import split_common


def signs(k):
    return np.array(list(product((-1.0, 1.0), repeat=k)))


def data(seed):
    rng = np.random.default_rng(seed)
    n, m = 4, 2
    A = 0.4 * rng.normal(size=(n, n))
    M = np.zeros((3, n, n))
    M[0, 0, 0], M[1, 0, 1], M[2, 1, 1] = 0.1, 0.2, 0.15
    return A, M, rng.normal(size=(m, n)), 0.3 * rng.normal(size=(n, 3))


def decay(P, H, A, C, W):
    X = P @ A - H @ C
    return symmetric_block([[0.9 * P], [0, np.eye(W.shape[1])], [X, P @ W, P]])


def optimum(add):
    P, H = symmetric("P", 4), full("H", 4, 2)
    problem = Problem("reduced")
    add(problem, P, H)
    problem.minimise_trace_inverse(P)
    return problem.solve()


@pytest.mark.parametrize("seed", range(6))
def test_the_split_has_the_optimum_of_the_family(seed):
    A, M, C, W = data(seed)
    vertices = A + np.einsum("vk,kij->vij", signs(3), M)

    def whole(problem, P, H):
        problem.add("family", decay(P, H, vertices, C, W) >> 0)

    def parts(problem, P, H):
        split = split_common(decay(P, H, vertices, C, W), "Z")
        assert split.common.shape == (11, 11) and split.members.shape[0] < 11
        problem.add("common", split.common >> 0)
        problem.add("members", split.members >> 0)

    one, two = optimum(whole), optimum(parts)
    assert two.objective == pytest.approx(one.objective, rel=1e-6)
    # What the split returns satisfies the family itself.
    P, H = symmetric("P", 4), full("H", 4, 2)
    whole_value = decay(P, H, vertices, C, W).value(two.values)
    assert np.linalg.eigvalsh(whole_value).min() > -1e-6


def test_a_family_that_varies_everywhere_or_nowhere_is_left_alone():
    rng = np.random.default_rng(0)
    everywhere = rng.normal(size=(3, 2, 2))
    P = symmetric("P", 2)
    split = split_common(P - (everywhere + np.swapaxes(everywhere, 1, 2)), "Z")
    assert split.common is None and split.members.shape == (2, 2)
    nowhere = split_common(P - np.zeros((3, 2, 2)), "Z")
    assert nowhere.common is None


def test_rows_that_are_not_coupled_need_no_slack():
    M = np.zeros((3, 2, 2))
    M[:, 0, 0] = [1.0, 2.0, 3.0]
    D = symmetric_block([[symmetric("a", 1)], [0, symmetric("b", 1)]])
    split = split_common(D - M, "Z")
    assert len(split.shared) == 0
    assert split.common.shape == split.members.shape == (1, 1)
    assert {v.name for v in split.common.terms} == {"b"}
