"""Sets of states and errors: the region, polytopes with half-spaces and vertices proved to fit."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive import polytope_from_halfspaces, polytope_from_vertices
from obsynth.derive.errors import DerivationError
from obsynth.derive.rigour import Enclosure
from obsynth.designs.core.record import Context
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError
from obsynth.symbolic.table import Table

Kind = Literal["box", "cross", "hull"]
_MOST = 2**14


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """The points x with (x - c)' Q^-1 (x - c) <= 1, equation (18) of Rotondo et al.

    Parameters
    ----------
    Q : array_like of shape (N, N) or (N,)
        Symmetric and positive definite; a vector is the diagonal.
    c : array_like of shape (N,)
        The centre.

    Raises
    ------
    ObsynthError
        If the shapes do not fit, or Q is not symmetric and positive definite.

    References
    ----------
    Rotondo, Buciakowski, Witczak: Simultaneous state and process fault estimation in LPV systems
    using robust QPV observers.

    Examples
    --------
    >>> region = Ellipsoid([4.0, 1.0], [10.0, 0.0])
    >>> region.value([11.0, 0.5]), region.half_widths.tolist()
    (0.5, [2.0, 1.0])
    """

    Q: Annotated[FloatArray, "N N"]
    c: Annotated[FloatArray, "N"]

    def __init__(self, Q: ArrayLike, c: ArrayLike) -> None:
        centre = _numbers("c", c)
        shape = _numbers("Q", Q)
        if shape.ndim == 1:
            shape = np.diag(shape)
        if centre.ndim != 1 or shape.shape != (centre.size, centre.size):
            raise ObsynthError(
                f"an ellipsoid has Q of shape (N, N) or (N,) and c of shape (N,); given were "
                f"{np.shape(Q)} and {np.shape(c)}",
                Q=np.shape(Q),
                c=np.shape(c),
            )
        if np.any(shape != shape.T):
            raise ObsynthError("Q of an ellipsoid has to be symmetric", Q=shape.tolist())
        lowest = float(np.linalg.eigvalsh(shape)[0])
        if lowest <= 0:
            raise ObsynthError(
                f"Q of an ellipsoid has to be positive definite; its smallest eigenvalue is "
                f"{lowest:.3g}",
                eigenvalue=lowest,
            )
        for array in (shape, centre):
            array.flags.writeable = False
        object.__setattr__(self, "Q", shape)
        object.__setattr__(self, "c", centre)

    @property
    def dimension(self) -> int:
        """Number of coordinates N."""
        return self.c.size

    @property
    def half_widths(self) -> FloatArray:
        """Half widths of the bounding box, sqrt(Q_ii), shape (N,)."""
        return np.sqrt(np.diag(self.Q))

    def value(self, x: ArrayLike) -> float | FloatArray:
        """Return (x - c)' Q^-1 (x - c), at most 1 inside.

        Parameters
        ----------
        x : array_like of shape (N,) or (K, N)

        Returns
        -------
        float or ndarray of shape (K,)
        """
        offset = np.asarray(x, dtype=float) - self.c
        values = np.einsum("...i,...i->...", offset, np.linalg.solve(self.Q, offset.T).T)
        return float(values) if values.ndim == 0 else np.asarray(values)

    def __repr__(self) -> str:
        diagonal = np.diag(np.diag(self.Q))
        Q = np.diag(self.Q).tolist() if np.array_equal(self.Q, diagonal) else self.Q.tolist()
        return f"Ellipsoid(Q={Q}, c={self.c.tolist()})"

    def _repr_html_(self) -> str:
        rows = [*zip(self.c.tolist(), self.half_widths.tolist(), *self.Q.tolist(), strict=True)]
        heads = ("centre c", "half width", *("Q" if j == 0 else "" for j in range(self.dimension)))
        return Table("Ellipsoid (x - c)' Q^-1 (x - c) <= 1", heads, rows)._repr_html_()


def _numbers(name: str, value: ArrayLike) -> FloatArray:
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise ObsynthError(f"{name} of an ellipsoid is no array of numbers: {value!r}") from error
    if not np.isfinite(array).all():
        raise ObsynthError(f"{name} of an ellipsoid has entries that are not finite: {value!r}")
    return array


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
