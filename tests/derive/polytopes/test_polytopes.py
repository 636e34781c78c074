"""Polytopes: half-spaces and vertices, groups of scalars, fewer scalars, and planted mistakes."""

from dataclasses import replace
from fractions import Fraction
from itertools import product

import casadi as ca
import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from obsynth.derive import DerivationError, UnboundedError, jacobian_bounds
from obsynth.derive.jacobian.family import AffineFamily
from obsynth.derive.jacobian.matrix_entries import MatrixEntries
from obsynth.derive.polytopes import fewer, support
from obsynth.derive.polytopes.fewer import drop_scalars, principal_family
from obsynth.derive.polytopes.polytope import (
    Label,
    polytope_from_halfspaces,
    polytope_from_vertices,
)
from obsynth.derive.polytopes.support import jacobian_polytope
from obsynth.symbolic import Plant
from obsynth.symbolic.plants.exothermic_cstr import exothermic_cstr
from obsynth.symbolic.plants.quadruple_tank import quadruple_tank
from obsynth.symbolic.plants.three_tanks import three_tanks
from obsynth.symbolic.plants.van_der_pol import van_der_pol

QUICK = settings(max_examples=30, deadline=None, derandomize=True)


def in_hull(points, vertices, radius):
    """Whether points are convex combinations of the vertices, up to the radius."""
    from scipy.optimize import linprog

    n, size = len(vertices), np.abs(vertices).max()
    slack = np.ravel(radius) + 1e-13 * size
    columns = np.vstack([vertices.T, -vertices.T])
    for point in points:
        right = np.concatenate([point + slack, slack - point])
        found = linprog(
            np.zeros(n), columns, right, np.ones((1, n)), [1.0], bounds=(0, None), method="highs"
        )
        if found.status != 0:
            return False
    return True


# -- half-spaces and vertices -----------------------------------------------------------------

CUBE = np.vstack([np.eye(3), -np.eye(3)])


@pytest.mark.parametrize(
    ("normals", "offsets", "count", "volume"),
    [
        (CUBE, np.ones(6), 8, 8.0),
        ([[1, 0], [0, 1], [-1, -1]], [1, 1, 1], 3, 4.5),
        ([[1], [-1]], [3, 1], 2, 4.0),
        (np.vstack([np.eye(5), -np.eye(5)]), np.ones(10), 32, 32.0),
        # all 26 directions touch the cube: faces through its corners are moved outwards
        ([d for d in product((-1, 0, 1), repeat=3) if any(d)], None, None, 8.0),
        # an octahedron, four faces in every vertex
        (list(product((-1, 1), repeat=3)), np.ones(8), None, 4.0 / 3.0),
    ],
)
def test_vertices_of_known_polytopes(normals, offsets, count, volume):
    normals = np.array(normals, dtype=float)
    offsets = np.abs(normals).sum(axis=1) if offsets is None else np.array(offsets, dtype=float)
    found = polytope_from_halfspaces(normals, offsets)
    assert found.volume == pytest.approx(volume, rel=1e-9)
    if count is not None:
        assert len(found.vertices) == count
    excess = normals @ found.vertices.T - offsets[:, None]
    assert excess.max() <= 1e-9


@st.composite
def halfspaces(draw):
    n = draw(st.integers(1, 4))
    rows = draw(st.integers(1, 8))
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    normals = rng.normal(size=(rows, n)) if draw(st.booleans()) else rng.integers(-2, 3, (rows, n))
    normals = np.vstack([np.eye(n), -np.eye(n), normals])
    return normals.astype(float), np.concatenate([rng.uniform(0.1, 2, 2 * n), np.ones(rows)])


@QUICK
@given(given_=halfspaces())
def test_the_hull_of_the_vertices_holds_the_polytope(given_):
    normals, offsets = given_
    found = polytope_from_halfspaces(normals, offsets)
    n = normals.shape[1]
    rng = np.random.default_rng(0)
    points = rng.uniform(-2, 2, (200, n))
    inside = points[(normals @ points.T <= offsets[:, None]).all(axis=0)][:20]
    assert in_hull(inside, found.vertices, found.radius)
    # and it is no larger than it has to be
    assert (normals @ found.vertices.T - offsets[:, None]).max() <= 1e-8


def test_missing_vertices_are_caught():
    found = polytope_from_halfspaces(CUBE, np.ones(6))
    corner = np.array([[0.999, 0.999, 0.999]])
    assert in_hull(corner, found.vertices, found.radius)
    assert not in_hull(corner, found.vertices[:-1], found.radius)


@QUICK
@given(seed=st.integers(0, 10**6), n=st.integers(1, 3), count=st.integers(6, 16))
def test_the_halfspaces_hold_the_points(seed, n, count):
    points = np.random.default_rng(seed).normal(size=(count, n))
    found = polytope_from_vertices(points)
    assert all(found.contains(point) for point in points)
    assert not found.contains(2.5 * points[np.argmax(np.abs(points).sum(axis=1))] + 1.0)
    back = polytope_from_halfspaces(found.normals, found.offsets)
    assert back.volume == pytest.approx(found.volume, rel=1e-6)


def test_offsets_rounded_down_are_caught():
    points = np.random.default_rng(3).normal(size=(40, 3))
    found = polytope_from_vertices(points)
    low = replace(found, offsets=np.nextafter(np.nextafter(found.offsets, -np.inf), -np.inf))
    assert not all(low.contains(point) for point in points)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: polytope_from_halfspaces([[1, 0], [0, 1]], [1, 1]), "is not bounded"),
        # a corner that the first linear program finds
        (lambda: polytope_from_halfspaces([[-1, 0], [0, 1]], [1, 1]), "an edge leads to infinity"),
        (lambda: polytope_from_halfspaces([[1], [-1]], [-1, -1]), "is empty"),
        (lambda: polytope_from_halfspaces([[1, 0]], [1, 2]), "given were shapes"),
        (lambda: polytope_from_halfspaces([[1, np.nan]], [1]), "finite"),
        (lambda: polytope_from_vertices([[0, 0], [1, 1], [2, 2]]), "do not span 2 dimensions"),
    ],
)
def test_what_is_no_polytope_is_refused(call, message):
    with pytest.raises(DerivationError, match=message):
        call()


# -- groups of scalars ------------------------------------------------------------------------


def curve():
    """Two scalars that are functions of one variable, far from independent."""
    plant = Plant("curve")
    a, b = plant.states("a b", range=[(0, 1), (1, 2)])
    plant.dynamics([sp.exp(a) + b**2, a**2 - sp.log(b) * 3])
    plant.outputs([a])
    return plant


def space():
    """Three scalars of two variables, and one of another."""
    plant = Plant("space")
    a, b, c = plant.states("a b c", range=[(-1, 1), (0, 1), (1, 2)])
    plant.dynamics([a**2 * b + sp.sin(a), c**3, a + sp.exp(b) * 2])
    plant.outputs([a])
    return plant


PLANTS = {
    "curve": curve,
    "space": space,
    "van der Pol": van_der_pol,
    "CSTR": exothermic_cstr,
    "tanks": quadruple_tank,
    "three tanks": three_tanks,
}


def jacobians(plant, count, seed=0):
    sx = plant.sx()
    kinds = ("x", "u", "d", "f", "w", "p", "rho")
    columns = [getattr(sx, kind) for kind in kinds]
    function = ca.Function("J", columns, [ca.densify(ca.jacobian(sx.rhs, sx.x))])
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        point = []
        for kind in kinds:
            low, high = plant.box(kind).reshape(-1, 2).T
            low, high = np.where(np.isfinite(low), low, -1.0), np.where(np.isfinite(high), high, 1)
            share = rng.random(len(low))
            share = np.where(rng.random(len(low)) < 0.4, np.round(share), share)
            point.append(low + share * (high - low))
        found.append(np.array(function(*point)))
    return np.array(found)


def escapes(polytope, matrices):
    """Matrices that are no convex combinations of the vertices."""
    vertices = polytope.vertices()
    flat = vertices.reshape(len(vertices), -1)
    radius = polytope.vertex_radius.ravel() + 4e-15 * np.abs(flat).max(axis=0)
    return [m for m in matrices if not in_hull([m.ravel()], flat, radius)]


@pytest.mark.parametrize("most", [None, 4])
@pytest.mark.parametrize("name", sorted(PLANTS))
def test_jacobians_lie_in_their_polytope(name, most):
    plant = PLANTS[name]()
    found = jacobian_polytope(plant, most_vertices=most)
    assert not escapes(found, jacobians(plant, 60))
    if most is not None:
        assert all(len(group.polytope.vertices) <= max(most, 8) for group in found.groups)


def test_a_curve_needs_less_than_its_box():
    found = jacobian_polytope(curve())
    assert [group.scalars for group in found.groups] == [(0, 2), (1, 3)]
    assert all(group.label is Label.OUTER for group in found.groups)
    assert all(group.fill < 0.35 for group in found.groups)
    assert found.box_vertex_count == 16
    few = jacobian_polytope(curve(), most_vertices=4)
    assert few.vertex_count == 16
    assert all(group.fill < 0.5 for group in few.groups)
    three = jacobian_polytope(curve(), most_vertices=3)
    assert three.vertex_count == 9
    assert not escapes(three, jacobians(curve(), 60))
    assert "9 vertices (outer) in place of 16" in str(three)


def test_independent_scalars_stay_exact():
    found = jacobian_polytope(quadruple_tank())
    assert found.label is Label.EXACT
    assert (found.vertex_count, found.naive_vertex_count) == (16, 64)
    np.testing.assert_array_equal(found.vertices(), jacobian_bounds(quadruple_tank()).vertices())


def test_membership_of_a_polytope():
    plant = curve()
    found = jacobian_polytope(plant)
    family = found.family
    corner = family.at(family.ranges[:, 0])
    # the corner of the box where one scalar is smallest and the other largest does not occur
    mixed = family.at([family.ranges[0, 0], *family.ranges[1:, 1]])
    assert found.contains(corner)
    assert family.contains(mixed)
    assert not found.contains(mixed)


def change_supports(monkeypatch, change):
    """Falsify what branch and bound says of directions, but not of the single entries."""
    real = MatrixEntries.search

    def wrong(self, rtol, effort, values=None):
        found = real(self, rtol, effort, values)
        return found if values is None else change(found)

    monkeypatch.setattr(MatrixEntries, "search", wrong)


def too_small_support(monkeypatch):
    def shrink(found):
        width = found.upper - found.lower
        return replace(found, lower=found.lower + 0.1 * width, upper=found.upper - 0.1 * width)

    change_supports(monkeypatch, shrink)


def shifted_directions(monkeypatch):
    def shift(found):
        return replace(found, lower=np.roll(found.lower, 1), upper=np.roll(found.upper, 1))

    change_supports(monkeypatch, shift)


def forgotten_vertex(monkeypatch):
    real = support.polytope_from_halfspaces

    def wrong(normals, offsets):
        found = real(normals, offsets)
        middle = found.vertices.mean(axis=0)
        far = np.argmax(np.linalg.norm(found.vertices - middle, axis=1))
        return replace(found, vertices=np.delete(found.vertices, far, axis=0))

    monkeypatch.setattr(support, "polytope_from_halfspaces", wrong)


def is_caught(plant, matrices):
    """Whether a polytope is seen to be wrong: a matrix lies outside, or there is nothing inside."""
    try:
        return bool(escapes(jacobian_polytope(plant), matrices))
    except DerivationError as error:
        return "is empty" in str(error)


@pytest.mark.parametrize("mutant", [too_small_support, shifted_directions, forgotten_vertex])
def test_wrong_polytopes_are_caught(monkeypatch, mutant):
    plant = curve()
    matrices = jacobians(plant, 200)
    assert not escapes(jacobian_polytope(plant), matrices)
    mutant(monkeypatch)
    assert is_caught(plant, matrices)


# -- fewer scalars ----------------------------------------------------------------------------


def family_of_three():
    directions = np.zeros((3, 2, 2))
    directions[0, 0, 0] = directions[1, 0, 1] = directions[2, 1, 1] = 1.0
    directions[0, 1, 0] = -1 / 3
    ranges = np.array([[-1.0, 3.0], [0.1, 0.2], [-0.3, 0.7]])
    constant = np.array([[0.0, 0.0], [0.1, 0.0]])
    return AffineFamily(constant, directions, ranges, np.zeros((2, 2)), ("a", "b", "c"), True)


def test_the_rounding_of_what_is_dropped_is_counted():
    """Large constants, narrow ranges: the interval alone is smaller than one rounding."""
    rng = np.random.default_rng(0)
    for _ in range(40):
        middle = rng.uniform(1e5, 1e6)
        family = AffineFamily(
            rng.uniform(-1e6, 1e6, (2, 2)),
            rng.uniform(-1.0, 1.0, (1, 2, 2)),
            np.array([[middle, np.nextafter(middle, np.inf)]]),
            np.zeros((2, 2)),
            ("s",),
            True,
        )
        found = drop_scalars(family, [0])
        for end in map(Fraction, family.ranges[0]):
            for i, j in np.ndindex(2, 2):
                exact = Fraction(family.constant[i, j]) + end * Fraction(family.directions[0, i, j])
                assert abs(exact - Fraction(found.constant[i, j])) <= Fraction(found.radius[i, j])


@pytest.mark.parametrize("drop", [[0], [1], [0, 2], [0, 1, 2]])
def test_dropped_scalars_stay_as_intervals(drop):
    family = family_of_three()
    found = drop_scalars(family, drop)
    assert found.vertex_count == 2 ** (3 - len(drop))
    assert not found.exact
    vertices = found.vertices()
    hull = vertices.min(axis=0), vertices.max(axis=0)
    for corner in product(*family.ranges.tolist()):
        exact = [
            [
                Fraction(family.constant[i, j])
                + sum(
                    Fraction(s) * Fraction(d[i, j])
                    for s, d in zip(corner, family.directions, strict=True)
                )
                for j in range(2)
            ]
            for i in range(2)
        ]
        for i, j in np.ndindex(2, 2):
            assert exact[i][j] <= Fraction(hull[1][i, j]) + Fraction(found.radius[i, j])
            assert exact[i][j] >= Fraction(hull[0][i, j]) - Fraction(found.radius[i, j])
    assert found.radius[0, 0] == pytest.approx(2.0 if 0 in drop else 0.0, abs=1e-12)


@pytest.mark.parametrize("name", ["curve", "space", "CSTR", "van der Pol"])
def test_principal_coordinates_hold_the_jacobians(name):
    plant = PLANTS[name]()
    matrices = jacobians(plant, 40)
    count = len(jacobian_bounds(plant).family.ranges)
    for keep in (count, 1):
        found = principal_family(plant, keep=keep)
        assert found.vertex_count == 2**keep
        assert not escapes(found, matrices)
        assert all(found.contains(matrix) for matrix in matrices)
    assert not found.contains(matrices[0] + 10 * np.abs(matrices).max())


def test_forgetting_the_remainder_is_caught(monkeypatch):
    matrices = jacobians(curve(), 100)
    real = fewer.drop_scalars
    monkeypatch.setattr(
        fewer, "drop_scalars", lambda family, k: replace(real(family, k), radius=family.radius)
    )
    assert escapes(principal_family(curve(), keep=1), matrices)


def test_a_polytope_is_no_smaller_than_the_hull_of_samples():
    plant = van_der_pol()
    matrices, outer = jacobians(plant, 400), jacobian_polytope(plant)
    assert not escapes(outer, matrices)
    scalars = np.array([[m[place] for place in outer.groups[0].places] for m in matrices])
    assert polytope_from_vertices(scalars).volume <= outer.groups[0].polytope.volume


def test_too_many_vertices_are_refused():
    found = jacobian_polytope(quadruple_tank())
    many = replace(found, groups=found.groups * 5)
    with pytest.raises(DerivationError, match="1048576 vertices"):
        many.vertices()


@pytest.mark.parametrize("end", ["lower", "upper"])
def test_a_coordinate_without_an_end_is_refused(monkeypatch, end):
    """Mutant: one end asked twice."""
    real = MatrixEntries.search

    def endless(self, *arguments):
        found = real(self, *arguments)
        if len(arguments) < 3:
            return found
        value = np.full_like(found.lower, -np.inf if end == "lower" else np.inf)
        return replace(found, **{end: value})

    monkeypatch.setattr(MatrixEntries, "search", endless)
    with pytest.raises(UnboundedError, match="principal coordinate"):
        principal_family(exothermic_cstr(), keep=1)
