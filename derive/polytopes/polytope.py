"""Polytopes by half-spaces and by vertices, and the way from one to the other, in rationals.

A vertex of a simple polytope lies on exactly n faces; letting go of one of them leads along an edge
to a neighbour. The graph of vertices and edges is connected, so that a walk sees every vertex.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from obsynth.derive.errors import DerivationError
from obsynth.derive.rigour import Exact, above, exact, inverse, magnitude, nearest
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

_STARTS = 24


class Degenerate(Exception):
    """More than n faces meet in a vertex, so that edges cannot be followed without a choice."""


def _inverse(matrix: Exact) -> Exact | None:
    """Invert a small matrix; None if it is singular."""
    try:
        return inverse(matrix)
    except ObsynthError:
        return None


def walk_vertices(normals: Exact, offsets: Exact) -> dict[tuple[int, ...], Exact]:
    """List the vertices of {x : normals x <= offsets}, shapes (m, n) and (m,)."""
    found: dict[tuple[int, ...], Exact] = {}
    stack = [_start(normals, offsets)]
    while stack:
        active = stack.pop()
        if active in found:
            continue
        edges = _inverse(normals[list(active)])
        if edges is None:
            raise Degenerate
        point = edges @ offsets[list(active)]
        slacks = offsets - normals @ point
        others = [i for i in range(len(offsets)) if i not in active]
        if any(slacks[i] <= 0 for i in others):
            raise Degenerate
        found[active] = point
        for along, leaving in zip(-edges.T, active, strict=True):
            rises = normals @ along
            steps = [(slacks[i] / rises[i], i) for i in others if rises[i] > 0]
            if not steps:
                raise DerivationError(
                    "the half-spaces do not bound a polytope: an edge leads to infinity. Add "
                    "bounds of every coordinate",
                    direction=tuple(nearest(along).tolist()),
                )
            length, entering = min(steps)
            if sum(1 for step, _ in steps if step == length) > 1:
                raise Degenerate
            stack.append(tuple(sorted({*active, entering} - {leaving})))
    return found


def _start(normals: Exact, offsets: Exact) -> tuple[int, ...]:
    """Faces of some vertex, from a linear program in doubles, checked exactly."""
    from scipy.optimize import linprog

    matrix, right = nearest(normals), nearest(offsets)
    rng = np.random.default_rng(0)
    for _ in range(_STARTS):
        goal = rng.normal(size=matrix.shape[1])
        result = linprog(goal, matrix, right, bounds=(None, None), method="highs-ds")
        if result.status in (2, 3):
            what = "is empty" if result.status == 2 else "is not bounded"
            raise DerivationError(f"the polytope of these {len(right)} half-spaces {what}")
        if result.x is None:
            continue
        active = _independent(matrix, np.argsort(right - matrix @ result.x, kind="stable"))
        edges = None if active is None else _inverse(normals[list(active)])
        if active is None or edges is None:
            continue
        if (normals @ (edges @ offsets[list(active)]) <= offsets).all():
            return active
    raise Degenerate


def _independent(matrix: FloatArray, order: NDArray[np.intp]) -> tuple[int, ...] | None:
    chosen: list[int] = []
    for i in order.tolist():
        rows = matrix[[*chosen, i]]
        size = np.linalg.norm(rows, axis=1, keepdims=True)
        if np.linalg.matrix_rank(rows / np.where(size > 0.0, size, 1.0), tol=1e-9) > len(chosen):
            chosen.append(i)
        if len(chosen) == matrix.shape[1]:
            return tuple(sorted(chosen))
    return None


# Faces are moved outwards by so much of the size, each by a different multiple, until no more than
# n of them meet in a vertex.
_NUDGES = (2.0**-44, 2.0**-40, 2.0**-34)


@dataclass(frozen=True, eq=False)
class Polytope:
    """A bounded polytope {x : normals x <= offsets}, and vertices whose hull holds it.

    From `polytope_from_halfspaces` the half-spaces are the given ones and the vertices hold them;
    from `polytope_from_vertices` it is the other way round.

    normals (m, n): outer normals
    offsets (m,): right-hand sides
    vertices (N, n): corners
    radius (n,): rounding of the vertices: every point of the polytope is a convex combination of
        points that lie no farther than this from the vertices, coordinate by coordinate
    """

    normals: FloatArray
    offsets: FloatArray
    vertices: FloatArray
    radius: FloatArray

    @property
    def dimension(self) -> int:
        """Number of coordinates."""
        return int(self.normals.shape[1])

    def contains(self, point: ArrayLike) -> bool:
        """Whether a point satisfies all inequalities, in exact arithmetic."""
        x = exact(np.ravel(np.asarray(point, dtype=float)))
        return bool((exact(self.normals) @ x <= exact(self.offsets)).all())


def polytope_from_halfspaces(normals: ArrayLike, offsets: ArrayLike) -> Polytope:
    """Find the vertices of {x : normals x <= offsets}, shapes (m, n) and (m,).

    They are exact up to ``radius``. Where more than n faces meet in a vertex, they are moved
    outwards by a relative 1e-13 or so, so that the hull of the vertices holds the polytope in any
    case. An empty or unbounded one is a DerivationError.
    """
    A, b = np.atleast_2d(np.asarray(normals, dtype=float)), np.ravel(np.asarray(offsets, float))
    if A.ndim != 2 or len(A) != len(b) or A.shape[1] == 0:
        raise DerivationError(
            f"half-spaces are normals (m, n) and offsets (m,); given were shapes {A.shape} and "
            f"{b.shape}",
            normals=A.shape,
            offsets=b.shape,
        )
    if not (np.isfinite(A).all() and np.isfinite(b).all()):
        raise DerivationError("normals and offsets of half-spaces have to be finite numbers")
    faces, right = exact(A), exact(b)
    shares = exact(1 + np.random.default_rng(0).integers(0, 2**20, len(b)))
    lengths = magnitude(faces).sum(axis=1)
    # at full length a face moves by a share of the size
    moves = shares * exact(float(np.abs(b).max(initial=0.0)) or 1.0) * lengths / 2**20
    longest = max(lengths) or 1
    for nudge in (0.0, *_NUDGES):
        try:
            found = walk_vertices(faces, right + exact(nudge) * moves / longest)
        except Degenerate:
            continue
        corners = np.array(list(found.values()))
        vertices = nearest(corners)
        radius = above(magnitude(exact(vertices) - corners).max(axis=0))
        order = np.lexsort(vertices.T[::-1])
        return Polytope(A, b, vertices[order], radius)
    raise DerivationError(
        "the vertices of these half-spaces could not be told apart: the polytope is flat or "
        "nearly so. Describe it in fewer coordinates",
        halfspaces=len(b),
        condition="flat",
    )


def polytope_from_vertices(vertices: ArrayLike) -> Polytope:
    """Find half-spaces whose intersection holds the hull of points (N, n).

    The points kept are those on the hull, and offsets are rounded up until every point satisfies
    them exactly. Points in one hyperplane are a DerivationError.
    """
    points = np.atleast_2d(np.asarray(vertices, dtype=float))
    n = points.shape[1]
    if n == 1 and len(points):
        ends = np.array([[points.min()], [points.max()]])
        normals = np.array([[-1.0], [1.0]])
        return Polytope(normals, np.array([-ends[0, 0], ends[1, 0]]), ends, np.zeros(1))
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError) as error:
        raise DerivationError(
            f"{len(points)} points do not span {n} dimensions; describe them in fewer coordinates",
            points=len(points),
            dimension=n,
        ) from error
    normals = np.unique(hull.equations[:, :-1], axis=0)
    kept = points[hull.vertices]
    furthest = [max(exact(points[_foremost(points, row)]) @ exact(row)) for row in normals]
    order = np.lexsort(kept.T[::-1])
    return Polytope(normals, above(np.array(furthest)), kept[order], np.zeros(n))


def _foremost(points: FloatArray, normal: FloatArray) -> NDArray[np.int64]:
    """Points that may be the furthest in a direction, as far as rounding leaves that open."""
    values = points @ normal
    error = 2.0 * (points.shape[1] + 2) * np.finfo(float).eps * (np.abs(points) @ np.abs(normal))
    error += 1e-300
    return np.flatnonzero(values + error >= (values - error).max())
