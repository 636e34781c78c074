"""The matrix Psi of the error dynamics over the polytopes of state and error.

Row i is x'(N_i + N_i') - e'N_i: docs/methods/qpv_observer.md, Conditions.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from obsynth.derive.rigour import Enclosure
from obsynth.designs.qpv.sets import Shape
from obsynth.symbolic.arrays import FloatArray

# Hulls in more coordinates have too many facets.
_HULL_DIMENSION = 7


@dataclass(frozen=True, eq=False)
class ErrorSets:
    """The sets over which the inequalities are stated.

    centre (n,): c of the region
    state: of x - c, all coordinates; it holds the region
    error: of e in the first coordinates, at least those that enter Psi; it holds {e : e'P e <= 1}
    start (r, n): corners of the polytope of e(0), one of every pair v, -v, within {e : e'P e <= 1}
    state_entering, error_entering: the coordinates that enter Psi
    """

    centre: FloatArray
    state: Shape
    error: Shape
    start: FloatArray
    state_entering: tuple[int, ...]
    error_entering: tuple[int, ...]

    @cached_property
    def _projected(self) -> tuple[Shape, Shape]:
        return self.state.onto(self.state_entering), self.error.onto(self.error_entering)

    @cached_property
    def pairs(self) -> FloatArray:
        """Offsets of all pairs of vertices, shape (p q, number of entering coordinates)."""
        if not self.state_entering:
            return np.zeros((1, 0))
        x, e = (shape.vertices for shape in self._projected)
        return np.hstack([np.repeat(x, len(e), axis=0), np.tile(e, (len(x), 1))])

    @property
    def pair_radius(self) -> FloatArray:
        """What rounding may add to the offsets, by coordinate."""
        x, e = self._projected
        own = self.state.radius[[*self.state_entering]], self.error.radius[[*self.error_entering]]
        return np.concatenate([x.radius + own[0], e.radius + own[1]])

    @property
    def normals(self) -> Enclosure:
        """Half-spaces of the error's polytope, one of every pair a, -a, shape (K, 1, n)."""
        known, more = self.error.normals, self.centre.size - self.error.dimension
        pad = ((0, 0), (0, 0), (0, more))
        return Enclosure(np.pad(known.mid, pad), np.pad(known.rad, pad))


def entering(N: FloatArray) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Find the coordinates of x and of e on which Psi depends. Shapes: N (V, n, n, n)."""
    symmetric = N + np.swapaxes(N, -1, -2)
    state = np.flatnonzero(symmetric.any(axis=(0, 1, 3)))
    error = np.flatnonzero(N.any(axis=(0, 1, 3)))
    return tuple(map(int, state)), tuple(map(int, error))


def _directions(N: FloatArray, sets: ErrorSets, radius: FloatArray) -> tuple[Enclosure, Enclosure]:
    """Psi at the centre, and its slope for every entering coordinate (K, n, n)."""
    enclosed = Enclosure.of(N, radius)
    both = enclosed + enclosed.T
    # entry (i, a, b) of N is the slope of Psi[i, b] by coordinate a
    slope = Enclosure(np.swapaxes(both.mid, 0, 1), np.swapaxes(both.rad, 0, 1))
    error = Enclosure(-np.swapaxes(enclosed.mid, 0, 1), np.swapaxes(enclosed.rad, 0, 1))
    centre = Enclosure(np.zeros(N.shape[1:]), np.zeros(N.shape[1:]))
    for a in np.flatnonzero(sets.centre):
        centre = centre + Enclosure.of(sets.centre[a]) * slope.member(a)
    s, t = list(sets.state_entering), list(sets.error_entering)
    mid = np.concatenate([slope.mid[s], error.mid[t]])
    rad = np.concatenate([slope.rad[s], error.rad[t]])
    return centre, Enclosure(mid, rad)


def psi_family(
    N: FloatArray, sets: ErrorSets, radius: FloatArray | None = None, rows: FloatArray | None = None
) -> Enclosure:
    """Enclose Psi at pairs of vertices. Shapes: N (n, n, n), radius (n, n, n), rows (k, K)."""
    offsets = sets.pairs if rows is None else rows
    n = N.shape[0]
    if not offsets.shape[1]:
        return Enclosure(np.zeros((1, n, n)), np.zeros((1, n, n)))
    centre, directions = _directions(N, sets, np.zeros_like(N) if radius is None else radius)
    family = Enclosure.combine(centre, directions, offsets)
    spread = sets.pair_radius
    if not spread.any():
        return family
    largest = np.abs(directions.mid) + directions.rad
    added = np.tensordot(spread, largest, axes=1) * (1.0 + 2.0**-40)
    return Enclosure(family.mid, family.rad + added)


def psi_kept(N: FloatArray, sets: ErrorSets) -> FloatArray:
    """Return the distinct extreme values of Psi among all pairs, for N (V, n, n, n)."""
    families = np.stack([psi_family(block, sets).mid for block in N], axis=1)
    count = len(families)
    flat = families.reshape(count, -1)
    varying = np.flatnonzero(np.ptp(flat, axis=0) > 0)
    independent = _independent(flat[:, varying])
    kept = extreme_points(_tidy(independent)) if independent.size else np.zeros(1, dtype=np.intp)
    return np.swapaxes(families[kept], 0, 1)


def extreme_points(points: FloatArray) -> NDArray[np.intp]:
    """Rows that are extreme, up to rounding; in many coordinates all that differ."""
    dimension = points.shape[1]
    if dimension == 1:
        return np.unique([points[:, 0].argmin(), points[:, 0].argmax()])
    if dimension > _HULL_DIMENSION:
        return np.sort(np.unique(points, axis=0, return_index=True)[1])
    from scipy.spatial import ConvexHull

    directions = np.random.default_rng(0).normal(size=(dimension, 64 * dimension))
    chosen = np.unique((points @ directions).argmax(axis=0))
    # the hull grows by what lies outside it
    while True:
        hull = ConvexHull(points[chosen])
        heights = points @ hull.equations[:, :-1].T + hull.equations[:, -1]
        beyond = np.flatnonzero(heights.max(axis=0) > 1e-9)
        if not len(beyond):
            return np.sort(chosen[hull.vertices])
        chosen = np.union1d(chosen, heights[:, beyond].argmax(axis=0))


def _independent(columns: FloatArray) -> FloatArray:
    """Columns of which the others are affine functions, so that they tell the points apart."""
    chosen: list[int] = []
    rank = 0
    centred = columns - columns.mean(axis=0, keepdims=True)
    for j in range(columns.shape[1]):
        trial = np.linalg.matrix_rank(centred[:, [*chosen, j]], tol=1e-9)
        if trial > rank:
            chosen, rank = [*chosen, j], int(trial)
    return columns[:, chosen]


def _tidy(points: FloatArray) -> FloatArray:
    """Round to 30 bits of half ranges, so that equal rows are equal; the proof takes all."""
    low, high = points.min(axis=0), points.max(axis=0)
    centred = (points - 0.5 * (low + high)) / np.where(high > low, 0.5 * (high - low), 1.0)
    return np.asarray(np.round(centred * 2.0**30) / 2.0**30)
