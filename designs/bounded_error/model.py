"""From a model to the numeric data of the method, structural conditions first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.derive import JacobianBounds, Split, jacobian_bounds, split
from obsynth.derive.errors import StructureError
from obsynth.derive.structure.decoupling import unknown_input_condition
from obsynth.derive.structure.detectability import detectability
from obsynth.designs.bounded_error.noise import noise_box
from obsynth.designs.bounded_error.record import PeakData, UioDesign
from obsynth.designs.core.plant_class import PlantClass
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray

CLASS = PlantClass(
    who="the bounded-error observer",
    time="discrete",
    forbids={
        "p": " is only known to an interval, which the class (1)-(2) does not have: give it a "
        "value, or declare its effect as a disturbance",
        "rho": ": the class (1)-(2) has none; use IntervalObserver or QPVObserver, or declare it "
        "as an input",
    },
    finite={
        "x": " has no finite range, so the Jacobian cannot be bounded; declare it with "
        "range=(lower, upper)",
    },
)
# Relative to the largest magnitude of each state: a few thousand roundings of one step.
ROUNDING = 2.0**-40


@dataclass(frozen=True, eq=False)
class Derived:
    """What follows from the equations: the split, and the Jacobians of its g over the box."""

    split: Split
    bounds: JacobianBounds


@dataclass(frozen=True, eq=False)
class UioModel(Derived):
    """A plant of the class (1)-(2) with everything derived from it.

    design: complete except for gains and bound, which are zero
    """

    design: UioDesign


def read(given: Plant | Split, bounds: JacobianBounds | None = None) -> UioModel:
    """Split, check the structural conditions, bound the Jacobian."""
    model = given if isinstance(given, Plant) else given.model
    parts = split(model) if isinstance(given, Plant) else given
    noise = noise_box(model)
    decoupling = unknown_input_condition(parts)
    if bounds is None:
        bounds = jacobian_bounds(parts)
    detectability(parts, bounds)
    n, n_f, m = len(model.x), len(model.f), len(parts.C)
    if decoupling.residual > 0 and not np.isfinite(model.box("d")).all():
        names = ", ".join(model.names("d"))
        raise StructureError(
            f"unknown input {names}: rounding leaves {decoupling.residual:.1e} of it in the "
            "error, so a bound is needed to cover that; declare it with range=",
            residual=decoupling.residual,
        )
    design = UioDesign(
        plant=model,
        linear=parts.linear,
        x_at=np.asarray(parts.at.x, dtype=float),
        u_at=np.asarray(parts.at.u, dtype=float),
        A=parts.A,
        B=parts.B,
        B_f=parts.B_f,
        C=parts.C,
        D=parts.D,
        W1=parts.W1,
        W2=parts.W2,
        family=bounds.family,
        w_centre=noise.w_centre,
        w_radius=noise.w_radius,
        rate=noise.rate,
        E=decoupling.E,
        T=decoupling.T,
        Pi=decoupling.Pi,
        K=np.zeros((n, m)),
        F=np.zeros((n_f, m)),
        rounding=rounding_allowance(model, decoupling.residual),
        bound=PeakData(np.zeros(n + n_f), 0.0),
        options={},
    )
    return UioModel(parts, bounds, design)


def read_again(design: UioDesign) -> Derived:
    """Derive split and Jacobian bounds from the stored equations, at the stored point."""
    parts = split(design.plant, at=(design.x_at, design.u_at), linear=design.linear)
    return Derived(parts, jacobian_bounds(parts))


def rounding_allowance(model: Plant, residual: float = 0.0) -> FloatArray:
    """Return the allowance for the rounding errors of one step, shape (n + n_f,).

    2^-40 of the largest magnitude of the states (or 1), and the share of the
    unknown input that rounding leaves in the error.
    """
    size = max(1.0, float(np.abs(model.box("x")).max()))
    d_box = model.box("d")
    share = residual * float(np.abs(d_box).sum()) * 2.0 if residual > 0 else 0.0
    return np.full(len(model.x) + len(model.f), ROUNDING * size + share)
