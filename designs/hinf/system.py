"""The error system of the filter as numbers: what every inequality and proof is formed from.

With q = A e + s + L f + W w the errors are e+ = (I - F C) q - K C e, f - fhat = f - H C q - D C e
(docs/methods/hinf_uio.md, Filter), and f drops out where (I - F C) L = 0 and H C L = I.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np

from obsynth.derive import Majorant
from obsynth.designs.lmi.problem import Arithmetic, lift
from obsynth.symbolic.arrays import FloatArray

Multipliers = Literal["single", "per_row", "per_entry"]
# Covers the rounding of one square.
UP = 1.0 + 2.0**-51
# A given number such as .1089 may be the exact least value: it counts with what branch and bound
# leaves between the bounds that it proves and those that are attained.
ROOM = 1.0 + 2.0**-28
# Smallest unit of a coordinate, as a share of the largest: a state that no disturbance reaches
# within a few steps keeps a unit that is not zero.
LEAST_UNIT = 1e-3
HORIZON = 60


@dataclass(frozen=True, eq=False)
class SectorForm:
    """How a sector is made, see `HinfUIO`; given: the diagonal of M'M, which is only proved."""

    multipliers: Multipliers
    drop_zero_rows: bool = True
    given: tuple[float, ...] | None = None


@dataclass(frozen=True, eq=False)
class Sector:
    """s = E phi, |phi of group g|^2 <= e' diag(R_g) e, with one multiplier per group."""

    E: Annotated[FloatArray, "n k"]
    group: tuple[int, ...]
    R: Annotated[FloatArray, "groups n"]

    @property
    def groups(self) -> int:
        """Number of multipliers."""
        return len(self.R)

    def mask(self, number: int) -> FloatArray:
        """Return the diagonal matrix that picks the phi of one group."""
        return np.diag([1.0 if g == number else 0.0 for g in self.group])


def build_sector(found: Majorant, form: SectorForm) -> Sector | None:
    """Make the sector of a majorant, None where g has no part to bound."""
    n = len(found.diagonal)
    eye = np.eye(n)
    if form.multipliers == "single":
        rows = [part.row for part in found.rows] if form.drop_zero_rows else list(range(n))
        diagonal = found.diagonal if form.given is None else np.array(form.given) * ROOM
        return Sector(eye[:, rows], (0,) * len(rows), diagonal[None]) if rows else None
    if form.multipliers == "per_row":
        rows = [part.row for part in found.rows]
        R = np.array([part.diagonal for part in found.rows])
    else:
        rows = [part.row for part in found.rows for _ in np.flatnonzero(part.entries)]
        columns = [j for part in found.rows for j in np.flatnonzero(part.entries)]
        sizes = found.entry_bounds[rows, columns] if rows else np.zeros(0)
        R = eye[columns] * (sizes**2 * UP)[:, None]
    if not rows:
        return None
    if not form.drop_zero_rows:
        rest = [i for i in range(n) if i not in rows]
        rows, R = rows + rest, np.vstack([R, np.zeros((len(rest), n))])
    return Sector(eye[:, rows], tuple(range(len(rows))), R)


def covers_sector(stored: Sector, derived: Sector | None) -> tuple[bool, float]:
    """Whether a stored sector holds a derived one, and by how much its R is larger."""
    if derived is None:
        return True, float(stored.R.min(initial=0.0))
    if not (np.array_equal(stored.E, derived.E) and stored.group == derived.group):
        return False, -np.inf
    room = float((stored.R - derived.R).min(initial=np.inf))
    return room >= 0.0, room


@dataclass(frozen=True, eq=False)
class Filter:
    """The gains that run."""

    K: Annotated[FloatArray, "n m"]
    F: Annotated[FloatArray, "n m"]
    H: Annotated[FloatArray, "n_f m"]
    D: Annotated[FloatArray, "n_f m"]


@dataclass(frozen=True, eq=False)
class FilterData:
    """Matrices of the plant and what bounds its nonlinearity.

    H (s, m): (C L)^+ in doubles
    n_f: the first n_f columns of L are faults; only their estimates count
    null (m - s, m): rows that see no fault: null C L = 0
    A_radius, W_radius: how far the plant's own coefficients may be from the doubles
    vertices, vertex_radius (N, n, n): of the Jacobian of g; with too many, some matrices of the set
    sector: used in place of the vertices where it is there
    """

    A: FloatArray
    C: FloatArray
    L: FloatArray
    W: FloatArray
    H: FloatArray
    n_f: int
    null: FloatArray
    A_radius: FloatArray
    W_radius: FloatArray
    vertices: FloatArray
    vertex_radius: FloatArray
    sector: Sector | None = None

    @property
    def G(self) -> FloatArray:
        """I - L H C, the projection of the paper."""
        return np.eye(len(self.A)) - self.L @ self.H @ self.C

    @property
    def count(self) -> int:
        """Number of matrix inequalities: 1 with multipliers, else one per vertex."""
        return 1 if self.sector is not None else len(self.vertices)

    def vertex(self, index: int) -> FilterData:
        """Return the same data with one vertex."""
        pick = slice(index, index + 1)
        radius = self.vertex_radius[pick]
        return replace(self, vertices=self.vertices[pick], vertex_radius=radius)

    def dynamics(self, arithmetic: Arithmetic = "float") -> Any:
        """Return A (with multipliers) or A + M at every vertex; at the first one if exact."""
        A = lift(self.A, arithmetic)
        if self.sector is not None:
            return lift(self.A, arithmetic, self.A_radius)
        if arithmetic == "exact":
            return A + lift(self.vertices[0], arithmetic)
        return A + lift(self.vertices, arithmetic, self.vertex_radius)

    def standard_filter(self, K: FloatArray) -> Filter:
        """Return the filter (18)-(19) of the paper with a gain."""
        m = len(self.C)
        return Filter(K, self.L @ self.H, self.H[: self.n_f], np.zeros((self.n_f, m)))

    def closed_loops(self, gains: Filter) -> FloatArray:
        """Return the error's matrix (I - F C)(A + M) - K C at every vertex, shape (N, n, n)."""
        kept = np.eye(len(self.A)) - gains.F @ self.C
        return np.asarray(kept @ (self.A + self.vertices) - gains.K @ self.C)


@dataclass(frozen=True, eq=False)
class Units:
    """Sizes of one unit of x, y, f, phi, powers of two, in which all numbers are about one."""

    x: FloatArray
    y: FloatArray
    f: float
    phi: FloatArray

    def scaled(self, data: FilterData) -> FilterData:
        """Write the data in these units; w keeps its own, and only nominal values are used."""
        x, y, f = self.x, self.y, self.f
        sector = data.sector
        if sector is not None:
            size = self.phi[list(sector.group)]
            E = sector.E * size / x[:, None]
            sector = Sector(E, sector.group, sector.R * x**2 / self.phi[:, None] ** 2)
        return replace(
            data,
            A=data.A * x / x[:, None],
            C=data.C * x / y[:, None],
            L=data.L * f / x[:, None],
            W=data.W / x[:, None],
            H=data.H * y / f,
            null=data.null * y,
            vertices=data.vertices * x / x[:, None],
            sector=sector,
        )

    def filter_to_plant(self, gains: Filter) -> Filter:
        """Write gains found in these units in the plant's."""
        x, y, f = self.x, self.y, self.f
        return Filter(
            gains.K * x[:, None] / y,
            gains.F * x[:, None] / y,
            gains.H * f / y,
            gains.D * f / y,
        )

    def filter_from_plant(self, gains: Filter) -> Filter:
        """Write gains of the plant in these units."""
        return Units(1.0 / self.x, 1.0 / self.y, 1.0 / self.f, self.phi).filter_to_plant(gains)

    def P_to_plant(self, P: FloatArray) -> FloatArray:
        """Write a matrix of V = e'Pe in the plant's units."""
        scaled = self.f**2 * P / np.outer(self.x, self.x)
        return 0.5 * (scaled + scaled.T)

    def tau_to_plant(self, tau: FloatArray) -> FloatArray:
        """Write multipliers in the plant's units."""
        return tau * self.f**2 / self.phi**2


def find_units(data: FilterData, uniform: bool = False) -> Units:
    """Find typical sizes: the covariance of the error under white w of unit intensity."""
    A = data.A + data.vertices.mean(axis=0)
    A = A * min(1.0, 0.9 / max(float(np.abs(np.linalg.eigvals(A)).max()), 1e-9))
    noise = data.W @ data.W.T
    spread = noise
    for _ in range(HORIZON):
        spread = A @ spread @ A.T + noise
    x = _rounded(np.sqrt(np.diag(spread)))
    if uniform:
        x = np.full(len(x), float(_rounded(np.array([np.exp(np.log(x).mean())]))[0]))
    y = _rounded(np.sqrt(np.diag(data.C @ spread @ data.C.T)))
    seen = data.H[: data.n_f] @ data.C
    size = float(np.sqrt(np.trace(seen @ spread @ seen.T)))
    f = float(_rounded(np.array([size]))[0])
    phi = np.ones(0)
    if data.sector is not None:
        phi = _rounded(np.sqrt((data.sector.R * x**2).max(axis=1)), least=0.0)
        phi = x[:1] if uniform else phi
    return Units(x, y, f, phi)


def _rounded(sizes: FloatArray, least: float = LEAST_UNIT) -> FloatArray:
    largest = float(sizes.max(initial=0.0)) or 1.0
    floor = np.maximum(sizes, least * largest)
    return np.exp2(np.round(np.log2(np.where(floor > 0, floor, 1.0))))
