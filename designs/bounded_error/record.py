"""The stored design of the method: plain data from which step and proofs are made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from obsynth.derive.jacobian.family import AffineFamily
from obsynth.derive.rigour import Enclosure
from obsynth.derive.split import LinearForm
from obsynth.designs.bounded_error.error_system import ERRORS, ErrorKind, ModelData
from obsynth.designs.core.record import plain_fields, read_array, read_family, reading
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray

METHOD = "bounded_error_uio"
LINEAR_FORMS: tuple[LinearForm, ...] = ("frozen", "terms", "jacobian")


@dataclass(frozen=True, eq=False)
class EllipsoidBound:
    """One or more invariant ellipsoids ``xi'P xi <= 1`` of the error system.

    error: the error that xi stands for
    P (s, p, p): shape matrices; s is 1 (common) or p (one per component)
    gamma (s,)
    weights (s, n_v): diagonal of Q_v for v scaled by its boxes; every row sums to at most 1
    inverse_diagonal (p,): proved upper bounds of ``(P^-1)_ii`` of the ellipsoid that bounds
        component i
    """

    error: ErrorKind
    P: FloatArray
    gamma: FloatArray
    weights: FloatArray
    inverse_diagonal: FloatArray

    def shape_of(self, component: int) -> int:
        """Return the number of the ellipsoid that bounds a component of xi."""
        return 0 if len(self.P) == 1 else component


@dataclass(frozen=True, eq=False)
class PeakData:
    """Guaranteed peak bounds as stored.

    b (n_o,): bounds of the errors (n + n_f of them), then of the combinations of errors that the
        Jacobian sees, see `PeakSystem.outputs`
    decay: lambda of the exponential tail of the first error
    """

    b: FloatArray
    decay: float


@dataclass(frozen=True, eq=False)
class UioDesign:
    """Everything that is deployed and proved, in doubles.

    plant: the discrete plant
    linear: how A was chosen, see `obsynth.split`
    x_at, u_at (n,), (n_u,): the point at which it was chosen
    A, B, B_f, C, D, W1, W2: the split, shapes (n, n), (n, n_u), (n, n_f), (m, n), (n, q), (n, n_w),
        (m, n_w)
    family: the set of Jacobians of g
    w_centre, w_radius, rate: boxes of disturbances and fault increments
    E, T, Pi, K, F: the observer
    rounding (n + n_f,): allowance for the rounding errors of one step
    options: the options of the method, as given
    """

    plant: Plant
    linear: LinearForm
    x_at: FloatArray
    u_at: FloatArray
    A: FloatArray
    B: FloatArray
    B_f: FloatArray
    C: FloatArray
    D: FloatArray
    W1: FloatArray
    W2: FloatArray
    family: AffineFamily
    w_centre: FloatArray
    w_radius: FloatArray
    rate: FloatArray
    E: FloatArray
    T: FloatArray
    Pi: FloatArray
    K: FloatArray
    F: FloatArray
    rounding: FloatArray
    bound: EllipsoidBound | PeakData
    options: Mapping[str, Any]

    @cached_property
    def data(self) -> ModelData:
        """The numeric data of the error system, the rounding of the vertices enclosed."""
        vertices = _enclosed_vertices(self.family)
        return ModelData(
            A=self.A,
            B_f=self.B_f,
            C=self.C,
            W1=self.W1,
            W2=self.W2,
            E=self.E,
            T=self.T,
            Pi=self.Pi,
            vertices=vertices.mid,
            vertex_radius=vertices.rad,
            w_radius=self.w_radius,
            rate=self.rate,
        )

    @property
    def gain(self) -> FloatArray:
        """Kbar = [K; F], shape (n + n_f, m)."""
        return np.vstack([self.K, self.F])

    def to_record(self) -> dict[str, Any]:
        """Return the design as JSON-able data."""
        record = plain_fields(self)
        record["bound"]["kind"] = "peak" if isinstance(self.bound, PeakData) else "ellipsoid"
        return record

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> UioDesign:
        """Read and check the data of `to_record`."""
        with reading():
            plant = Plant.from_dict(record["plant"])
            sizes = _sizes(plant)
            arrays = {
                name: read_array(record[name], tuple(sizes[letter] for letter in letters), name)
                for name, letters in _SHAPES.items()
            }
            n = sizes["n"]
            return cls(
                plant=plant,
                linear=_read_linear(record["linear"]),
                family=read_family(record["family"], (n, n)),
                bound=_read_bound(record["bound"]),
                options=dict(record["options"]),
                **arrays,
            )


_SHAPES: Mapping[str, tuple[str, ...]] = {
    "x_at": ("n",),
    "u_at": ("n_u",),
    "A": ("n", "n"),
    "B": ("n", "n_u"),
    "B_f": ("n", "n_f"),
    "C": ("m", "n"),
    "D": ("n", "q"),
    "W1": ("n", "n_w"),
    "W2": ("m", "n_w"),
    "w_centre": ("n_w",),
    "w_radius": ("n_w",),
    "rate": ("n_f",),
    "E": ("n", "m"),
    "T": ("n", "n"),
    "Pi": ("m", "m"),
    "K": ("n", "m"),
    "F": ("n_f", "m"),
    "rounding": ("n_e",),
}


def _enclosed_vertices(family: AffineFamily) -> Enclosure:
    """All vertices ``constant + sum_k s_k direction_k``, rounding and radius enclosed."""
    total = Enclosure.of(family.constant[None], family.radius)
    for ends, direction in zip(family.ranges, family.directions, strict=True):
        different = sorted(set(ends.tolist()))
        steps = [total + Enclosure.of(np.array([[end]])) * direction for end in different]
        mid = np.stack([step.mid for step in steps], axis=1).reshape(-1, *direction.shape)
        rad = np.stack([step.rad for step in steps], axis=1).reshape(-1, *direction.shape)
        total = Enclosure(mid, rad)
    return total


def _sizes(plant: Plant) -> dict[str, int]:
    n, n_f = len(plant.x), len(plant.f)
    return {
        "n": n,
        "n_u": len(plant.u),
        "n_f": n_f,
        "m": len(plant.output),
        "q": len(plant.d),
        "n_w": len(plant.w),
        "n_e": n + n_f,
    }


def _read_linear(value: Any) -> LinearForm:
    for form in LINEAR_FORMS:
        if value == form:
            return form
    raise ValueError(f"linear = {value!r}")


def _read_bound(record: Mapping[str, Any]) -> EllipsoidBound | PeakData:
    if record["kind"] == "peak":
        return PeakData(np.asarray(record["b"], dtype=float), float(record["decay"]))
    if record["kind"] != "ellipsoid" or record["error"] not in ERRORS:
        raise ValueError(f"bound of kind {record['kind']!r}, error {record.get('error')!r}")
    names = ("P", "gamma", "weights", "inverse_diagonal")
    arrays = {name: np.asarray(record[name], dtype=float) for name in names}
    return EllipsoidBound(error=record["error"], **arrays)
