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
from obsynth.symbolic import Plant, Role
from obsynth.symbolic.arrays import FloatArray

# Relative to the largest magnitude of each state: a few thousand roundings of one step.
ROUNDING = 2.0**-40


@dataclass(frozen=True, eq=False)
class Prepared:
    """A model of the class (1)-(2) with everything derived from it.

    design: complete except for gains and bound, which are zero
    """

    split: Split
    bounds: JacobianBounds
    design: UioDesign


def check_class(model: Plant) -> None:
    """Refuse what is outside the class (1)-(2) by the user's own names."""
    if model.Ts is None:
        raise StructureError(
            f"{model.name} is in continuous time and the bounded-error observer works in discrete "
            'time: call discretise("euler", Ts=...) first'
        )
    if model.p:
        names = ", ".join(signal.name for signal in model.p)
        raise StructureError(
            f"parameter {names} is only known to an interval, which the class (1)-(2) does not "
            "have: give it a value, or declare its effect as a disturbance",
            symbols=tuple(signal.name for signal in model.p),
        )
    if model.rho:
        names = ", ".join(signal.name for signal in model.rho)
        raise StructureError(
            f"scheduling variable {names}: the class (1)-(2) has none; use IntervalObserver or "
            "QPVObserver, or declare it as an input",
            symbols=tuple(signal.name for signal in model.rho),
        )
    sensors = [signal.name for signal in model.f if signal.role is Role.SENSOR_FAULT]
    if sensors:
        raise StructureError(
            f"sensor fault {', '.join(sensors)}: this method estimates faults that enter the "
            "dynamics (actuator and process faults)",
            symbols=tuple(sensors),
        )
    unbounded = [s.name for s in model.x if not np.isfinite([s.lower, s.upper]).all()]
    if unbounded:
        raise StructureError(
            f"state {', '.join(unbounded)} has no finite range, so the Jacobian cannot be "
            "bounded; declare it with range=(lower, upper)",
            symbols=tuple(unbounded),
        )


def prepare(model_or_split: Plant | Split, bounds: JacobianBounds | None = None) -> Prepared:
    """Split, check the structural conditions, bound the Jacobian."""
    model = model_or_split if isinstance(model_or_split, Plant) else model_or_split.model
    check_class(model)
    parts = split(model) if isinstance(model_or_split, Plant) else model_or_split
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
    return Prepared(parts, bounds, design)


def rounding_allowance(model: Plant, residual: float = 0.0) -> FloatArray:
    """Return the allowance for the rounding errors of one step, shape (n + n_f,).

    2^-40 of the largest magnitude of the states (or 1), and the share of the
    unknown input that rounding leaves in the error.
    """
    size = max(1.0, float(np.abs(model.box("x")).max()))
    d_box = model.box("d")
    share = residual * float(np.abs(d_box).sum()) * 2.0 if residual > 0 else 0.0
    return np.full(len(model.x) + len(model.f), ROUNDING * size + share)
