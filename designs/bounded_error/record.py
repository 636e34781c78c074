"""The stored design of the method: plain data from which step and proofs are made."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Annotated, Any

import numpy as np

from obsynth.derive.jacobian.family import AffineFamily
from obsynth.derive.rigour import Enclosure
from obsynth.derive.split import LinearForm
from obsynth.designs.bounded_error.lmis import ErrorKind, ModelData, kept_coordinates
from obsynth.designs.core.errors import CertificateError
from obsynth.designs.core.record import Design, Record
from obsynth.designs.core.signals import Limits
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray

MOST_VERTICES = 2**16


@dataclass(frozen=True, eq=False)
class EllipsoidBound(Record):
    """One or more invariant ellipsoids ``xi'P xi <= 1`` of the error system.

    error: the error that xi stands for
    P: shape matrices; s is 1 (common) or p (one per component)
    weights: diagonal of Q_v for v scaled by its boxes; every row sums to at most 1
    inverse_diagonal: proved upper bounds of ``(P^-1)_ii`` of the ellipsoid that bounds component i
    """

    KIND = "ellipsoid"

    error: ErrorKind
    P: Annotated[FloatArray, "s p p"]
    gamma: Annotated[FloatArray, "s"]
    weights: Annotated[FloatArray, "s n_v"]
    inverse_diagonal: Annotated[FloatArray, "p"]

    def check(self) -> None:
        """Refuse ellipsoids that are neither one nor one per component."""
        if len(self.P) not in (1, self.P.shape[1]):
            raise CertificateError(
                f"the stored design has {len(self.P)} ellipsoids for {self.P.shape[1]} components"
            )

    def shape_of(self, component: int) -> int:
        """Return the number of the ellipsoid that bounds a component of xi."""
        return 0 if len(self.P) == 1 else component


@dataclass(frozen=True, eq=False)
class UioDesign(Design):
    """Everything that is deployed and proved, in doubles.

    linear, x_at, u_at: how and at which point A was chosen, see `obsynth.split`
    A, B, B_f, C, D, W1, W2: the split
    family: the set of Jacobians of g
    w_centre, w_radius, rate: see `NoiseBox`
    E, T, Pi, K, F: the observer
    rounding: allowance for the rounding errors of one step
    """

    plant: Plant
    linear: LinearForm
    x_at: Annotated[FloatArray, "n"]
    u_at: Annotated[FloatArray, "n_u"]
    A: Annotated[FloatArray, "n n"]
    B: Annotated[FloatArray, "n n_u"]
    B_f: Annotated[FloatArray, "n n_f"]
    C: Annotated[FloatArray, "m n"]
    D: Annotated[FloatArray, "n q"]
    W1: Annotated[FloatArray, "n n_w"]
    W2: Annotated[FloatArray, "m n_w"]
    family: Annotated[AffineFamily, "n n"]
    w_centre: Annotated[FloatArray, "n_w"]
    w_radius: Annotated[FloatArray, "n_w"]
    rate: Annotated[FloatArray, "n_f"]
    E: Annotated[FloatArray, "n m"]
    T: Annotated[FloatArray, "n n"]
    Pi: Annotated[FloatArray, "m m"]
    K: Annotated[FloatArray, "n m"]
    F: Annotated[FloatArray, "n_f m"]
    rounding: Annotated[FloatArray, "n+n_f"]
    bound: EllipsoidBound
    options: Mapping[str, Any]

    @cached_property
    def data(self) -> ModelData:
        """The numeric data of the error system, the rounding of the vertices enclosed."""
        vertices = _enclosed_vertices(self.family)
        names = {one.name for one in fields(ModelData)} & vars(self).keys()
        own = {name: getattr(self, name) for name in names}
        return ModelData(**own, vertices=vertices.mid, vertex_radius=vertices.rad)

    @property
    def limits(self) -> Limits:
        """Where the bound goes on."""
        return Limits.of(self.plant, self.precision)

    def kept(self, error: ErrorKind) -> list[int]:
        """Return which coordinates of x an error of a kind has."""
        return [*range(len(self.A))] if error == "plain" else kept_coordinates(self.T)

    def gain(self, error: ErrorKind) -> FloatArray:
        """Return Kbar = [K; F] in the coordinates of the error system, (p, m)."""
        return np.vstack([self.K[self.kept(error)], self.F])


def _enclosed_vertices(family: AffineFamily) -> Enclosure:
    """All vertices ``constant + sum_k s_k direction_k``, rounding and radius enclosed."""
    if family.vertex_count > MOST_VERTICES:
        raise CertificateError(
            f"the stored family has {family.vertex_count} vertices, more than {MOST_VERTICES}"
        )
    total = Enclosure.of(family.constant[None], family.radius)
    for ends, direction in zip(family.ranges, family.directions, strict=True):
        different = sorted(set(ends.tolist()))
        steps = [total + Enclosure.of(np.array([[end]])) * direction for end in different]
        mid = np.stack([step.mid for step in steps], axis=1).reshape(-1, *direction.shape)
        rad = np.stack([step.rad for step in steps], axis=1).reshape(-1, *direction.shape)
        total = Enclosure(mid, rad)
    return total
