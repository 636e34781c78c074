"""The stored design of the method: plain data from which step and proofs are made."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Annotated, Any

import numpy as np

from obsynth.derive import AffineFamily
from obsynth.derive.rigour import Enclosure
from obsynth.derive.split import LinearForm
from obsynth.designs.core.errors import CertificateError, InfeasibleDesign
from obsynth.designs.core.record import Design, Record
from obsynth.designs.hinf.system import Filter, FilterData, Sector, SectorForm
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray

MOST_VERTICES = 2**12


@dataclass(frozen=True, eq=False)
class Bound(Record):
    """What proves the attenuation level.

    mu: |f - fhat| <= mu |w| in the sense of energies, e_0 = 0
    P: V = e'Pe; with the printed form V = e'Pe + s'Qs
    tau, tau_decay: multipliers, one per group; none with vertices or the printed form
    printed (0,) or (2 + n n,): alpha, beta and Q of (45), by rows
    decay: V+ < decay V where w = 0
    least_mu: the least level that the solver found, where none was given
    """

    mu: float
    P: Annotated[FloatArray, "n n"]
    tau: Annotated[FloatArray, "n_tau"]
    printed: Annotated[FloatArray, "n_printed"]
    decay: float | None = None
    tau_decay: Annotated[FloatArray | None, "n_tau_decay"] = None
    least_mu: float | None = None

    @property
    def Q(self) -> FloatArray:
        """Q of (45), (n, n)."""
        return self.printed[2:].reshape(self.P.shape)

    def fits(self, groups: int) -> bool:
        """Whether there are as many numbers as the inequalities for so many groups have."""
        if self.printed.size:
            return groups > 0 and not self.tau.size and self.printed.size == 2 + self.P.size
        decays = self.decay is not None
        extra = None if self.tau_decay is None else len(self.tau_decay)
        return len(self.tau) == groups and extra == (groups if decays else None)


@dataclass(frozen=True, eq=False)
class HinfDesign(Design):
    """Everything that is deployed and proved, in doubles.

    linear, x_at, u_at: how and at which point A was chosen, see `obsynth.split`
    A, B, C, L, W: the split; L stacks faults and unknown inputs
    A_radius, W_radius: distance of the plant's own coefficients from these doubles
    family: the set of Jacobians of g
    sector: what the multipliers weigh; None for the vertices of the family
    """

    plant: Plant
    linear: LinearForm
    x_at: Annotated[FloatArray, "n"]
    u_at: Annotated[FloatArray, "n_u"]
    A: Annotated[FloatArray, "n n"]
    B: Annotated[FloatArray, "n n_u"]
    C: Annotated[FloatArray, "m n"]
    L: Annotated[FloatArray, "n n_f+q"]
    W: Annotated[FloatArray, "n n_w"]
    A_radius: Annotated[FloatArray, "n n"]
    W_radius: Annotated[FloatArray, "n n_w"]
    family: Annotated[AffineFamily, "n n"]
    sector_form: SectorForm | None
    sector: Sector | None
    gains: Filter
    bound: Bound
    options: Mapping[str, Any]

    @cached_property
    def data(self) -> FilterData:
        """The numeric data of the error system, the rounding of the vertices enclosed."""
        vertices = enclosed_vertices(self.family, every=self.sector is None)
        CL = self.C @ self.L
        H = np.linalg.solve(CL.T @ CL, CL.T)
        # An exact inverse stays exact where the columns are those of the identity.
        null = np.linalg.svd(CL)[0][:, CL.shape[1] :].T
        null = np.where(np.abs(null) < 1e-15, 0.0, null)
        own = ("A", "C", "L", "W", "A_radius", "W_radius", "sector")
        return FilterData(
            **{name: getattr(self, name) for name in own},
            H=np.asarray(H, dtype=float),
            n_f=len(self.plant.f),
            null=null,
            vertices=vertices.mid,
            vertex_radius=np.broadcast_to(vertices.rad, vertices.mid.shape),
        )

    def check(self) -> None:
        """Refuse numbers that do not fit each other."""
        sector, bound = self.sector, self.bound
        radii = (self.A_radius, self.W_radius)
        if min(float(r.min(initial=0.0)) for r in radii) < 0.0 or not bound.mu > 0.0:
            raise CertificateError("a radius is negative, or mu is not positive")
        if not np.array_equal(bound.P, bound.P.T):
            raise CertificateError("P of the stored design is not symmetric")
        if sector is not None and (
            self.sector_form is None
            or len(sector.group) != sector.E.shape[1]
            or not set(sector.group) <= set(range(sector.groups))
        ):
            raise CertificateError(
                "the sector is not said to be made, or a group has no multiplier"
            )
        if not bound.fits(0 if sector is None else sector.groups):
            raise CertificateError("the stored bound has not one number per group of the sector")


def enclosed_vertices(family: AffineFamily, every: bool = True) -> Enclosure:
    """Enclose the matrices ``constant + sum_k s_k direction_k`` at the corners of the ranges."""
    ends = [sorted(set(pair)) for pair in family.ranges.tolist()]
    if family.vertex_count <= MOST_VERTICES:
        corners = list(product(*ends))
    elif every:
        raise InfeasibleDesign(
            f"the Jacobian has {family.vertex_count} vertices, more than {MOST_VERTICES}",
            ['multipliers="per_entry" needs none of them', "or narrow the ranges of the states"],
            vertices=family.vertex_count,
        )
    else:
        middle = tuple(0.5 * (pair[0] + pair[-1]) for pair in ends)
        corners = [middle]
        for k, pair in enumerate(ends):
            corners += [(*middle[:k], end, *middle[k + 1 :]) for end in pair]
    table = np.array(corners, dtype=float).reshape(len(corners), len(ends))
    return Enclosure.combine(
        Enclosure.of(family.constant, family.radius),
        Enclosure.of(family.directions),
        table,
    )
