"""Largest eigenvalues: verified for matrices, exact over interval matrices, enclosed over boxes."""

import dataclasses
from fractions import Fraction
from itertools import product

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from obsynth.derive.constants import eigenvalue_search as search
from obsynth.derive.constants import symmetric_field
from obsynth.derive.constants.eigenvalue_search import largest_over_box
from obsynth.derive.constants.symmetric_field import (
    SymmetricField,
    augment,
    eigenvalue_over_interval,
)
from obsynth.derive.intervals.ranges import Status, bound_ranges, make_problem

QUICK = settings(max_examples=40, deadline=None, derandomize=True)


def symmetric_matrices(count, size, seed=0, scale=1.0):
    raw = np.random.default_rng(seed).normal(size=(count, size, size)) * scale
    return 0.5 * (raw + raw.transpose(0, 2, 1))


# -- interval matrices -----------------------------------------------------------------------------


def interval(size, seed):
    rng = np.random.default_rng(seed)
    centre = symmetric_matrices(1, size, seed)[0]
    radius = np.abs(symmetric_matrices(1, size, seed + 1)[0])
    return centre, np.where(rng.random((size, size)) < 0.0, 0.0, 0.5 * (radius + radius.T))


def vertices_of(centre, radius):
    """All corner matrices, the slow way."""
    n = len(centre)
    places = [(i, j) for i in range(n) for j in range(i, n)]
    for signs in product((-1.0, 1.0), repeat=len(places)):
        corner = centre.copy()
        for (i, j), s in zip(places, signs, strict=True):
            corner[i, j] += s * radius[i, j]
            if i != j:
                corner[j, i] += s * radius[i, j]
        yield corner


@pytest.mark.parametrize("seed", range(6))
def test_sign_matrices_find_the_largest_eigenvalue_of_all_corners(seed):
    centre, radius = interval(3, seed)
    (upper,), exact = eigenvalue_over_interval(centre[None], radius[None])
    true = max(np.linalg.eigvalsh(corner)[-1] for corner in vertices_of(centre, radius))
    assert exact
    assert upper == pytest.approx(true, rel=1e-12)
    assert true <= upper * (1 + 1e-14)


def test_one_sign_pattern_is_not_enough(monkeypatch):
    monkeypatch.setattr(
        symmetric_field, "sign_patterns", lambda coupled, most=16: np.ones((1, len(coupled)))
    )
    short = 0
    for seed in range(6):
        centre, radius = interval(3, seed)
        true = max(np.linalg.eigvalsh(corner)[-1] for corner in vertices_of(centre, radius))
        short += eigenvalue_over_interval(centre[None], radius[None])[0][0] < true - 1e-9
    assert short


def test_norm_is_the_largest_over_all_corners():
    rng = np.random.default_rng(4)
    centre, radius = rng.normal(size=(2, 3)), rng.random((2, 3))
    (upper,), _ = eigenvalue_over_interval(augment(centre)[None], augment(radius)[None])
    true = max(
        np.linalg.norm(centre + radius * np.array(signs).reshape(2, 3), 2)
        for signs in product((-1.0, 1.0), repeat=6)
    )
    assert upper == pytest.approx(true, rel=1e-12)


def test_many_signs_take_the_cheap_bound():
    centre, radius = interval(20, 0)
    (upper,), exact = eigenvalue_over_interval(centre[None], radius[None])
    assert not exact
    rng = np.random.default_rng(0)
    signs = np.sign(rng.normal(size=(200, 20)))
    corners = centre + signs[:, :, None] * radius * signs[:, None, :]
    assert np.linalg.eigvalsh(corners)[:, -1].max() <= upper


def test_signs_of_separate_parts_are_not_multiplied():
    coupled = np.zeros((6, 6), dtype=bool)
    for i, j in ((0, 1), (2, 3), (4, 5)):
        coupled[i, j] = coupled[j, i] = True
    assert len(symmetric_field.sign_patterns(coupled)) == 8
    assert len(symmetric_field.sign_patterns(np.diag(np.ones(30, dtype=bool)))) == 1


@pytest.mark.parametrize("size", [2, 9])
def test_a_batch_of_interval_matrices_is_bounded_with_few_signs_and_with_many(size):
    """Mutant: the radius taken from the eigenvalue where there are too many signs to try."""
    matrices = [interval(size, seed) for seed in range(5)]
    centres, radii = (np.array(part) for part in zip(*matrices, strict=True))
    bound, exact = eigenvalue_over_interval(centres, radii, most=3)
    assert exact == (size == 2)
    for (centre, radius), most in zip(matrices, bound, strict=True):
        signs = np.sign(np.random.default_rng(0).normal(size=(500, size)))
        corners = centre + signs[:, :, None] * radius * signs[:, None, :]
        assert np.linalg.eigvalsh(corners)[:, -1].max() <= most
        assert np.linalg.eigvalsh(centre)[-1] < most


def test_augmented_matrix_has_the_norm():
    A = np.random.default_rng(0).normal(size=(3, 2))
    assert np.linalg.eigvalsh(augment(A))[-1] == pytest.approx(np.linalg.norm(A, 2))


# -- boxes -----------------------------------------------------------------------------------------

Z = ca.SX.sym("z", 3)
ATOMS = [
    Z[0] * Z[1],
    ca.sin(2 * Z[0] + Z[2]),
    Z[2] ** 2 - Z[0],
    ca.exp(0.3 * Z[1]),
    1 / (2 + Z[0] ** 2 + Z[1] ** 2),
    Z[0] + Z[1] + Z[2],
    ca.tanh(Z[1] - Z[2]),
    ca.fabs(Z[0] - 0.3),
    ca.SX(0.7),
]
BOX = np.array([[-1.0, 1.5], [-1.0, 1.0], [0.0, 2.0]])


def build(size, expressions):
    """Make the field of a full symmetric matrix, and its CasADi function."""
    places = [(i, j) for i in range(size) for j in range(i, size)]
    column = ca.vertcat(*expressions)
    ranges = bound_ranges(column, Z, BOX, rtol=1e-3)
    problem = make_problem(column, Z, BOX)
    rows, columns = [p[0] for p in places], [p[1] for p in places]
    fixed = np.zeros((size, size))
    field = SymmetricField(problem, rows, columns, fixed, ranges.lower, ranges.upper)
    function = ca.Function("entries", [Z], [column])

    def at(points):
        values = np.array(function(points.T))
        result = np.zeros((len(points), size, size))
        for value, (i, j) in zip(values, places, strict=True):
            result[:, i, j] = value
            result[:, j, i] = value
        return result

    return field, at


def sampled_excess(at, found, seed=0):
    rng = np.random.default_rng(seed)
    share = rng.random((400, 3))
    share[:64] = np.round(share[:64])
    points = BOX[:, 0] + share * (BOX[:, 1] - BOX[:, 0])
    values = np.linalg.eigvalsh(at(points))[:, -1]
    return float((values - found.upper).max())


@QUICK
@given(picks=st.lists(st.integers(0, len(ATOMS) - 1), min_size=3, max_size=3))
def test_no_point_of_the_box_exceeds_the_bound(picks):
    field, at = build(2, [ATOMS[k] for k in picks])
    found = largest_over_box(field, ("a", "b", "c"), rtol=1e-3, effort="fast")
    assert sampled_excess(at, found) <= 1e-12
    point = np.array([found.at.get(n, 0.0) for n in ("a", "b", "c")])
    true = np.linalg.eigvalsh(at(point[None])[0])[-1]
    assert found.attained <= true + 1e-12
    assert true <= found.attained + 1e-9
    assert found.upper >= found.attained


@pytest.mark.long
@settings(max_examples=150, deadline=None, derandomize=True)
@given(picks=st.lists(st.integers(0, len(ATOMS) - 1), min_size=6, max_size=6))
def test_no_point_of_the_box_exceeds_the_bound_for_larger_matrices(picks):
    field, at = build(3, [ATOMS[k] for k in picks])
    found = largest_over_box(field, ("a", "b", "c"), rtol=1e-3, effort="fast")
    assert sampled_excess(at, found) <= 1e-12


CORNER = [ATOMS[3], ATOMS[0], ATOMS[5]]
INNER = [1 - (Z[0] - 0.2) ** 2 - (Z[1] - 0.1) ** 2, 0.3 * (Z[0] - Z[1]), -Z[2] - Z[0] ** 2]


@pytest.mark.parametrize("entries", [CORNER, INNER], ids=["corner", "inner"])
def test_search_closes_the_gap(entries):
    field, at = build(2, entries)
    found = largest_over_box(field, ("a", "b", "c"), rtol=1e-6)
    assert found.status in (Status.EXACT, Status.CONVERGED)
    assert found.gap <= 1e-6 * max(abs(found.attained), 1.0)
    assert sampled_excess(at, found) <= 0.0


def test_corner_needs_few_boxes():
    """The second-order bound leaves no cluster of boxes where the maximum is a corner."""
    field, _ = build(2, CORNER)
    assert largest_over_box(field, ("a", "b", "c"), rtol=1e-9).boxes < 200


@pytest.mark.parametrize("mutant", ["tight", "slopes", "coupling"])
def test_planted_mistakes_are_seen(monkeypatch, mutant):
    """A bound that is too tight, swapped slopes, a second-order term left out."""
    whole = search.expansion_bound

    def tight(field, boxes, found, best):
        grown = whole(field, boxes, found, best)
        return dataclasses.replace(grown, bound=grown.bound - 0.2 * np.abs(grown.bound))

    def slopes(field, boxes, found, best):
        turned = dataclasses.replace(found, slope_centre=-found.slope_centre)
        return whole(field, boxes, turned, best)

    def coupling(field, boxes, found, best):
        kept = found.slope_centre * np.eye(field.size)
        narrow = found.slope_radius * np.eye(field.size)
        return whole(
            field, boxes, dataclasses.replace(found, slope_centre=kept, slope_radius=narrow), best
        )

    change = {"tight": tight, "slopes": slopes, "coupling": coupling}[mutant]
    monkeypatch.setattr(search, "expansion_bound", change)
    monkeypatch.setattr(search, "_SAMPLES", 1)
    wrong = 0
    rotating = [ca.SX(0.5), ATOMS[1], ca.SX(-0.5)]
    for entries in (CORNER, INNER, rotating, [ATOMS[1], ATOMS[4], ATOMS[2]]):
        field, at = build(2, entries)
        found = largest_over_box(field, ("a", "b", "c"), rtol=1e-4, effort="fast")
        wrong += sampled_excess(at, found) > 1e-9
    assert wrong


def test_kinks_are_bounded_without_slopes():
    field, at = build(2, [ca.fabs(Z[0] - 0.3), ca.sign(Z[1]), Z[2]])
    found = largest_over_box(field, ("a", "b", "c"), rtol=1e-2, effort="fast")
    assert sampled_excess(at, found) <= 0.0
    assert found.gap < 0.1


def test_budget_is_told(monkeypatch):
    monkeypatch.setitem(search.EIGENVALUE_BUDGETS, "fast", 2)
    field, at = build(2, INNER)
    found = largest_over_box(field, ("a", "b", "c"), rtol=1e-12, effort="fast")
    assert found.status is Status.BUDGET
    assert "budget" in str(found)
    assert found.gap > 1e-3
    assert sampled_excess(at, found) <= 0.0


def test_what_is_known_already_is_only_improved():
    field, _ = build(2, CORNER)
    best = largest_over_box(field, ("a", "b", "c"), rtol=1e-6)
    given = largest_over_box(field, ("a", "b", "c"), best.upper, "a friend", rtol=1e-6)
    assert (given.upper, given.method, given.boxes) == (best.upper, "a friend", 0)


def test_the_rounding_of_a_corner_is_counted():
    """1e16 + 1 rounds to 1e16; mutant: the corner's own rounding left out."""
    rng = np.random.default_rng(1)
    for _ in range(50):
        centre = rng.uniform(1e16, 9e16, (1, 1))
        radius = rng.uniform(0.1, 8.0, (1, 1))
        (upper,), _ = eigenvalue_over_interval(centre[None], radius[None])
        assert Fraction(float(upper)) >= Fraction(centre[0, 0]) + Fraction(radius[0, 0])
