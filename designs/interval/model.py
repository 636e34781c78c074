"""The plant as the method sees it: matrices in a polytope, exact constant blocks, boxes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np

from obsynth.derive.errors import StructureError
from obsynth.derive.forms.quasi_lpv.form import QuasiLPV
from obsynth.derive.jacobian.family import AffineFamily
from obsynth.derive.rigour import Exact, exact, from_text, to_text
from obsynth.designs.core.record import plain, read_family, reading
from obsynth.symbolic import Plant, Role
from obsynth.symbolic.arrays import FloatArray

MOST_VERTICES = 1024
LARGEST_SIGNAL = 1e6
"""Magnitude up to which rounding is accounted for where a signal has no declared range."""


@dataclass(frozen=True, eq=False)
class IntervalModel:
    """x+ = A(rho) x + B(rho) u + o(rho) + F (f, d) + W1 w and y = C x + W2 w.

    plant: discrete
    family: the stacked matrix [A B o], shape (n, n + n_u + 1), affine in independent scalars
    F: columns of the faults, then of the unknown inputs
    scheduled: states and inputs on whose declared range the family rests
    """

    plant: Plant
    family: AffineFamily
    F: Exact
    C: Exact
    W1: Exact
    W2: Exact
    scheduled: tuple[str, ...]

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.plant.x)

    @property
    def q(self) -> int:
        """Number of faults and unknown inputs."""
        return int(self.F.shape[1])

    @cached_property
    def vertices(self) -> tuple[Exact, ...]:
        """All different matrices [A B o] at the ends of the ranges, exact."""
        constant, directions = exact(self.family.constant), exact(self.family.directions)
        ends = [
            sorted({float(low), float(high)})
            for (low, high), direction in zip(
                self.family.ranges, self.family.directions, strict=True
            )
            if direction.any()
        ]
        moving = [d for d, f in zip(directions, self.family.directions, strict=True) if f.any()]
        return tuple(
            sum((exact([[s]]) * d for s, d in zip(point, moving, strict=True)), constant)
            for point in product(*ends)
        )

    @cached_property
    def middle(self) -> FloatArray:
        """A at the middle of all ranges, shape (n, n)."""
        return self.family.midpoint[:, : self.n]

    def box(self, kind: str) -> Exact:
        """Return the declared box of x, u or w, `LARGEST_SIGNAL` where there is none."""
        return exact(np.clip(self.plant.box(kind), -LARGEST_SIGNAL, LARGEST_SIGNAL))

    def size(self, kind: str) -> Exact:
        """Return the largest magnitudes in `box`."""
        sizes: Exact = np.abs(self.box(kind)).max(axis=1, initial=0)
        return sizes

    def to_record(self) -> dict[str, Any]:
        """Return the model as JSON-able data."""
        return {
            "plant": self.plant.to_dict(),
            "family": plain(self.family),
            **{name: to_text(getattr(self, name)) for name in ("F", "C", "W1", "W2")},
            "scheduled": list(self.scheduled),
        }

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> IntervalModel:
        """Read the data of `to_record`."""
        with reading():
            plant = Plant.from_dict(record["plant"])
            n, m, n_w = len(plant.x), len(plant.output), len(plant.w)
            family = read_family(record["family"], (n, n + len(plant.u) + 1))
            if np.any(family.ranges[:, 0] > family.ranges[:, 1]):
                raise ValueError("a range has lower above upper")
            return cls(
                plant,
                family,
                from_text(record["F"], (n, len(plant.f) + len(plant.d))),
                from_text(record["C"], (m, n)),
                from_text(record["W1"], (n, n_w)),
                from_text(record["W2"], (m, n_w)),
                tuple(record["scheduled"]),
            )


def model_of(form: QuasiLPV) -> IntervalModel:
    """Read the matrices of a quasi-LPV form, refusing what is outside the class."""
    plant = form.model
    _check_class(form)
    polytope = form.vertices()
    family = polytope.family
    rows = slice(0, len(plant.x))
    places = [polytope.layout.place(name)[1] for name in ("A", "B", "offset")]
    columns = np.concatenate([np.arange(p.start, p.stop) for p in places]).astype(np.intp)
    small = AffineFamily(
        constant=family.constant[rows, columns],
        directions=family.directions[:, rows, columns],
        ranges=family.ranges,
        radius=family.radius[rows, columns],
        labels=family.labels,
        exact=family.exact,
    )
    moving = [bool(d.any()) for d in small.directions]
    if 2 ** sum(moving) > MOST_VERTICES:
        raise StructureError(
            f"the matrices vary with {sum(moving)} independent scalars, "
            f"{2 ** sum(moving)} vertices; at most {MOST_VERTICES} fit a step: merge or fix "
            f"{', '.join(small.labels)}",
            condition="vertices",
        )
    own = set(plant.names("x")) | set(plant.names("u"))
    used = {
        name
        for variable, moves in zip(form.scheduling, moving, strict=True)
        if moves
        for name in variable.signals
    }
    blocks = {name: _rational_block(form, name) for name in ("B_f", "D", "C", "W1", "W2")}
    return IntervalModel(
        plant,
        small,
        np.hstack([blocks["B_f"], blocks["D"]]),
        blocks["C"],
        blocks["W1"],
        blocks["W2"],
        tuple(sorted(used & own)),
    )


def _check_class(form: QuasiLPV) -> None:
    plant = form.model
    if plant.Ts is None:
        raise StructureError(
            f"{plant.name} is in continuous time and the interval observer works in discrete "
            'time: call discretise("euler", Ts=...) first'
        )
    if not form.centre.is_origin:
        raise StructureError(
            "the quasi-LPV form is taken about another point than the origin; this method needs "
            'centre="origin"'
        )
    sensors = [s.name for s in plant.f if s.role is Role.SENSOR_FAULT]
    if sensors:
        raise StructureError(
            f"sensor fault {', '.join(sensors)}: this method estimates faults that enter the "
            "dynamics (actuator and process faults)",
            symbols=tuple(sensors),
        )
    for name in ("feedthrough", "D_y", "D_f", "output_offset"):
        block = form.block(name)
        for i in range(block.rows):
            if any(entry != 0 for entry in block[i, :]):
                output = plant.output_names[i]
                raise StructureError(
                    f"the output {output} has more than states and disturbances in it ({name}); "
                    "this method needs y = C x + W2 w",
                    symbol=output,
                    row=output,
                )
    loose = [s.name for s in plant.w if not np.isfinite([s.lower, s.upper]).all()]
    if loose:
        raise StructureError(
            f"disturbance {', '.join(loose)} has no bound, so no interval can be given; declare "
            "it with bound= or range=",
            symbols=tuple(loose),
        )


def _rational_block(form: QuasiLPV, name: str) -> Exact:
    form.constant(name)
    block = form.block(name)
    for i in range(block.rows):
        for j in range(block.cols):
            if not block[i, j].is_Rational:
                raise StructureError(
                    f"{name}[{i + 1},{j + 1}] = {block[i, j]} is irrational; the exact decoupling "
                    "needs rational numbers: give the constant as a number",
                    entry=(i, j),
                    condition="rational block",
                )
    return exact(np.array(block.tolist(), dtype=object).reshape(block.shape))


def columns_of(model: IntervalModel) -> tuple[slice, slice, slice]:
    """Return where A, B and o stand in the stacked matrix."""
    n, n_u = model.n, len(model.plant.u)
    return slice(0, n), slice(n, n + n_u), slice(n + n_u, n + n_u + 1)
