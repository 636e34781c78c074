"""Largest eigenvalue of a symmetric matrix function, block by block."""

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from obsynth.derive.algebra.connected import connected
from obsynth.derive.constants.eigenvalue_search import Maximum, largest_over_box
from obsynth.derive.constants.symmetric_field import (
    SymmetricField,
    augment,
    eigenvalue_over_interval,
)
from obsynth.derive.intervals.ranges import Ends, Status
from obsynth.derive.jacobian.entries import MatrixEntries
from obsynth.derive.rigour import UNIT_ROUNDOFF, down, largest_eigenvalue, perron_bound, up
from obsynth.symbolic.arrays import FloatArray

_TINY = 1e-13


@dataclass(frozen=True, eq=False)
class Hull:
    """Matrices whose convex hull holds a matrix function, up to a radius; none if not known."""

    vertices: FloatArray
    radius: FloatArray

    def moved(self, by: FloatArray) -> "Hull":
        """Add a matrix to all."""
        if not by.any():
            return self
        moved = self.vertices + by
        return Hull(
            moved, self.radius + 2.0 * UNIT_ROUNDOFF * np.abs(moved).max(axis=0, initial=0.0)
        )

    def augmented(self) -> "Hull":
        """Return [0 M; M' 0] of all."""
        return Hull(augment(self.vertices), augment(self.radius))

    def symmetric(self) -> "Hull":
        """Return (M + M')/2 of all."""
        rounding = UNIT_ROUNDOFF * np.abs(self.vertices).max(axis=0, initial=0.0)
        return Hull(
            0.5 * (self.vertices + np.swapaxes(self.vertices, 1, 2)),
            0.5 * (self.radius + self.radius.T) + np.maximum(rounding, rounding.T),
        )

    def part(self, index: list[int]) -> "Hull":
        """Return some rows and columns of all."""
        return Hull(self.vertices[:, index][:, :, index], self.radius[np.ix_(index, index)])


def matrix_maximum(
    entries: MatrixEntries,
    ranges: Ends,
    fixed: FloatArray,
    hull: Hull | None = None,
    rtol: float = 1e-6,
    effort: str = "normal",
) -> Maximum:
    """Bound the largest eigenvalue of fixed + entries (at both places) over the box.

    Block by block; entries below 1e-13 of the largest one do not connect blocks and are added as a
    perturbation. A block in one row and column has sqrt(sum of squares), the others the smallest of
    the bounds by sign matrices, by vertices and by branch and bound.
    """
    size = np.maximum(np.abs(ranges.lower), np.abs(ranges.upper))
    largest = max(float(size.max(initial=0.0)), float(np.abs(fixed).max(initial=0.0)))
    kept = np.flatnonzero(size > _TINY * largest).tolist()
    places = [entries.places[k] for k in kept]
    best: Maximum | None = None
    for block in _blocks(places, fixed):
        inside = [k for k in kept if entries.places[k][0] in block]
        level = -np.inf if best is None else best.attained
        found = _block(entries, ranges, fixed, hull, block, inside, level, rtol, effort)
        best = found if best is None else _larger(best, found, rtol)
    if best is None:
        return Maximum(0.0, 0.0, {}, Status.EXACT, "no rows")
    left_out = np.zeros_like(fixed)
    for k in set(range(len(size))) - set(kept):
        i, j = entries.places[k]
        left_out[i, j] = left_out[j, i] = size[k]
    # the largest eigenvalue moves by no more than the norm of what was left out
    moved = float(perron_bound(left_out[None])[0])
    if moved == 0.0:
        return best
    return replace(
        best,
        upper=float(up(best.upper + moved)),
        attained=float(down(best.attained - moved)),
    )


def _blocks(places: list[tuple[int, int]], fixed: FloatArray) -> list[list[int]]:
    """Collect sets of rows that entries couple, those with the widest reach first."""
    linked = fixed != 0.0
    for i, j in places:
        linked[i, j] = linked[j, i] = True
    np.fill_diagonal(linked, True)
    blocks = connected(np.flatnonzero(row).tolist() for row in linked)
    return sorted(sorted(blocks), key=len, reverse=True)


def _larger(a: Maximum, b: Maximum, rtol: float) -> Maximum:
    above, below = (a if a.upper >= b.upper else b), (a if a.attained >= b.attained else b)
    status = Status.worst([a.status, b.status])
    gap = above.upper - below.attained
    if gap <= max(above.gap, below.gap) and above.status is Status.EXACT is below.status:
        status = Status.EXACT
    elif gap <= rtol * abs(below.attained) and status is not Status.EXACT:
        status = Status.CONVERGED
    return Maximum(above.upper, below.attained, below.at, status, above.method, a.boxes + b.boxes)


def _block(
    entries: MatrixEntries,
    ranges: Ends,
    fixed: FloatArray,
    hull: Hull | None,
    block: list[int],
    inside: list[int],
    level: float,
    rtol: float,
    effort: str,
) -> Maximum:
    part = fixed[np.ix_(block, block)]
    if not inside:
        low, high = (float(v[0]) for v in largest_eigenvalue(part[None]))
        return Maximum(high, low, {}, Status.EXACT, "a constant block")
    at = {k: position for position, k in enumerate(block)}
    places = [entries.places[k] for k in inside]
    centre_row = _common(places)
    if centre_row is not None and not part.any() and all(i != j for i, j in places):
        return _root_of_squares(entries, inside, rtol, effort)
    chosen = entries.take(inside)
    field = SymmetricField(
        chosen.problem(),
        [at[i] for i, _ in places],
        [at[j] for _, j in places],
        part,
        np.asarray(ranges.lower)[inside],
        np.asarray(ranges.upper)[inside],
    )
    (bound,), exact = eigenvalue_over_interval(*field.matrix_of_ranges())
    known, method = float(bound), "sign matrices of Hertz" if exact else "centre plus radius"
    if hull is not None and len(hull.vertices):
        kept = hull.part(block)
        radius = np.broadcast_to(kept.radius, kept.vertices.shape)
        upper = float(largest_eigenvalue(kept.vertices, radius)[1].max())
        if upper < known * (1.0 - 16.0 * UNIT_ROUNDOFF) or upper < known < 0.0:
            known, method = upper, f"{len(kept.vertices)} vertices of the Jacobian family"
    index = {name: k for k, name in enumerate(chosen.names)}
    pieces = []
    for k in inside:
        support = entries.support(entries.places[k])
        columns = [entries.names.index(name) for name in support]
        pieces += [
            ([index[name] for name in support], points[k][columns])
            for points in (ranges.points_lower, ranges.points_upper)
        ]
    return largest_over_box(field, chosen.names, known, method, pieces, level, rtol, effort)


def _common(places: list[tuple[int, int]]) -> int | None:
    """Row or column that all entries share."""
    shared = set(places[0]).intersection(*places[1:])
    return min(shared) if shared else None


def _root_of_squares(
    entries: MatrixEntries, inside: list[int], rtol: float, effort: str
) -> Maximum:
    """Bound sqrt(sum of squares): the largest eigenvalue of entries in one row and column."""
    chosen = entries.take(inside)
    found = chosen.search(rtol, effort, ca.sumsqr(chosen.values))
    upper = float(up(np.sqrt(max(found.upper[0], 0.0))))
    attained = float(np.nextafter(np.sqrt(max(found.attained_upper[0], 0.0)), 0.0))
    at = chosen.named(found.points_upper[0])
    status = found.status_upper[0]
    return Maximum(upper, attained, at, status, "range of the sum of squares", found.boxes)
