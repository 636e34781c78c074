"""The stored design of the method: plain data from which step and proofs are made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np

from obsynth.derive.forms.qpv.form import QPVLayout
from obsynth.derive.forms.varying import Vertices
from obsynth.derive.jacobian.family import AffineFamily
from obsynth.designs.core.errors import CertificateError
from obsynth.designs.core.record import Design, Record
from obsynth.designs.qpv.error_matrix import ErrorSets, entering, psi_kept
from obsynth.designs.qpv.lmis import PolyaTerm, collapsed_terms, polya_terms
from obsynth.designs.qpv.sets import Ellipsoid, Shape
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray

Norm = Literal["h2", "hinf"]
FormOfN = Literal["upper", "symmetric"]
FASTEST = 1.0
"""Largest product of sample time and modulus of a mode.

A Runge-Kutta step of order four then errs by less than one per cent of the change of that mode,
and is far from its limit of stability.
"""


ASSUMED = 2.0**-40
"""What rounding in doubles is assumed to add where no bound of it is of use."""


@dataclass(frozen=True, eq=False)
class VertexData:
    """Matrices of the augmented plant at the V vertices of the scheduling variables.

    G, H (V, n, n_v), (V, m, n_v): disturbances first, then the rates of faults that have one
    N (V, n, n, n): N[l, i] is N_i
    A_radius, ...: what rounding may add, the same at every vertex
    """

    A: FloatArray
    G: FloatArray
    C: FloatArray
    H: FloatArray
    N: FloatArray
    Cz: FloatArray
    A_radius: FloatArray
    G_radius: FloatArray
    C_radius: FloatArray
    H_radius: FloatArray
    N_radius: FloatArray

    @classmethod
    def of(cls, corners: Vertices, Cz: FloatArray, noise: NoiseBound | None) -> VertexData:
        """Take the blocks of a form, and the rates of faults as disturbances where bounded."""
        blocks = {name: getattr(corners, name) for name in ("A", "G", "C", "H", "N")}
        radii = {f"{name}_radius": corners.radius(name) for name in blocks}
        data = cls(Cz=Cz, **blocks, **radii)
        return data if noise is None else data.with_rates(list(noise.faults))

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers of states with faults, outputs, disturbances."""
        return self.A.shape[1], self.C.shape[1], self.G.shape[2]

    @property
    def collapses(self) -> bool:
        """Whether C and H are the same at all vertices, so that double sums are single ones."""
        return bool((self.C[0] == self.C).all() and (self.H[0] == self.H).all())

    def terms(self, polya: int | None) -> tuple[PolyaTerm, ...]:
        """Terms of the relaxation; collapsed where that is exact, of order 2 by default."""
        count = len(self.A)
        if self.collapses or count == 1:
            return collapsed_terms(count)
        return polya_terms(count, 2 if polya is None else polya)

    def scaled(self, half: FloatArray) -> VertexData:
        """Rewrite for errors in units of `half`; radii are dropped, since this only guides."""
        return replace(
            self,
            A=self.A * half / half[:, None],
            G=self.G / half[:, None],
            C=self.C * half,
            Cz=self.Cz * half,
        )

    def psi(self, sets: ErrorSets) -> FloatArray:
        """Extreme values of Psi, shape (V, kept, n, n)."""
        return psi_kept(self.N, sets)

    def with_rates(self, faults: list[int]) -> VertexData:
        """Add one disturbance for the rate of change of each of some states."""
        vertices, n = self.A.shape[:2]
        m = self.C.shape[1]
        more = np.eye(n)[:, faults]
        still = np.zeros((vertices, m, len(faults)))
        return replace(
            self,
            G=np.concatenate([self.G, np.broadcast_to(more, (vertices, *more.shape))], axis=2),
            H=np.concatenate([self.H, still], axis=2),
            G_radius=np.hstack([self.G_radius, np.zeros_like(more)]),
            H_radius=np.hstack([self.H_radius, np.zeros((m, len(faults)))]),
        )


@dataclass(frozen=True, eq=False)
class NoiseBound(Record):
    """Bounded disturbances of a design by quadratic boundedness.

    rate: alpha_q: V' <= alpha_q (1 - V)
    weights: diagonal of W; every admissible v has v'W v <= 1
    radius: largest |v_i|: disturbances about their centre, then rates of faults
    faults: positions among the augmented states of the faults whose rates are in v
    """

    rate: float
    weights: Annotated[FloatArray, "n_v"]
    radius: Annotated[FloatArray, "n_v"]
    faults: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class QPVDesign(Design):
    """Everything that is deployed and proved, in doubles; states of the form are states, faults.

    family: the stacked matrices of the quadratic form, affine in the scheduling variables
    scheduling: the scheduling variables as expressions of inputs and scheduling signals
    region: X, in which the augmented state is assumed to stay
    state, error, start: polytopes of x - c and e, corners of that of e(0), see `ErrorSets`
    alpha: decay of V without disturbances
    w_centre: middle of the declared disturbances
    L: gains at the vertices of the scheduling
    gamma: proved bound of the squared L2 gain, where it is claimed
    rows, inverse_diagonal: proved upper bounds of the diagonals of Cz P^-1 Cz' and P^-1
    reset: X - c lies in {e'P e <= reset^2}, proved
    rounding: what rounding of all steps adds to the root of V at most, see `rounding`; `ASSUMED`
        where that is not proved, 0 where no set follows from V
    """

    plant: Plant
    form_of_N: FormOfN
    family: Annotated[AffineFamily, "n+n_f+m columns"]
    scheduling: tuple[str, ...]
    region: Ellipsoid
    state: Shape
    error: Shape
    start: Annotated[FloatArray, "r n+n_f"]
    eta: float
    kappa: float
    norm: Norm
    alpha: float
    noise: NoiseBound | None
    polya: int | None
    Cz: Annotated[FloatArray, "V n_z n+n_f"]
    w_centre: Annotated[FloatArray, "n_w"]
    P: Annotated[FloatArray, "n+n_f n+n_f"]
    L: Annotated[FloatArray, "V n+n_f m"]
    gamma: float | None
    rows: Annotated[FloatArray, "V n_z"]
    inverse_diagonal: Annotated[FloatArray, "n+n_f"]
    reset: float
    Ts: float
    rounding: float
    options: Mapping[str, Any]

    @cached_property
    def layout(self) -> QPVLayout:
        """Where the blocks of the family are."""
        plant = self.plant
        n = len(plant.x) + len(plant.f)
        return QPVLayout.of(n, len(plant.output), len(plant.u), 0, 0, len(plant.w))

    @cached_property
    def data(self) -> VertexData:
        """Matrices at the vertices, rates of faults included where they are bounded."""
        return VertexData.of(Vertices(self.family, self.layout), self.Cz, self.noise)

    @cached_property
    def sets(self) -> ErrorSets:
        """The polytopes over which the inequalities hold."""
        sets = self.region.c, self.state, self.error, self.start
        return ErrorSets(*sets, *entering(self.data.N))

    @property
    def bounded(self) -> bool:
        """Whether the error is bounded at all times: by `noise`, or without disturbances."""
        return self.noise is not None or not self.plant.w

    @property
    def trace(self) -> float:
        """Proved bound of trace(Cz P^-1 Cz')."""
        return float(self.rows.sum(axis=1).max(initial=0.0))

    @cached_property
    def fastest_mode(self) -> float:
        """The largest modulus of an eigenvalue of A + Psi - L C, over vertices, in 1/s."""
        data = self.data
        largest = 0.0
        for A, members, gain in zip(data.A, data.psi(self.sets), self.L, strict=True):
            for C in np.unique(data.C, axis=0):
                modes = np.linalg.eigvals(A + members - gain @ C)
                largest = max(largest, float(np.abs(modes).max()))
        return largest

    def check(self) -> None:
        """Refuse sizes, coordinates and numbers that annotations do not tell."""
        layout, noise = self.layout, self.noise
        n, n_x = layout.states, len(self.plant.x)
        sizes = {
            "columns of family": (self.family.constant.shape[1], layout.shape[1]),
            "gains L": (len(self.L), self.family.vertex_count),
            "ranges of family": (len(self.family.ranges), len(self.scheduling)),
            "coordinates of region": (self.region.dimension, n),
            "coordinates of state": (self.state.dimension, n),
        }
        if noise is not None:
            wanted = layout.widths["w"] + len(noise.faults)
            sizes["noise weights"] = (noise.weights.size, wanted)
        for name, (found, needed) in sizes.items():
            if found != needed:
                raise CertificateError(
                    f"the stored design has {found} {name}; the plant needs {needed}"
                )
        if noise is not None and not all(n_x <= k < n for k in noise.faults):
            raise CertificateError(f"noise.faults of the stored design are {noise.faults}")
        if len(np.unique(self.start, axis=0)) != len(self.start):
            raise CertificateError("a corner of start is twice in the stored design")
        if not max(self.sets.error_entering, default=-1) < self.error.dimension <= n:
            raise CertificateError(
                f"the polytope of the error has {self.error.dimension} of {n} coordinates; those "
                f"that enter are {self.sets.error_entering}"
            )
        if self.Ts <= 0 or self.alpha < 0 or self.rounding < 0:
            raise CertificateError("alpha, Ts or rounding of the stored design is negative")
        if self.precision == "single" and self.rounding == ASSUMED:
            raise CertificateError(
                "what rounding adds in single precision is assumed in the stored design"
            )
        if (self.gamma is None) == (self.norm == "hinf"):
            raise CertificateError("gamma of the stored design belongs to norm 'hinf'")
