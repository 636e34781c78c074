"""The stored design of the method: plain data from which step and proofs are made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np

from obsynth.derive import AffineFamily
from obsynth.derive.rigour import Enclosure
from obsynth.derive.split import LinearForm
from obsynth.designs.core.errors import CertificateError, InfeasibleDesign
from obsynth.designs.core.record import plain_fields, read_array, read_family, reading
from obsynth.designs.hinf.system import Filter, FilterData, Sector
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray

METHOD = "hinf_uio"
MOST_VERTICES = 2**12
LINEAR_FORMS: tuple[LinearForm, ...] = ("frozen", "terms", "jacobian")


@dataclass(frozen=True, eq=False)
class Bound:
    """What proves the attenuation level.

    mu: |f - fhat| <= mu |w| in the sense of energies, e_0 = 0
    P (n, n): V = e'Pe; with the printed form V = e'Pe + s'Qs
    tau (n_groups,): multipliers; none with vertices or the printed form
    printed (0,) or (2 + n n,): alpha, beta and Q of (45), by rows
    decay: V+ < decay V where w = 0
    tau_decay (n_groups,)
    """

    mu: float
    P: FloatArray
    tau: FloatArray
    printed: FloatArray
    decay: float | None = None
    tau_decay: FloatArray | None = None

    @property
    def Q(self) -> FloatArray:
        """Q of (45), (n, n)."""
        return self.printed[2:].reshape(self.P.shape)


@dataclass(frozen=True, eq=False)
class HinfDesign:
    """Everything that is deployed and proved, in doubles.

    plant: the discrete plant
    linear: how A was chosen, see `obsynth.split`
    x_at, u_at (n,), (n_u,)
    A, B, C, L, W: shapes (n, n), (n, n_u), (m, n), (n, s), (n, n_w)
    A_radius, W_radius: distance of the plant's own coefficients from these doubles
    family: the set of Jacobians of g
    sector: what the multipliers weigh; None for the vertices of the family
    options: the options of the method, as given, and ``least_mu``: what the solver found
    """

    plant: Plant
    linear: LinearForm
    x_at: FloatArray
    u_at: FloatArray
    A: FloatArray
    B: FloatArray
    C: FloatArray
    L: FloatArray
    W: FloatArray
    A_radius: FloatArray
    W_radius: FloatArray
    family: AffineFamily
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
        return FilterData(
            A=self.A,
            C=self.C,
            L=self.L,
            W=self.W,
            H=np.asarray(H, dtype=float),
            n_f=len(self.plant.f),
            null=null,
            A_radius=self.A_radius,
            W_radius=self.W_radius,
            vertices=vertices.mid,
            vertex_radius=np.broadcast_to(vertices.rad, vertices.mid.shape),
            sector=self.sector,
        )

    def to_record(self) -> dict[str, Any]:
        """Return the design as JSON-able data."""
        return plain_fields(self)

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> HinfDesign:
        """Read and check the data of `to_record`."""
        with reading():
            design = _read(record)
        radii = (design.A_radius, design.W_radius)
        if min(float(r.min(initial=0.0)) for r in radii) < 0.0 or not design.bound.mu > 0.0:
            raise CertificateError("a radius is negative, or mu is not positive")
        if not np.array_equal(design.bound.P, design.bound.P.T):
            raise CertificateError("P of the stored design is not symmetric")
        sector = design.sector
        if sector is not None and not set(sector.group) <= set(range(sector.groups)):
            raise CertificateError("a group of the sector has no multiplier")
        return design


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


def _read(record: Mapping[str, Any]) -> HinfDesign:
    plant = Plant.from_dict(record["plant"])
    n, m, n_f = len(plant.x), len(plant.output_names), len(plant.f)
    n_u, n_w, s = len(plant.u), len(plant.w), len(plant.f) + len(plant.d)
    gains, bound, stored = record["gains"], record["bound"], record["sector"]
    sector = None
    if stored is not None:
        group = tuple(int(g) for g in stored["group"])
        R = read_array(stored["R"], (len(stored["R"]), n), "R")
        sector = Sector(read_array(stored["E"], (n, len(group)), "E"), group, R)
    groups = 0 if sector is None else sector.groups
    numbers = 2 + n * n if bound["printed"] else 0
    extra = bound["tau_decay"]
    return HinfDesign(
        plant=plant,
        linear=next(form for form in LINEAR_FORMS if form == record["linear"]),
        x_at=read_array(record["x_at"], (n,), "x_at"),
        u_at=read_array(record["u_at"], (n_u,), "u_at"),
        A=read_array(record["A"], (n, n), "A"),
        B=read_array(record["B"], (n, n_u), "B"),
        C=read_array(record["C"], (m, n), "C"),
        L=read_array(record["L"], (n, s), "L"),
        W=read_array(record["W"], (n, n_w), "W"),
        A_radius=read_array(record["A_radius"], (n, n), "A_radius"),
        W_radius=read_array(record["W_radius"], (n, n_w), "W_radius"),
        family=read_family(record["family"], (n, n)),
        sector=sector,
        gains=Filter(
            K=read_array(gains["K"], (n, m), "K"),
            F=read_array(gains["F"], (n, m), "F"),
            H=read_array(gains["H"], (n_f, m), "H"),
            D=read_array(gains["D"], (n_f, m), "D"),
        ),
        bound=Bound(
            mu=float(bound["mu"]),
            P=read_array(bound["P"], (n, n), "P"),
            tau=read_array(bound["tau"], (0 if numbers else groups,), "tau"),
            printed=read_array(bound["printed"], (numbers,), "alpha, beta and Q"),
            decay=None if bound["decay"] is None else float(bound["decay"]),
            tau_decay=None if extra is None else read_array(extra, (groups,), "tau_decay"),
        ),
        options=dict(record["options"]),
    )
