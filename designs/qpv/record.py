"""The stored design of the method: plain data from which step and proofs are made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from obsynth.derive.forms.qpv.layout import QPVLayout
from obsynth.derive.jacobian.family import AffineFamily
from obsynth.designs.core.errors import CertificateError
from obsynth.designs.core.record import plain_fields, read_family, reading
from obsynth.designs.qpv.data import VertexData, read_vertices
from obsynth.designs.qpv.error_matrix import ErrorSets, entering
from obsynth.designs.qpv.polytopes import Shape
from obsynth.designs.qpv.region import Ellipsoid
from obsynth.designs.qpv.synthesis import Norm
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray

METHOD = "qpv_observer"


@dataclass(frozen=True, eq=False)
class NoiseBound:
    """Bounded disturbances of a design by quadratic boundedness.

    rate: alpha_q: V' <= alpha_q (1 - V)
    weights (n_v,): diagonal of W; every admissible v has v'W v <= 1
    radius (n_v,): largest |v_i|: disturbances about their centre, then rates of faults
    faults: positions among the augmented states of the faults whose rates are in v
    """

    rate: float
    weights: FloatArray
    radius: FloatArray
    faults: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class QPVDesign:
    """Everything that is deployed and proved, in doubles.

    plant: the continuous plant
    form_of_N: see `obsynth.qpv`
    family: the stacked matrices of the quadratic form, affine in the scheduling variables
    scheduling: the scheduling variables as expressions of inputs and scheduling signals
    region: X, in which the augmented state is assumed to stay
    state, error: polytopes of x - c and of e, see `ErrorSets`
    start (r, n): corners of the polytope of e(0)
    alpha: decay of V without disturbances
    Cz (V, n_z, n)
    w_centre (n_w,): middle of the declared disturbances
    P (n, n)
    L (V, n, m)
    gamma: proved bound of the squared L2 gain; infinite where it is not claimed
    rows (V, n_z): proved upper bounds of the diagonal of Cz P^-1 Cz'
    inverse_diagonal (n,): proved upper bounds of (P^-1)_ii
    reset: X - c lies in {e'P e <= reset^2}, proved
    Ts: sample time of the step
    options: the options of the method, as given
    """

    plant: Plant
    form_of_N: str
    family: AffineFamily
    scheduling: tuple[str, ...]
    region: Ellipsoid
    state: Shape
    error: Shape
    error_coordinates: tuple[int, ...]
    start: FloatArray
    norm: Norm
    alpha: float
    noise: NoiseBound | None
    polya: int | None
    Cz: FloatArray
    w_centre: FloatArray
    P: FloatArray
    L: FloatArray
    gamma: float
    rows: FloatArray
    inverse_diagonal: FloatArray
    reset: float
    Ts: float
    options: Mapping[str, Any]

    @cached_property
    def layout(self) -> QPVLayout:
        """Where the blocks of the family are."""
        plant = self.plant
        return QPVLayout(
            len(plant.x) + len(plant.f),
            len(plant.output),
            len(plant.u),
            0,
            0,
            len(plant.w),
        )

    @cached_property
    def data(self) -> VertexData:
        """Matrices at the vertices, rates of faults included where they are bounded."""
        data = read_vertices(self.family, self.layout, self.Cz)
        return data if self.noise is None else data.with_rates(list(self.noise.faults))

    @cached_property
    def sets(self) -> ErrorSets:
        """The polytopes over which the inequalities hold."""
        state, error = entering(self.data.N)
        return ErrorSets(
            self.region.c,
            self.state,
            self.error,
            self.error_coordinates,
            self.start,
            state,
            error,
        )

    @property
    def bounded(self) -> bool:
        """Whether the error is bounded at all times: by `noise`, or without disturbances."""
        return self.noise is not None or not self.plant.w

    def to_record(self) -> dict[str, Any]:
        """Return the design as JSON-able data."""
        gamma = self.gamma if np.isfinite(self.gamma) else None
        return {**plain_fields(self), "gamma": gamma}

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> QPVDesign:
        """Read and check the data of `to_record`."""
        with reading():
            design = cls._read(record)
        design._check()
        return design

    @classmethod
    def _read(cls, record: Mapping[str, Any]) -> QPVDesign:
        noise = record["noise"]
        shape = np.asarray(record["family"]["constant"], dtype=float).shape
        family = read_family(record["family"], (shape[0], shape[1]))
        norm: Norm = "hinf" if record["norm"] == "hinf" else "h2"
        if record["norm"] != norm or record["form_of_N"] not in ("upper", "symmetric"):
            raise ValueError(f"norm {record['norm']!r}, form_of_N {record['form_of_N']!r}")
        region = record["region"]
        return cls(
            plant=Plant.from_dict(record["plant"]),
            form_of_N=str(record["form_of_N"]),
            family=family,
            scheduling=tuple(map(str, record["scheduling"])),
            region=Ellipsoid(region["Q"], region["c"]),
            state=Shape.from_record(record["state"]),
            error=Shape.from_record(record["error"]),
            error_coordinates=tuple(map(int, record["error_coordinates"])),
            start=np.asarray(record["start"], dtype=float),
            norm=norm,
            alpha=float(record["alpha"]),
            noise=None
            if noise is None
            else NoiseBound(
                float(noise["rate"]),
                np.asarray(noise["weights"], dtype=float),
                np.asarray(noise["radius"], dtype=float),
                tuple(map(int, noise["faults"])),
            ),
            polya=None if record["polya"] is None else int(record["polya"]),
            Cz=np.asarray(record["Cz"], dtype=float),
            w_centre=np.asarray(record["w_centre"], dtype=float),
            P=np.asarray(record["P"], dtype=float),
            L=np.asarray(record["L"], dtype=float),
            gamma=np.inf if record["gamma"] is None else float(record["gamma"]),
            rows=np.asarray(record["rows"], dtype=float),
            inverse_diagonal=np.asarray(record["inverse_diagonal"], dtype=float),
            reset=float(record["reset"]),
            Ts=float(record["Ts"]),
            options=dict(record["options"]),
        )

    def _check(self) -> None:
        layout, count = self.layout, self.family.vertex_count
        n, m, n_w = layout.states, layout.outputs, layout.disturbances
        n_z = self.Cz.shape[1] if self.Cz.ndim == 3 else -1
        shapes = {
            "family": (self.family.constant, layout.shape),
            "radius": (self.family.radius, layout.shape),
            "c": (self.region.c, (n,)),
            "start": (self.start, (len(self.start), n)),
            "Cz": (self.Cz, (count, n_z, n)),
            "w_centre": (self.w_centre, (n_w,)),
            "P": (self.P, (n, n)),
            "L": (self.L, (count, n, m)),
            "rows": (self.rows, (count, n_z)),
            "inverse_diagonal": (self.inverse_diagonal, (n,)),
            "ranges": (self.family.ranges, (len(self.scheduling), 2)),
        }
        if self.noise is not None:
            shapes["noise weights"] = (self.noise.weights, (n_w + len(self.noise.faults),))
            shapes["noise radius"] = (self.noise.radius, self.noise.weights.shape)
        for name, (value, shape) in shapes.items():
            if value.shape != shape:
                raise CertificateError(
                    f"{name} has shape {value.shape} in the stored design; the plant needs {shape}"
                )
            if not np.all(np.isfinite(value)):
                raise CertificateError(f"{name} of the stored design is not finite")
        places = self.error_coordinates
        if self.state.dimension != n or self.error.dimension != len(places):
            raise CertificateError("the stored polytopes do not have the plant's coordinates")
        missing = set(self.sets.error_entering) - set(places)
        if missing or not all(0 <= k < n for k in places) or len(set(places)) != len(places):
            raise CertificateError(
                f"the polytope of the error is in the coordinates {places}; those that enter are "
                f"{self.sets.error_entering}"
            )
        numbers = (self.alpha, self.reset, self.Ts)
        if not (np.isfinite(numbers).all() and self.Ts > 0 and self.alpha >= 0):
            raise CertificateError("alpha, reset and Ts of the stored design are no usable numbers")
