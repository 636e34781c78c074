"""Families of matrices that are affine in independent scalars, and their vertices."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from obsynth.derive.errors import DerivationError
from obsynth.derive.jacobian.dependence import AffineDependence, entry_name
from obsynth.derive.rigour import UNIT_ROUNDOFF, round_number, up
from obsynth.symbolic.arrays import FloatArray

Entry = tuple[int, int]
_MOST_SCALARS = 16


@dataclass(frozen=True, eq=False)
class AffineFamily:
    """Matrices constant + sum_k s_k directions_k, s_k in ranges_k, up to an elementwise radius.

    Attributes
    ----------
    constant : ndarray, shape (n, k)
        Part that does not vary.
    directions : ndarray, shape (K, n, k)
        One matrix per independent scalar; 1 at the entry that is the scalar.
    ranges : ndarray, shape (K, 2)
        Guaranteed ranges of the scalars.
    radius : ndarray, shape (n, k)
        What the rounding of the coefficients and of the vertices may cost, elementwise.
    labels : tuple of str
        What every scalar is.
    exact : bool
        True when no matrix of the family is superfluous: the scalars depend on disjoint sets of
        variables, so that they take their values independently of each other. False: an outer
        box.

    Notes
    -----
    The family holds the Jacobian at every point of the box. It is convex, so it also holds the
    integral of J(b + t (a - b)) over t in [0, 1], which is the matrix M of g(a) - g(b) = M (a - b)
    that keeps the dependences between rows. (The mean value theorem applied row by row, equation
    (4) of Buciakowski et al., takes a different point in every row, and two entries of the same
    function in two rows would no longer go together.)
    """

    constant: FloatArray
    directions: FloatArray
    ranges: FloatArray
    radius: FloatArray
    labels: tuple[str, ...]
    exact: bool

    @property
    def midpoint(self) -> FloatArray:
        """Matrix at the middle of all ranges, shape (n, k)."""
        return self.constant + np.tensordot(self.ranges.mean(axis=1), self.directions, axes=1)

    @property
    def half_ranges(self) -> FloatArray:
        """Half widths of the ranges, shape (K,)."""
        return 0.5 * (self.ranges[:, 1] - self.ranges[:, 0])

    @property
    def vertex_count(self) -> int:
        """Number of vertices, without making them."""
        return 1 << int((self.ranges[:, 1] > self.ranges[:, 0]).sum())

    @property
    def vertex_radius(self) -> FloatArray:
        """How far a matrix of the family may lie from the hull of the vertices, elementwise."""
        return self.radius

    def at(self, scalars: Sequence[float] | FloatArray) -> FloatArray:
        """Matrix for given scalars.

        Parameters
        ----------
        scalars : array_like, shape (K,)
            Values of the scalars.

        Returns
        -------
        ndarray, shape (n, k)
            The matrix, to within the radius.
        """
        matrix = self.constant.copy()
        for value, direction in zip(scalars, self.directions, strict=True):
            matrix = matrix + value * direction
        return matrix

    def vertices(self) -> FloatArray:
        """Matrices at the corners of the ranges.

        Returns
        -------
        ndarray, shape (N, n, k)
            N = 2^K for K scalars with a range of positive width, the last scalar fastest, lower
            end first.

        Raises
        ------
        DerivationError
            More than 2^16 vertices.
        """
        if self.vertex_count > 2**_MOST_SCALARS:
            raise DerivationError(
                f"the family has {self.vertex_count} vertices, more than a polytopic design can "
                f"use; fix or drop some of the {len(self.ranges)} scalars, or use the entrywise "
                "bounds",
                vertices=self.vertex_count,
            )
        ends = [sorted(set(pair)) for pair in self.ranges.tolist()]
        corners = [self.at(corner) for corner in product(*ends)]
        return np.array(corners).reshape(-1, *self.constant.shape)

    def contains(self, matrix: FloatArray) -> bool:
        """Whether a matrix belongs to the family, up to the radius.

        The scalars are read off the entries that define them; a linear program looks for them
        where there are no such entries.

        Parameters
        ----------
        matrix : ndarray, shape (n, k)
            The matrix.

        Returns
        -------
        bool
            True when scalars in their ranges reproduce it.
        """
        scalars = []
        for direction, (lower, upper) in zip(self.directions, self.ranges, strict=True):
            places = np.argwhere((direction == 1.0) & self._defining(direction))
            if not len(places):
                return self._reaches(matrix)
            scalars.append(min(max(float(matrix[tuple(places[0])]), lower), upper))
        return bool((np.abs(matrix - self.at(scalars)) <= self.radius).all())

    def covers(self, other: "AffineFamily") -> bool:
        """Whether a family with the same constant and directions holds another one.

        Parameters
        ----------
        other : AffineFamily
            The family that has to lie inside.

        Returns
        -------
        bool
            False too where the two do not vary in the same directions.
        """
        return bool(
            self.directions.shape == other.directions.shape
            and np.array_equal(self.directions, other.directions)
            and np.array_equal(self.constant, other.constant)
            and np.all(self.radius >= other.radius)
            and np.all(self.ranges[:, 0] <= other.ranges[:, 0])
            and np.all(self.ranges[:, 1] >= other.ranges[:, 1])
        )

    def _reaches(self, matrix: FloatArray) -> bool:
        """Look for scalars that reproduce a matrix where no entry defines them."""
        from scipy.optimize import linprog

        columns = self.directions.reshape(len(self.directions), -1).T
        rest, slack = (matrix - self.constant).ravel(), self.radius.ravel()
        slack = slack + 8 * UNIT_ROUNDOFF * np.abs(matrix).ravel()
        found = linprog(
            np.zeros(len(self.ranges)),
            np.vstack([columns, -columns]),
            np.concatenate([rest + slack, slack - rest]),
            bounds=self.ranges,
            method="highs",
        )
        return bool(found.status == 0)

    def _defining(self, direction: FloatArray) -> NDArray[np.bool_]:
        alone = np.abs(self.directions).sum(axis=0) == np.abs(direction)
        return np.asarray(alone & (self.constant == 0.0) & (self.radius == 0.0))


def build_family(
    shape: tuple[int, int],
    basis: Sequence[Entry],
    dependences: Sequence[AffineDependence],
    ranges: Mapping[Entry, tuple[float, float]],
    supports: Mapping[Entry, tuple[str, ...]],
    name: str = "m",
) -> AffineFamily:
    """Assemble the family from independent entries and proved dependences.

    Shapes: shape (int, int).
    """
    constant, radius = np.zeros(shape), np.zeros(shape)
    directions = np.zeros((len(basis), *shape))
    position = {entry: k for k, entry in enumerate(basis)}
    for entry, k in position.items():
        directions[k][entry] = 1.0
    for dependence in dependences:
        entry = dependence.entry
        constant[entry], error = round_number(dependence.constant)
        magnitude = abs(constant[entry])
        for other, coefficient in dependence.coefficients.items():
            value, distance = round_number(coefficient)
            directions[position[other]][entry] = value
            largest = max(abs(ranges[other][0]), abs(ranges[other][1]))
            error += distance * largest
            magnitude += abs(value) * largest
        operations = 2 * len(dependence.coefficients)
        exact_sum = len(dependence.coefficients) == 0 or (
            len(dependence.coefficients) == 1
            and constant[entry] == 0.0
            and abs(float(next(iter(dependence.coefficients.values())))) == 1.0
        )
        if not exact_sum:
            error += operations * UNIT_ROUNDOFF * magnitude
        if error > 0.0:
            radius[entry] = up(error * (1.0 + 16 * UNIT_ROUNDOFF))
    seen: set[str] = set()
    disjoint = True
    for entry in basis:
        names = set(supports[entry])
        disjoint = disjoint and not (names & seen)
        seen |= names
    labels = tuple(f"{entry_name(entry, name)}({', '.join(supports[entry])})" for entry in basis)
    return AffineFamily(
        constant,
        directions,
        np.array([ranges[entry] for entry in basis]).reshape(len(basis), 2),
        radius,
        labels,
        disjoint,
    )
