"""Polytopes: half-spaces and vertices, groups of scalars, fewer scalars, and planted mistakes."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from obsynth.derive import DerivationError
from obsynth.derive.polytopes.polytope import (
    polytope_from_halfspaces,
    polytope_from_vertices,
)

QUICK = settings(max_examples=30, deadline=None, derandomize=True)


def volume_of(polytope):
    points = polytope.vertices
    return np.ptp(points) if points.shape[1] == 1 else ConvexHull(points).volume


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
    assert volume_of(found) == pytest.approx(volume, rel=1e-9)
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
    assert volume_of(back) == pytest.approx(volume_of(found), rel=1e-6)


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
