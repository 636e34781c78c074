"""Polytopes about the origin, with half-spaces and vertices that are proved to belong together."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np

from obsynth.derive import polytope_from_halfspaces, polytope_from_vertices
from obsynth.derive.errors import DerivationError
from obsynth.derive.rigour import Enclosure
from obsynth.designs.core.record import Context
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

Kind = Literal["box", "cross", "hull"]
_MOST = 2**14


@dataclass(frozen=True, eq=False)
class Shape:
    """The polytope {e : a_k' e <= 1}, a_k in the rows of `normals`, which holds the origin.

    kind: ``"box"``: |e_i| <= r_i. ``"cross"``: sum |e_i| / r_i <= 1. ``"hull"``: by half-spaces
    data: r of shape (N,), or the half-spaces of shape (K, N) for ``"hull"``
    """

    kind: Kind
    data: FloatArray

    @property
    def dimension(self) -> int:
        """Number of coordinates N."""
        return int(self.data.shape[-1])

    @cached_property
    def _corners(self) -> tuple[FloatArray, FloatArray]:
        n = self.dimension
        if self.kind == "box":
            _check_count(2**n, f"a box of {n} coordinates")
            return _signs(n) * self.data, np.zeros(n)
        if self.kind == "cross":
            return np.vstack([-np.diag(self.data), np.diag(self.data)]) + 0.0, np.zeros(n)
        found = polytope_from_halfspaces(self.data, np.ones(len(self.data)))
        return found.vertices, found.radius

    @property
    def vertices(self) -> FloatArray:
        """Corners, shape (p, N)."""
        return self._corners[0]

    @property
    def radius(self) -> FloatArray:
        """What rounding may add to the corners, by coordinate, shape (N,)."""
        return self._corners[1]

    @cached_property
    def normals(self) -> Enclosure:
        """All a_k, shape (K, 1, N)."""
        n = self.dimension
        if self.kind == "hull":
            return Enclosure.of(self.data[:, None, :])
        one, sides = Enclosure.of(np.ones((1, 1))), Enclosure.of(self.data[None, :])
        inverse = one / sides
        if self.kind == "box":
            unit = np.eye(n)[:, None, :]
            return Enclosure(unit * inverse.mid, unit * inverse.rad)
        _check_count(2 ** (n - 1), f"the half-spaces of a cross-polytope of {n} coordinates")
        half = _signs(n)[2 ** (n - 1) :, None, :]
        return Enclosure(half * inverse.mid, np.abs(half) * inverse.rad)

    @property
    def half_widths(self) -> FloatArray:
        """Half widths of the bounding box, shape (N,)."""
        if self.kind != "hull":
            return self.data
        return np.asarray(np.abs(self.vertices).max(axis=0))

    def scaled(self, factor: float) -> Shape:
        """Return the shape times a positive number."""
        return Shape(self.kind, self.data / factor if self.kind == "hull" else self.data * factor)

    def onto(self, coordinates: Sequence[int]) -> Shape:
        """Project onto some coordinates: what enters an inequality through these only."""
        chosen = list(coordinates)
        if chosen == list(range(self.dimension)):
            return self
        if self.kind != "hull":
            return Shape(self.kind, self.data[chosen])
        return hull(self.vertices[:, chosen])

    @classmethod
    def from_record(cls, stored: Mapping[str, Any], context: Context) -> Shape:
        """Read a stored polytope; a ValueError says what does not fit."""
        data = np.asarray(stored["data"], dtype=float)
        kind = stored["kind"]
        if kind not in get_args(Kind) or data.ndim != (2 if kind == "hull" else 1):
            raise ValueError(f"no polytope: kind {kind!r}, data of shape {data.shape}")
        if not np.isfinite(data).all() or (kind != "hull" and np.any(data <= 0)):
            raise ValueError(f"the data of a {kind} are not positive and finite")
        return cls(kind, data)


def box(half_widths: FloatArray) -> Shape:
    """Return the box |e_i| <= half_widths_i."""
    return Shape("box", np.asarray(half_widths, dtype=float))


def cross(semi_axes: FloatArray) -> Shape:
    """Return the cross-polytope sum |e_i| / semi_axes_i <= 1."""
    return Shape("cross", np.asarray(semi_axes, dtype=float))


def hull(vertices: FloatArray) -> Shape:
    """Return a polytope that holds given points, the origin inside."""
    try:
        found = polytope_from_vertices(vertices)
    except DerivationError as error:
        raise ObsynthError(f"polytope: {error}", vertices=np.shape(vertices)) from error
    if np.any(found.offsets <= 0):
        raise ObsynthError(
            "polytope: the points are offsets from the centre c of the region, and the origin has "
            "to lie inside their hull",
            offset=float(found.offsets.min()),
        )
    return Shape("hull", found.normals / found.offsets[:, None])


def one_of_each_pair(vertices: FloatArray) -> FloatArray:
    """Keep one of every pair v, -v, and those without a mirror image."""
    seen: set[bytes] = set()
    kept = []
    for row in vertices + 0.0:
        if (0.0 - row).tobytes() not in seen:
            seen.add(row.tobytes())
            kept.append(row)
    return np.array(kept)


def _signs(n: int) -> FloatArray:
    return np.array(list(itertools.product((-1.0, 1.0), repeat=n))).reshape(2**n, n)


def _check_count(count: int, what: str) -> None:
    if count > _MOST:
        raise ObsynthError(
            f"{what}: {count} are more than the {_MOST} that a design can state; use "
            'polytope="cross" or give few vertices',
            count=count,
        )
