"""From a model to the numeric data of the method, structural conditions first."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.derive import JacobianBounds, Split, jacobian_bounds, split
from obsynth.derive.errors import StructureError
from obsynth.derive.rigour import middle_and_radius
from obsynth.derive.structure.conditions import detectability, unknown_input_condition
from obsynth.designs.bounded_error.record import EllipsoidBound, UioDesign
from obsynth.designs.core.given import PlantClass
from obsynth.designs.core.signals import finite_box
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class NoiseBox:
    """Boxes w_centre, w_radius (n_w,) of the disturbances, and fault increments rate (n_f,)."""

    w_centre: FloatArray
    w_radius: FloatArray
    rate: FloatArray

    def equal_weights(self, blocks: int = 3) -> FloatArray:
        """Weights Q_v of v in units of its boxes (see the errata); 2 blocks are without w_{k+1}."""
        n_w, n_f = self.w_radius.size, self.rate.size
        parts = [np.full(n_w, 1.0 / max(n_w, 1)), np.full(n_f, 1.0 / max(n_f, 1))]
        if blocks == 3:
            parts.append(parts[0])
        present = sum(1 for part in parts if part.size)
        return np.concatenate(parts) / max(present, 1)


def noise_box(model: Plant) -> NoiseBox:
    """Read the boxes from a discrete plant."""
    unbounded = [s.name for s in model.w if not np.isfinite([s.lower, s.upper]).all()]
    if unbounded:
        raise StructureError(
            f"disturbance {', '.join(unbounded)} has no bound, so no interval can be guaranteed; "
            "declare it with bound= or range=, or use a method for finite energy (HinfUIO)",
            symbols=tuple(unbounded),
        )
    rateless = [s.name for s in model.f if s.rate is None and not s.constant]
    if rateless:
        raise StructureError(
            f"fault {', '.join(rateless)} has no rate bound, so how far it moves in one step is "
            "unknown; declare it with rate= (per second) or constant=True",
            symbols=tuple(rateless),
        )
    box: Any = model.box("w")
    centre, radius = middle_and_radius(box[:, 0], box[:, 1])
    exact = (centre - radius <= box[:, 0]) & (box[:, 1] <= centre + radius)
    symmetric = box[:, 0] == -box[:, 1]
    radius = np.where(symmetric, box[:, 1], radius)
    centre = np.where(symmetric, 0.0, centre)
    if not np.all(exact | symmetric):
        raise StructureError("the box of the disturbances cannot be centred in doubles")
    rate = np.array([0.0 if s.constant else float(s.rate or 0.0) for s in model.f])
    return NoiseBox(centre, radius, rate)


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
    linear=True,
)
MATRICES = ("A", "B", "B_f", "C", "D", "W1", "W2")
"""Of a split, by which a design stores them."""
# Relative to the largest magnitude of each state: a few thousand roundings of one step.
ROUNDING = 2.0**-40


@dataclass(frozen=True, eq=False)
class Derived:
    """What follows from the equations: the split, and the Jacobians of its g over the box."""

    split: Split
    bounds: JacobianBounds


@dataclass(frozen=True, eq=False)
class UioModel(Derived):
    """A plant of the class; its design is complete except for gains and bound, which are zero."""

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
    p, nothing = n + n_f, np.zeros(0)
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
        **{name: getattr(parts, name) for name in MATRICES},
        family=bounds.family,
        **vars(noise),
        **{name: getattr(decoupling, name) for name in ("E", "T", "Pi")},
        K=np.zeros((n, m)),
        F=np.zeros((n_f, m)),
        # for the search; that of the gains replaces it
        rounding=rounding_allowance(model, decoupling.residual),
        bound=EllipsoidBound("plain", np.zeros((1, p, p)), np.zeros(1), nothing, nothing),
        options={},
    )
    return UioModel(parts, bounds, design)


def read_again(design: UioDesign) -> Derived:
    """Derive split and Jacobian bounds from the stored equations, at the stored point."""
    parts = split(design.plant, at=(design.x_at, design.u_at), linear=design.linear)
    return Derived(parts, jacobian_bounds(parts))


def rounding_allowance(model: Plant, residual: float = 0.0) -> FloatArray:
    """Return 2^-40 of the largest state, and what is left of d, (n + n_f,), not proved."""
    size = max(1.0, float(np.abs(finite_box(model, "x")).max()))
    d_box = model.box("d")
    share = residual * float(np.abs(d_box).sum()) * 2.0 if residual > 0 else 0.0
    return np.full(len(model.x) + len(model.f), ROUNDING * size + share)
