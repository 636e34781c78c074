"""What is read of a plant, and of the options that describe sets of its states."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from obsynth.derive import QPV, qpv
from obsynth.derive.errors import StructureError
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.core.given import PlantClass
from obsynth.designs.core.signals import noise_centre
from obsynth.designs.qpv.error_matrix import ErrorSets, entering, psi_family
from obsynth.designs.qpv.record import FormOfN, NoiseBound, QPVDesign, VertexData
from obsynth.designs.qpv.sets import Ellipsoid, Shape, box, cross, hull, one_of_each_pair
from obsynth.symbolic import Plant, Role
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

CLASS = PlantClass(
    who="the QPV observer",
    time="continuous",
    forbids={
        "d": ": the QPV observer does not decouple unknown inputs; declare a bounded one as a "
        "disturbance, or use BoundedErrorUIO",
        "p": " is only known to an interval; the observer schedules on measured values: give it a "
        "value, or declare it as measured scheduling",
    },
    faults=(Role.ACTUATOR_FAULT, Role.SENSOR_FAULT, Role.PROCESS_FAULT),
)
# Outwards, so that inclusions that hold with equality can be proved in floating point.
OUTWARDS = 1.0 + 2.0**-40
TOLERANCE = 1e-9
# Keeps sums of rounded weights at or below 1.
BELOW_ONE = 1.0 - 2.0**-48


@dataclass(frozen=True, eq=False)
class Derived:
    """What follows from the equations: a quadratic system in states and all faults, f' = 0."""

    form: QPV


@dataclass(frozen=True, eq=False)
class QPVModel(Derived):
    """A plant of the class, and the sets that the options describe.

    region: X; unit: the polytope P_x - c for kappa = 1
    apart: polytope of the errors and corners (r, n) of that of e(0), where they are not P_x's
    Cz (V, n_z, n); noise: None where disturbances and fault rates are not taken into account
    """

    region: Ellipsoid
    unit: Shape
    kappa: float
    apart: tuple[Shape, FloatArray] | None
    Cz: FloatArray
    noise: NoiseBound | None

    @cached_property
    def data(self) -> VertexData:
        """The numbers of the form at the vertices of the scheduling."""
        return VertexData.of(self.form.vertices(), self.Cz, self.noise)

    @property
    def largest_eta(self) -> float:
        """The largest eta with X inside the enlarged polytope, (21)."""
        return min(self.kappa / cover(self.unit, self.region), 1.0)

    def sets(self, eta: float) -> ErrorSets:
        """Return the polytopes for a given eta."""
        base = self.unit.scaled(self.kappa)
        enlarged = base.scaled(OUTWARDS / eta)
        error, start = (enlarged, one_of_each_pair(base.vertices)) if not self.apart else self.apart
        return ErrorSets(self.region.c, enlarged, error, start, *entering(self.data.N))

    def shrunk(self, share: float) -> QPVModel:
        """Return the same problem for a smaller region, its polytopes with it."""
        region = Ellipsoid(share**2 * self.region.Q, self.region.c)
        return replace(self, region=region, unit=self.unit.scaled(share))


def read_form(given: Plant | QPV, form_of_N: FormOfN) -> QPV:
    """Derive the quadratic form, or take the given one, and check what the class asks of it."""
    form = given if isinstance(given, QPV) else qpv(given, form_of_N, augment="all")
    model = form.model
    if len(form.names) != len(model.x) + len(model.f):
        raise StructureError(
            f"the states of the form are {', '.join(form.names)}; the observer needs the plant's "
            f"{len(model.x)} states and all {len(model.f)} faults: use qpv(model, augment='all')",
            symbols=form.names,
        )
    for matrix, signal in zip(form.M, model.u, strict=True):
        if any(matrix):
            raise StructureError(
                f"the input {signal.name} multiplies states, which the class (1)-(2) of the paper "
                "does not have; declare it as a measured scheduling variable, "
                f'plant.scheduling("{signal.name}", range=...)',
                symbols=(signal.name,),
                condition="linear in the inputs",
            )
    known = {*model.names("u"), *(s.name for s in model.rho if s.measured)}
    for variable in form.scheduling:
        hidden = tuple(name for name in variable.signals if name not in known)
        if hidden:
            raise StructureError(
                f"the matrices vary with {variable.expression}, and {', '.join(hidden)} is not "
                "measured, so the gain cannot follow it; declare it with measured=True, or bound "
                "its effect as a disturbance",
                symbols=hidden,
                condition="measured scheduling",
            )
    return form


def read_again(design: QPVDesign) -> Derived:
    """Derive the form from the stored equations."""
    return Derived(qpv(design.plant, design.form_of_N, augment="all"))


def read_region(region: Any, form: QPV) -> Ellipsoid:
    """Return X, one coordinate for every state and fault."""
    if not isinstance(region, Ellipsoid) or region.dimension != len(form.names):
        size = region.dimension if isinstance(region, Ellipsoid) else 0
        raise ObsynthError(
            f"region has {size} coordinates; {len(form.names)} are needed: {', '.join(form.names)}",
            option="region",
        )
    return region


def unit_shape(polytope: Any, region: Ellipsoid) -> Shape:
    """Return the polytope for kappa = 1."""
    if isinstance(polytope, str):
        return (box if polytope == "box" else cross)(region.half_widths)
    if polytope.ndim != 2 or polytope.shape[1] != region.dimension:
        raise ObsynthError(
            f"polytope has shape {polytope.shape}; vertices of {region.dimension} coordinates are "
            "rows, offsets from the centre c",
            option="polytope",
        )
    return hull(polytope)


def reach(unit: Shape, region: Ellipsoid) -> float:
    """Return the largest norm of a vertex in the region's metric: 1 on its boundary."""
    vertices = unit.vertices
    values = np.einsum("ki,ik->k", vertices, np.linalg.solve(region.Q, vertices.T))
    return float(np.sqrt(values.max()))


def cover(unit: Shape, region: Ellipsoid) -> float:
    """Return how much the polytope has to be enlarged to hold the region."""
    normals = unit.normals.mid[:, 0, :]
    return float(np.sqrt(np.einsum("ki,ij,kj->k", normals, region.Q, normals).max()))


def check_polytope(model: QPVModel, eta: float | None) -> QPVModel:
    """Refuse a kappa with which X leaves the enlarged polytope, or P_x leaves X."""
    needed, kappa = cover(model.unit, model.region), model.kappa
    largest = 1.0 / reach(model.unit, model.region)
    smallest = 0.0 if eta is None else eta * needed
    limits = {"kappa": kappa, "smallest": smallest, "largest": largest}
    if kappa < smallest * (1.0 - TOLERANCE):
        raise InfeasibleDesign(
            f"kappa = {kappa:.6g} is too small for eta = {eta:g}: the region X does not "
            "lie in the enlarged polytope of the state, (21)",
            [
                f"kappa has to be at least {smallest:.6g} at this eta",
                f"or eta at most {kappa / needed:.6g} at this kappa",
            ],
            **limits,
        )
    if not model.apart and kappa > largest * (1.0 + TOLERANCE):
        raise InfeasibleDesign(
            f"kappa = {kappa:.6g} is too large: the polytope P_x leaves the region X, "
            "which Assumption 2 of the paper does not allow",
            [f"kappa has to be at most {largest:.6g} for this polytope and region"],
            **limits,
        )
    return model


def read_apart(sides: Any, initial_error: Any, form: QPV) -> tuple[Shape, FloatArray] | None:
    """Read E_x and initial_error: the box of the errors, and corners of the polytope of e(0)."""
    if sides is None:
        return None
    names, n_x = form.names, len(form.model.x)
    n = len(names)
    if sides.shape not in ((n_x,), (n,)) or np.any(sides <= 0):
        raise ObsynthError(
            f"E_x holds {n_x} positive half widths (of the states), or {n} (of states and "
            f"faults); given was {sides.tolist()}",
            option="E_x",
        )
    start = start_corners(initial_error, names)
    missing = [names[k] for k in entering(form.vertices().N)[1] if k >= sides.size]
    if missing:
        raise ObsynthError(
            f"E_x says nothing of {', '.join(missing)}, whose error enters the dynamics "
            f'(form_of_N="{form.form_of_N}"); give {n} half widths',
            option="E_x",
        )
    return box(sides), start


def start_corners(value: FloatArray, names: tuple[str, ...]) -> FloatArray:
    """Read half widths of the box of e(0), or its vertices; one of every pair v, -v."""
    n = len(names)
    if value.ndim == 2 and value.shape[1] == n and len(value):
        return one_of_each_pair(value)
    if value.shape != (n,) or np.any(value < 0):
        raise ObsynthError(
            f"initial_error holds the half widths of {', '.join(names)}, or vertices in rows; "
            f"given was {value.tolist()}",
            option="initial_error",
        )
    ends = [(-side, side) if side > 0 else (0.0,) for side in value.tolist()]
    return one_of_each_pair(np.array(list(itertools.product(*ends))))


def read_performance_output(value: Any, form: QPV) -> FloatArray:
    """Read Cz for every vertex of the scheduling, shape (V, n_z, n)."""
    n, n_x, count = len(form.names), len(form.model.x), form.vertices().count
    if value is None:
        value = np.eye(n)[n_x:] if n > n_x else np.eye(n)
    Cz = np.atleast_2d(np.asarray(value, dtype=float))
    if Cz.ndim == 2:
        Cz = np.broadcast_to(Cz, (count, *Cz.shape)).copy()
    if Cz.shape[0] != count or Cz.shape[2] != n:
        raise ObsynthError(
            f"performance_output has shape {np.shape(value)}; z = Cz e needs {n} columns "
            f"({', '.join(form.names)}), and {count} matrices if it varies",
            option="performance_output",
        )
    return Cz


def read_noise(rate: float | None, model: Plant) -> NoiseBound | None:
    """Weigh disturbances and fault rates for quadratic boundedness at a rate, in equal parts."""
    if rate is None:
        return None
    free = tuple(s.name for s in model.w if not s.bounded)
    if free:
        raise ObsynthError(
            f"alpha_q bounds the error for bounded disturbances, and {', '.join(free)} has no "
            "bound; declare it with bound= or range=",
            option="alpha_q",
            symbols=free,
        )
    centre, w = noise_centre(model), model.box("w")
    radius = np.maximum(w[:, 1] - centre, centre - w[:, 0])
    moving = [k for k, s in enumerate(model.f) if s.rate]
    rates = [float(model.f[k].rate or 0.0) for k in moving]
    both = np.nextafter(np.concatenate([radius, rates]), np.inf)
    if not both.size:
        raise ObsynthError(
            "alpha_q bounds the error under disturbances and fault rates, and the plant has "
            "neither; without them the error decays with alpha",
            option="alpha_q",
        )
    n = len(model.x)
    weights = BELOW_ONE / (both.size * both**2)
    return NoiseBound(rate, weights, both, tuple(n + k for k in moving))


def check_faults(data: VertexData, sets: ErrorSets, names: tuple[str, ...]) -> None:
    """Refuse states and faults that no output shows somewhere in the sets (Section 3)."""
    from scipy.optimize import linprog

    n = data.A.shape[1]
    for vertex in range(len(data.A)):
        members = data.A[vertex] + psi_family(data.N[vertex], sets).mid
        for j in range(n):
            if np.any(data.C[vertex][:, j]):
                continue
            columns = np.unique(np.round(members[:, :, j], 12), axis=0)
            count = len(columns)
            found = linprog(
                np.zeros(count),
                A_eq=np.vstack([columns.T, np.ones(count)]),
                b_eq=np.append(np.zeros(n), 1.0),
                method="highs",
            )
            if found.success:
                raise StructureError(
                    f"{names[j]} is not seen everywhere: what it multiplies reaches zero inside "
                    "the polytopes of state and error, where no output shows it (the persistency "
                    "of excitation of Section 3); move the centre of the region away from zero, "
                    "or make region, E_x or kappa/eta smaller",
                    symbols=(names[j],),
                    vertex=vertex,
                    condition="persistency of excitation",
                )


def default_sets(form: QPV) -> Mapping[str, Any]:
    """Return region, E_x and initial_error by name: docs/methods/qpv_observer.md, Plant class."""
    plant = form.model
    boxes = np.vstack([plant.box("x"), plant.box("f").reshape(-1, 2)])
    loose = [s.name for s in (*plant.x, *plant.f) if not s.bounded]
    if loose:
        raise StructureError(
            f"{', '.join(loose)} has no range, from which region= would follow; declare it with "
            "range=, or give region=Ellipsoid(Q, c), one coordinate for every state and fault",
            symbol=loose[0],
            symbols=tuple(loose),
            condition="a region",
        )
    half, n = 0.5 * np.diff(boxes, axis=1)[:, 0], len(plant.x)
    return {
        "region": Ellipsoid(len(half) * half**2, boxes.mean(axis=1)),
        "E_x": 0.5 * (half[:n] if form.form_of_N == "upper" else half),
        "initial_error": np.append(0.1 * half[:n], np.zeros(len(half) - n)),
    }


def takes_rate(plant: Plant) -> bool:
    """Whether there are disturbances or fault rates, and all disturbances have bounds."""
    moving = any(s.rate for s in plant.f)
    return bool(plant.w or moving) and all(s.bounded for s in plant.w)
