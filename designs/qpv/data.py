"""The numbers of a design problem: matrices at the vertices of the scheduling variables, sets."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from obsynth.derive.forms.qpv.form import QPVVertices
from obsynth.derive.forms.qpv.layout import QPVLayout
from obsynth.derive.jacobian.family import AffineFamily
from obsynth.designs.qpv.error_matrix import ErrorSets, psi_kept
from obsynth.designs.qpv.polya import PolyaTerm, collapsed_terms, polya_terms
from obsynth.symbolic.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class VertexData:
    """Matrices of the augmented plant at the V vertices of the scheduling variables.

    A, G, C, H: shapes (V, n, n), (V, n, n_v), (V, m, n), (V, m, n_v), n with the faults;
        disturbances first, then the rates of faults that have one
    N (V, n, n, n): N[l, i] is N_i
    Cz (V, n_z, n): performance output
    A_radius, G_radius, C_radius, H_radius, N_radius: what rounding may add, the same at every
        vertex
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


def read_vertices(family: AffineFamily, layout: QPVLayout, Cz: FloatArray) -> VertexData:
    """Take the blocks from a stacked family. Shapes: Cz (V, n_z, n)."""
    corners = QPVVertices(family, layout)
    return VertexData(
        A=corners.A,
        G=corners.G,
        C=corners.C,
        H=corners.H,
        N=corners.N,
        Cz=Cz,
        A_radius=corners.radius("A"),
        G_radius=corners.radius("G"),
        C_radius=corners.radius("C"),
        H_radius=corners.radius("H"),
        N_radius=corners.radius("N"),
    )
