"""Outer polytopes of a Jacobian: support functions of groups of two or three scalars.

The scalars of an affine family that share variables do not take their values independently, and the
box of their ranges holds combinations that never occur. In a group of two or three, max d's over
the box of the plant is bounded by branch and bound for a dozen directions d, which gives an outer
polytope with proof; groups that share nothing multiply.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

import casadi as ca
import numpy as np

from obsynth.derive.algebra.connected import connected
from obsynth.derive.errors import DerivationError
from obsynth.derive.jacobian.bounds import JacobianBounds, jacobian_bounds
from obsynth.derive.jacobian.entries import jacobian_entries
from obsynth.derive.jacobian.family import AffineFamily, entry_name
from obsynth.derive.jacobian.matrix_entries import Entry, MatrixEntries
from obsynth.derive.polytopes.polytope import (
    Label,
    Polytope,
    hull_volume,
    polytope_from_halfspaces,
)
from obsynth.derive.polytopes.thinning import thin
from obsynth.derive.rigour import UNIT_ROUNDOFF
from obsynth.derive.split import Split
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.plant import Plant

_MOST_VERTICES = 2**16
_LARGEST_GROUP = 3
# Smallest integer directions: multiples of pi/8 or so in the plane, and towards the faces, edges
# and corners of a cube.
_PLANE = ((1, 0), (0, 1), (1, 1), (1, -1), (2, 1), (1, 2), (2, -1), (1, -2))
_SPACE = tuple(d for d in product((-1, 0, 1), repeat=3) if d > (0, 0, 0))


@dataclass(frozen=True, eq=False)
class Group:
    """Scalars of a family that share variables, and the polytope in which they lie.

    scalars: positions in the family
    places: the entries they are
    polytope: holds every combination that occurs
    label: EXACT for a single scalar with a tight range, OUTER for others
    attained: combinations that occur, up to rounding: the polytope can be no smaller than their
        hull
    """

    scalars: tuple[int, ...]
    places: tuple[Entry, ...]
    polytope: Polytope
    label: Label
    attained: FloatArray

    @property
    def fill(self) -> float:
        """Volume of the polytope relative to that of the box around it."""
        low, high = self.attained.min(axis=0), self.attained.max(axis=0)
        box = float(np.prod(high - low))
        return self.polytope.volume / box if box > 0.0 else 1.0

    @property
    def gap(self) -> float:
        """Share of the polytope that is not known to be needed; 1 for a box of four or more."""
        volume = self.polytope.volume
        return max(1.0 - hull_volume(self.attained) / volume, 0.0) if volume > 0.0 else 0.0

    def __str__(self) -> str:
        names, word = ", ".join(map(entry_name, self.places)), self.label.value.split(":")[0]
        text = (
            f"{names}: {len(self.polytope.vertices)} vertices ({word}) in place of "
            f"{2 ** len(self.scalars)}"
        )
        if len(self.scalars) == 1 or self.gap == 1.0:
            return text
        return f"{text}, {100 * self.fill:.3g} % of the box, {100 * self.gap:.2g} % to spare"


@dataclass(frozen=True, eq=False)
class JacobianPolytope:
    """Matrices constant + sum_k s_k directions_k with the scalars in a product of polytopes.

    Attributes
    ----------
    family : AffineFamily
        The family with the box of ranges.
    groups : tuple of Group
        Groups without common variables.
    radius : ndarray, shape (n, k)
        Elementwise rounding: every Jacobian over the box is a convex combination of matrices no
        farther than this from the vertices.
    naive_vertex_count : int
        Vertices of the entrywise box.
    """

    family: AffineFamily
    groups: tuple[Group, ...]
    radius: FloatArray
    naive_vertex_count: int

    @property
    def label(self) -> Label:
        """EXACT where all groups are, OUTER otherwise."""
        exact = all(group.label is Label.EXACT for group in self.groups)
        return Label.EXACT if exact else Label.OUTER

    @property
    def vertex_radius(self) -> FloatArray:
        """The same as ``radius``, under the name it has in a family."""
        return self.radius

    @property
    def vertex_count(self) -> int:
        """Number of vertices, without making them."""
        count = 1
        for group in self.groups:
            count *= len(group.polytope.vertices)
        return count

    @property
    def box_vertex_count(self) -> int:
        """Vertices of the family with the box of ranges."""
        return self.family.vertex_count

    def vertices(self) -> FloatArray:
        """Matrices at the combinations of the groups' vertices.

        Returns
        -------
        ndarray, shape (N, n, k)

        Raises
        ------
        DerivationError
            More than 2^16 vertices.
        """
        if self.vertex_count > _MOST_VERTICES:
            raise DerivationError(
                f"the polytope has {self.vertex_count} vertices, more than a polytopic design can "
                "use; ask for fewer with most_vertices=",
                vertices=self.vertex_count,
            )
        matrices = []
        for corner in product(*(group.polytope.vertices for group in self.groups)):
            scalars = np.zeros(len(self.family.ranges))
            for group, values in zip(self.groups, corner, strict=True):
                scalars[list(group.scalars)] = values
            matrices.append(self.family.at(scalars))
        return np.array(matrices).reshape(-1, *self.family.constant.shape)

    def contains(self, matrix: FloatArray) -> bool:
        """Whether a matrix belongs to the polytope, up to the radius.

        Parameters
        ----------
        matrix : ndarray, shape (n, k)
            The matrix; its scalars are read off the entries that define them.

        Returns
        -------
        bool
        """
        scalars = np.zeros(len(self.family.ranges))
        for group in self.groups:
            values = np.array([matrix[place] for place in group.places])
            if not group.polytope.contains(values):
                return False
            scalars[list(group.scalars)] = values
        return bool((np.abs(matrix - self.family.at(scalars)) <= self.radius).all())

    def __str__(self) -> str:
        word = self.label.value.split(":")[0]
        lines = [
            f"{self.vertex_count} vertices ({word}) in place of {self.box_vertex_count} of the "
            f"box of scalars and {self.naive_vertex_count} of the box of entries"
        ]
        return "\n".join([*lines, *(f"  {group}" for group in self.groups)])


def jacobian_polytope(
    split_or_model: Split | Plant,
    wrt: Literal["states", "inputs"] = "states",
    rtol: float = 1e-4,
    effort: Literal["fast", "normal", "tight"] = "normal",
    most_vertices: int | None = None,
) -> JacobianPolytope:
    """Enclose a Jacobian in a product of polytopes, one per group of scalars that share variables.

    Parameters
    ----------
    split_or_model : Split or Plant
        As for `jacobian_bounds`.
    wrt : {"states", "inputs"}
        What to differentiate by.
    rtol : float
        Wanted gap of every support value, relative to the width in its direction.
    effort : {"fast", "normal", "tight"}
        How many boxes branch and bound may use.
    most_vertices : int, optional
        Largest number of vertices of a group; faces that cut off least are given up, with the
        guarantee kept. 4 in the plane and 8 in space are as many as those of a box.

    Returns
    -------
    JacobianPolytope
        Groups of more than three scalars keep the box of their ranges.

    Raises
    ------
    StructureError, UnboundedError, DerivationError
        As `jacobian_bounds`.

    Examples
    --------
    >>> import sympy as sp
    >>> plant = Plant("curve")
    >>> (x,) = plant.states("x", range=(0, 1))
    >>> (u,) = plant.inputs("u", range=(0, 1))
    >>> plant.dynamics([x**3 / 3 + u])
    >>> plant.outputs([x])
    ('y1',)
    >>> found = jacobian_polytope(plant)
    >>> found.vertex_count, str(found.label)[:5]
    (2, 'exact')
    """
    bounds = jacobian_bounds(split_or_model, wrt, min(rtol, 1e-6), effort)
    entries = jacobian_entries(split_or_model, wrt)
    basis = basis_entries(bounds)
    groups = []
    for members in sorted(map(tuple, connected(map(entries.support, basis)))):
        places = tuple(basis[k] for k in members)
        some = entries.take([entries.places.index(place) for place in places])
        groups.append(_group(members, places, bounds, some, (rtol, effort, most_vertices)))
    radius = _radius(bounds.family, groups)
    return JacobianPolytope(bounds.family, tuple(groups), radius, bounds.naive_vertex_count)


def _radius(family: AffineFamily, groups: Sequence[Group]) -> FloatArray:
    """Add up what rounding costs: in the family, in the vertices, in sums formed with them."""
    size, reach = np.zeros(len(family.ranges)), np.zeros(len(family.ranges))
    for group in groups:
        size[list(group.scalars)] = np.abs(group.polytope.vertices).max(axis=0, initial=0.0)
        reach[list(group.scalars)] = group.polytope.radius
    weights = np.abs(family.directions)
    moved = np.tensordot(reach, weights, axes=1)
    magnitude = np.abs(family.constant) + np.tensordot(size, weights, axes=1)
    # entries that are a scalar themselves are copied
    sums = family.radius > 0.0
    total = family.radius + moved
    total = total + np.where(sums, (4 * len(size) + 8) * UNIT_ROUNDOFF * magnitude, 0.0)
    return np.where(total > 0.0, np.nextafter(total * (1.0 + 2.0**-40), np.inf), 0.0)


def basis_entries(bounds: JacobianBounds) -> list[Entry]:
    """List the entries that are the scalars of a family, in its order."""
    dependent = {d.entry for d in bounds.dependences}
    found = []
    for direction in bounds.family.directions:
        (entry,) = [
            (int(i), int(j))
            for i, j in np.argwhere(direction == 1.0)
            if (int(i), int(j)) not in dependent
        ]
        found.append(entry)
    return found


def _box(ranges: FloatArray) -> Polytope:
    """Polytope of a box; coordinates without width have one end only."""
    unit = np.eye(len(ranges))
    ends = [sorted(set(pair)) for pair in ranges.tolist()]
    return Polytope(
        np.vstack([unit, -unit]),
        np.concatenate([ranges[:, 1], -ranges[:, 0]]),
        np.array(list(product(*ends)), dtype=float),
        np.zeros(len(ranges)),
    )


def _group(
    members: tuple[int, ...],
    places: tuple[Entry, ...],
    bounds: JacobianBounds,
    entries: MatrixEntries,
    options: tuple[float, str, int | None],
) -> Group:
    ranges = bounds.family.ranges[list(members)]
    rtol, effort, most = options
    if len(members) == 1:
        tight = bounds.gap[places[0]] <= rtol * (ranges[0, 1] - ranges[0, 0])
        label = Label.EXACT if tight else Label.OUTER
        return Group(members, places, _box(ranges), label, ranges.T.copy())
    width = ranges[:, 1] - ranges[:, 0]
    if len(members) > _LARGEST_GROUP or not (np.isfinite(width) & (width > 0.0)).all():
        return Group(members, places, _box(ranges), Label.OUTER, ranges.T.copy())
    # powers of two bring all scalars to a width between 1 and 2, without rounding
    weight = 2.0 ** -np.floor(np.log2(width))
    directions = np.array(_PLANE if len(members) == 2 else _SPACE, dtype=float)
    single = np.abs(directions).sum(axis=1) == 1.0
    scaled = directions * weight
    found = entries.search(rtol, effort, ca.mtimes(ca.DM(scaled[~single]), entries.values))
    lower, upper = np.empty(len(directions)), np.empty(len(directions))
    lower[~single], upper[~single] = found.lower, found.upper
    for k in np.flatnonzero(single):
        axis = int(np.argmax(directions[k]))
        lower[k], upper[k] = weight[axis] * ranges[axis]
    normals = np.vstack([directions, -directions])
    offsets = np.concatenate([upper, -lower])
    usable = np.isfinite(offsets)
    normals, offsets = normals[usable], offsets[usable]
    attained = entries.at(np.vstack([found.points_lower, found.points_upper])).T
    kept = thin(normals, offsets, (attained * weight).mean(axis=0), most)
    try:
        polytope = polytope_from_halfspaces(normals[kept], offsets[kept])
    except DerivationError as error:
        if getattr(error, "condition", None) != "flat":
            raise
        return Group(members, places, _box(ranges), Label.OUTER, ranges.T.copy())
    back = Polytope(
        polytope.normals * weight,
        polytope.offsets,
        polytope.vertices / weight,
        polytope.radius / weight,
    )
    return Group(members, places, back, Label.OUTER, attained)
