"""The stored design of the method: plain data from which step and proofs are made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.derive import AffineFamily
from obsynth.derive.split import LinearForm
from obsynth.designs.errors import CertificateError, InfeasibleDesign
from obsynth.designs.hinf.system import Filter, FilterData, Sector
from obsynth.designs.lmi import Enclosure
from obsynth.symbolic import Plant

__all__ = ["METHOD", "Bound", "HinfDesign", "enclosed_vertices"]

METHOD = "hinf_uio"
MOST_VERTICES = 2**12
LINEAR_FORMS: tuple[LinearForm, ...] = ("frozen", "terms", "jacobian")
FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Bound:
    """What proves the attenuation level.

    Attributes
    ----------
    mu : float
        |f - fhat| <= mu |w| in the sense of energies, e_0 = 0.
    P : ndarray of shape (n, n)
        V = e'Pe; with the printed form V = e'Pe + s'Qs.
    tau : ndarray of shape (n_groups,)
        Multipliers; none with vertices or the printed form.
    printed : ndarray of shape (0,) or (2 + n n,)
        alpha, beta and Q of (45), by rows.
    decay : float or None
        V+ < decay V where w = 0.
    tau_decay : ndarray of shape (n_groups,)
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

    Attributes
    ----------
    plant : Plant
        The discrete plant.
    linear : str
        How A was chosen, see `obsynth.split`.
    x_at, u_at : ndarray of shape (n,), (n_u,)
    A, B, C, L, W : ndarray
        Shapes (n, n), (n, n_u), (m, n), (n, s), (n, n_w).
    A_radius, W_radius : ndarray
        Distance of the plant's own coefficients from these doubles.
    family : AffineFamily
        The set of Jacobians of g.
    sector : Sector or None
        What the multipliers weigh; None for the vertices of the family.
    gains : Filter
    bound : Bound
    options : mapping
        The options of the method, as given, and ``least_mu``: what the solver found.
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
        record: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            record[field.name] = value.to_dict() if isinstance(value, Plant) else _plain(value)
        return record

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> HinfDesign:
        """Read and check the data of `to_record`.

        Raises
        ------
        CertificateError
            If an entry is missing, not finite, or of the wrong shape.
        """
        try:
            design = _read(record)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise CertificateError(f"the stored design cannot be read: {error!r}") from error
        design.check_shapes()
        return design

    def check_shapes(self) -> None:
        """Refuse what does not fit the plant or is not finite."""
        plant = self.plant
        n, m, n_f = len(plant.x), len(plant.output_names), len(plant.f)
        s, n_w = n_f + len(plant.d), len(plant.w)
        groups = 0 if self.sector is None else self.sector.groups
        k = 0 if self.sector is None else len(self.sector.group)
        printed = self.bound.printed.size
        table: list[tuple[str, FloatArray, tuple[int, ...]]] = [
            ("A", self.A, (n, n)),
            ("B", self.B, (n, len(plant.u))),
            ("C", self.C, (m, n)),
            ("L", self.L, (n, s)),
            ("W", self.W, (n, n_w)),
            ("A_radius", self.A_radius, (n, n)),
            ("W_radius", self.W_radius, (n, n_w)),
            ("K", self.gains.K, (n, m)),
            ("F", self.gains.F, (n, m)),
            ("H", self.gains.H, (n_f, m)),
            ("D", self.gains.D, (n_f, m)),
            ("P", self.bound.P, (n, n)),
            ("printed", self.bound.printed, (2 + n * n if printed else 0,)),
            ("tau", self.bound.tau, (0 if printed else groups,)),
        ]
        if self.bound.tau_decay is not None:
            table.append(("tau_decay", self.bound.tau_decay, (groups,)))
        if self.sector is not None:
            table += [("E", self.sector.E, (n, k)), ("R", self.sector.R, (groups, n))]
        for name, value, shape in table:
            if value.shape != shape and value.size + np.prod(shape) > 0:
                raise CertificateError(
                    f"{name} has shape {value.shape} in the stored design; {shape} is needed"
                )
            if not np.all(np.isfinite(value)):
                raise CertificateError(f"{name} of the stored design is not finite")
        radii = [self.A_radius, self.W_radius, self.family.radius]
        if min(float(r.min(initial=0.0)) for r in radii) < 0.0 or not self.bound.mu > 0.0:
            raise CertificateError("a radius is negative, or mu is not positive")
        if not np.array_equal(self.bound.P, self.bound.P.T):
            raise CertificateError("P of the stored design is not symmetric")
        if self.sector is not None and not set(self.sector.group) <= set(range(groups)):
            raise CertificateError("a group of the sector has no multiplier")


def enclosed_vertices(family: AffineFamily, every: bool = True) -> Enclosure:
    """Enclose the matrices ``constant + sum_k s_k direction_k`` at the corners of the ranges.

    Parameters
    ----------
    family : AffineFamily
    every : bool
        False: above `MOST_VERTICES` corners, take the middle and the ends of one range at a time
        instead, which lie in the family too.

    Raises
    ------
    InfeasibleDesign
        If there are more vertices than a design can use.
    """
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


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, AffineFamily | Sector | Filter | Bound):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, tuple):
        return [_plain(entry) for entry in value]
    return value


def _array(value: Any) -> FloatArray:
    return np.asarray(value, dtype=float)


def _read(record: Mapping[str, Any]) -> HinfDesign:
    plant = Plant.from_dict(record["plant"])
    n, m, n_f = len(plant.x), len(plant.output_names), len(plant.f)
    linear = next(form for form in LINEAR_FORMS if form == record["linear"])
    stored = record["family"]
    family = AffineFamily(
        constant=_array(stored["constant"]),
        directions=_array(stored["directions"]).reshape(-1, n, n),
        ranges=_array(stored["ranges"]).reshape(-1, 2),
        radius=_array(stored["radius"]),
        labels=tuple(stored["labels"]),
        exact=bool(stored["exact"]),
    )
    sector = None
    if record["sector"] is not None:
        group = tuple(int(g) for g in record["sector"]["group"])
        sector = Sector(_array(record["sector"]["E"]), group, _array(record["sector"]["R"]))
    bound = record["bound"]
    extra = bound["tau_decay"]
    return HinfDesign(
        plant=plant,
        linear=linear,
        x_at=_array(record["x_at"]),
        u_at=_array(record["u_at"]),
        B=_array(record["B"]).reshape(n, len(plant.u)),
        L=_array(record["L"]).reshape(n, n_f + len(plant.d)),
        family=family,
        sector=sector,
        gains=Filter(
            K=_array(record["gains"]["K"]).reshape(n, m),
            F=_array(record["gains"]["F"]).reshape(n, m),
            H=_array(record["gains"]["H"]).reshape(n_f, m),
            D=_array(record["gains"]["D"]).reshape(n_f, m),
        ),
        bound=Bound(
            mu=float(bound["mu"]),
            P=_array(bound["P"]),
            tau=_array(bound["tau"]),
            printed=_array(bound["printed"]),
            decay=None if bound["decay"] is None else float(bound["decay"]),
            tau_decay=None if extra is None else _array(extra),
        ),
        options=dict(record["options"]),
        **{name: _array(record[name]) for name in ("A", "C", "W", "A_radius", "W_radius")},
    )
