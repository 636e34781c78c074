"""From a plant to the numbers of the method, what is outside its class refused first."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from obsynth.derive import QPV, qpv
from obsynth.derive.errors import StructureError
from obsynth.designs.qpv.data import VertexData, read_vertices
from obsynth.designs.qpv.error_matrix import ErrorSets, psi_family
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class Prepared:
    """A plant of the class with its quadratic form.

    form: every fault is a state
    vertices: number of vertices of the scheduling variables
    """

    form: QPV
    vertices: int

    @property
    def model(self) -> Plant:
        """The continuous plant."""
        return self.form.model

    @property
    def names(self) -> tuple[str, ...]:
        """Names of states and faults."""
        return self.form.names

    def data(self, Cz: FloatArray) -> VertexData:
        """Return the matrices with a performance output."""
        return read_vertices(self.form.vertices().family, self.form.layout, Cz)


def derive_form(model: Plant, form_of_N: str) -> QPV:
    """Write the plant as a quadratic system in states and all faults, f' = 0."""
    kind: Literal["upper", "symmetric"] = "symmetric" if form_of_N == "symmetric" else "upper"
    return qpv(model, kind, augment="all")


def prepare(model_or_form: Any, form_of_N: str) -> Prepared:
    """Check the class and derive the quadratic form."""
    form = model_or_form if isinstance(model_or_form, QPV) else None
    model: Plant = model_or_form if form is None else form.model
    _check_signals(model)
    if form is None:
        form = derive_form(model, form_of_N)
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
    _check_scheduling(form)
    return Prepared(form, form.vertices().count)


def _check_signals(model: Plant) -> None:
    if model.Ts is not None:
        raise StructureError(
            f"{model.name} is in discrete time and the QPV observer works in continuous time: give "
            "the continuous plant, and Ts= of the observer for the sampling of its step",
            condition="continuous time",
        )
    if model.d:
        names = ", ".join(model.names("d"))
        raise StructureError(
            f"unknown input {names}: the QPV observer does not decouple unknown inputs; declare a "
            "bounded one as a disturbance, or use BoundedErrorUIO",
            symbols=model.names("d"),
            condition="no unknown inputs",
        )
    if model.p:
        names = ", ".join(model.names("p"))
        raise StructureError(
            f"parameter {names} is only known to an interval; the observer schedules on measured "
            "values: give it a value, or declare it as measured scheduling",
            symbols=model.names("p"),
            condition="no uncertain parameters",
        )


def _check_scheduling(form: QPV) -> None:
    known = {*form.model.names("u"), *(s.name for s in form.model.rho if s.measured)}
    for variable in form.scheduling:
        hidden = [name for name in variable.signals if name not in known]
        if hidden:
            raise StructureError(
                f"the matrices vary with {variable.expression}, and {', '.join(hidden)} is not "
                "measured, so the gain cannot follow it; declare it with measured=True, or bound "
                "its effect as a disturbance",
                symbols=tuple(hidden),
                condition="measured scheduling",
            )


def check_faults(data: VertexData, sets: ErrorSets, names: tuple[str, ...]) -> None:
    """Refuse states and faults that no output shows somewhere in the sets.

    A column of (A + Psi, C) that vanishes at a point of the polytopes belongs to an integrator
    that no gain reaches there: the persistency of excitation that Section 3 of the paper asks for.
    """
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
