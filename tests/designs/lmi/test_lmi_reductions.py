"""Reductions say the same as what they reduce."""

from fractions import Fraction
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from obsynth.designs.lmi.expression import full, symmetric
from obsynth.designs.lmi.problem import Problem, symmetric_block
from obsynth.designs.lmi.reductions import extreme_points, split_common
from obsynth.symbolic.errors import ObsynthError

PROPERTY = settings(derandomize=True, max_examples=15, deadline=None)


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


def expanded(weights, row):
    """Return a row as an exact convex combination of kept ones."""
    if row not in weights:
        return {row: Fraction(1)}
    total = {}
    for other, weight in weights[row].items():
        for kept, share in expanded(weights, other).items():
            total[kept] = total.get(kept, Fraction(0)) + weight * share
    return total


@PROPERTY
@given(seed=st.integers(0, 10**6), count=st.integers(1, 25), size=st.integers(1, 3))
def test_dropped_points_are_exact_combinations_of_kept_ones(seed, count, size):
    points = np.random.default_rng(seed).integers(-2, 3, (count, size)).astype(float) * 0.1
    found = extreme_points(points)
    exact = [[Fraction(x) for x in row] for row in points.tolist()]
    for row in range(count):
        weights = expanded(found.weights, row)
        assert set(weights) <= set(found.kept.tolist())
        assert sum(weights.values()) == 1 and min(weights.values()) >= 0
        for j in range(size):
            assert sum(w * exact[k][j] for k, w in weights.items()) == exact[row][j]


def test_extreme_points_are_the_smallest_set():
    corners = signs(3)
    inner = np.random.default_rng(0).integers(-3, 4, (40, 3)) / 8.0
    found = extreme_points(np.vstack([inner, corners, corners]))
    assert found.kept.tolist() == list(range(40, 48))


def test_a_point_outside_by_one_rounding_is_kept():
    outside = np.nextafter(1.0, 2.0)
    assert 2 in extreme_points([[0.0], [1.0], [outside]]).kept
    # Three doubles nearly on a line: only what is exactly between two others may go.
    points = np.array([[0.0, 0.0], [0.1, 0.3], [0.05, 0.15], [0.2 / 3, 0.2]])
    found = extreme_points(points)
    assert 2 not in found.kept
    exact = Fraction(0.2 / 3) * Fraction(0.3) == Fraction(0.2) * Fraction(0.1)
    assert (3 in found.kept) == (not exact)


def test_vertex_pairs_of_a_box_that_enter_through_differences():
    # 64 x 64 pairs of vertices of a box in (x, f): x_j - x_i and f_j enter, 64 are extreme.
    corners = signs(6) * np.array([0.3, 0.7, 1.1, 0.2, 0.2, 0.4])
    i, j = np.divmod(np.arange(64 * 64), 64)
    pairs = np.hstack([corners[j, :3] - corners[i, :3], corners[j, 3:]])
    assert len(extreme_points(pairs).kept) == 64
    # The cross-polytope with the same axes keeps 42.
    cross = np.vstack([np.diag(d) for d in (corners[-1], -corners[-1])])
    i, j = np.divmod(np.arange(12 * 12), 12)
    pairs = np.hstack([cross[j, :3] - cross[i, :3], cross[j, 3:]])
    assert len(extreme_points(pairs).kept) == 42


def test_extreme_points_need_finite_rows():
    with pytest.raises(ObsynthError, match="finite"):
        extreme_points([[np.nan]])
