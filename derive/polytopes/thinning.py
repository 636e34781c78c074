"""Fewer faces for an outer polytope: what cuts off nothing, then what cuts off least."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from obsynth.derive.polytopes.polytope import hull_volume
from obsynth.symbolic.arrays import FloatArray

_NOTHING = 1e-9
# Polygons of up to so many faces are searched for among all of them.
_EXHAUSTIVE = 4


def corners(normals: FloatArray, offsets: FloatArray, inside: FloatArray) -> FloatArray | None:
    """Approximate vertices of a polytope around a point, None if it is not bounded."""
    from scipy.spatial import ConvexHull, QhullError

    room = offsets - normals @ inside
    if (room <= 0.0).any():
        return None
    # the polar dual: vertices of the polytope are the facets of the hull of these points
    dual = normals / room[:, None]
    try:
        hull = ConvexHull(dual)
    except (QhullError, ValueError):
        return None
    distance = hull.equations[:, -1]
    if (distance >= -1e-12 * np.abs(dual).max()).any():
        return None
    points = inside - hull.equations[:, :-1] / distance[:, None]
    size = max(float(np.abs(points).max()), 1e-300)
    return np.unique(np.round(points / size, 12), axis=0) * size


def thin(
    normals: FloatArray, offsets: FloatArray, inside: FloatArray, most: int | None = None
) -> list[int]:
    """Choose the faces that matter."""
    kept = list(range(len(offsets)))
    points = corners(normals, offsets, inside)
    if points is None:
        return kept
    whole = hull_volume(points)
    if most is not None and most <= _EXHAUSTIVE and normals.shape[1] == 2 < most < len(points):
        return _best_few(normals, offsets, inside, most)
    while len(kept) > normals.shape[1] + 1:
        trials = [_without(normals, offsets, inside, kept, face) for face in kept]
        volumes = [np.inf if t is None else hull_volume(t) for t in trials]
        best = int(np.argmin(volumes))
        chosen = trials[best]
        if chosen is None:
            break
        harmless = volumes[best] <= whole * (1.0 + _NOTHING)
        if not harmless and (most is None or len(points) <= most):
            break
        points, whole = chosen, volumes[best]
        del kept[best]
    return kept


def _best_few(
    normals: FloatArray, offsets: FloatArray, inside: FloatArray, count: int
) -> list[int]:
    """Find the polygon of so many faces with the smallest area."""
    best, chosen = np.inf, list(range(len(offsets)))
    for some in combinations(range(len(offsets)), count):
        faces = list(some)
        points = corners(normals[faces], offsets[faces], inside)
        area = np.inf if points is None else hull_volume(points)
        if area < best:
            best, chosen = area, faces
    return chosen


def _without(
    normals: FloatArray, offsets: FloatArray, inside: FloatArray, kept: Sequence[int], face: int
) -> FloatArray | None:
    rest = [k for k in kept if k != face]
    return corners(normals[rest], offsets[rest], inside)
