"""What is read of a plant: matrices in a polytope, exact constant blocks, boxes, and two ranks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import sympy as sp

from obsynth.derive.algebra.sizes import text
from obsynth.derive.errors import DerivationError, StructureError
from obsynth.derive.forms.quasi_lpv.form import QuasiLPV, quasi_lpv
from obsynth.derive.forms.quasi_lpv.terms import row_names, stacked_rows
from obsynth.derive.jacobian.family import AffineFamily
from obsynth.derive.rigour import Exact, exact
from obsynth.derive.structure.conditions import scaled_rank
from obsynth.designs.core.errors import CertificateError
from obsynth.designs.core.given import PlantClass
from obsynth.designs.core.record import Record
from obsynth.designs.core.signals import finite_box
from obsynth.symbolic import ObsynthError, Plant
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.signals import Signal

if TYPE_CHECKING:
    from obsynth.designs.interval.record import IntervalDesign

MOST_VERTICES = 1024
RANK = 1e-9
CLASS = PlantClass(
    who="the interval observer",
    time="discrete",
    finite={
        "w": " has no bound, so no interval can be given; declare it with bound= or range=",
    },
)
Prefer = Sequence[str] | Mapping[str, str] | None


@dataclass(frozen=True, eq=False)
class IntervalModel(Record):
    """x+ = A(rho) x + B(rho) u + o(rho) + F (f, d) + W1 w and y = C x + W2 w, in discrete time.

    family: of [A B o], affine in scalars; scheduled: on whose declared ranges it rests
    """

    plant: Plant
    family: Annotated[AffineFamily, "n n+n_u+1"]
    F: Annotated[Exact, "n n_f+q"]
    C: Annotated[Exact, "m n"]
    W1: Annotated[Exact, "n n_w"]
    W2: Annotated[Exact, "m n_w"]
    scheduled: tuple[str, ...]

    def check(self) -> None:
        """Refuse disturbances without bounds."""
        if not np.isfinite(self.plant.box("w")).all():
            raise CertificateError("a disturbance of the stored design has no bound")

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.plant.x)

    @property
    def q(self) -> int:
        """Number of faults and unknown inputs."""
        return int(self.F.shape[1])

    @property
    def columns(self) -> tuple[slice, slice, slice]:
        """Where A, B and o stand in the stacked matrix."""
        n, n_u = self.n, len(self.plant.u)
        return slice(0, n), slice(n, n + n_u), slice(n + n_u, n + n_u + 1)

    @cached_property
    def vertices(self) -> tuple[Exact, ...]:
        """All different matrices [A B o] at the ends of the ranges, exact."""
        constant, directions = exact(self.family.constant), exact(self.family.directions)
        moving = [k for k, direction in enumerate(directions) if direction.any()]
        ends = [exact(sorted(set(self.family.ranges[k].tolist()))) for k in moving]
        return tuple(
            sum((directions[k] * s for k, s in zip(moving, point, strict=True)), constant)
            for point in product(*ends)
        )

    @cached_property
    def middle(self) -> FloatArray:
        """A at the middle of all ranges, shape (n, n)."""
        return self.family.midpoint[:, : self.n]

    def box(self, kind: str) -> Exact:
        """Return the declared box of x, u or w, `LARGEST_SIGNAL` where there is none."""
        return exact(finite_box(self.plant, kind))

    def size(self, kind: str) -> Exact:
        """Return the largest magnitudes in `box`."""
        sizes: Exact = np.abs(self.box(kind)).max(axis=1, initial=0)
        return sizes


def read(given: Plant | QuasiLPV, prefer: Prefer = None) -> IntervalModel:
    """Read the matrices of the quasi-LPV form of a plant and check their ranks."""
    plant = given if isinstance(given, Plant) else given.model
    # What equations alone tell comes first, as a form can take a while; a step of rk4 has no rows
    # of terms to read, which `quasi_lpv` refuses at once.
    if plant.discretisation != "rk4":
        _check_ranks(plant, *_linear_parts(plant))
    form = quasi_lpv(plant, prefer=prefer)
    if isinstance(given, QuasiLPV):
        if given.matrix != form.matrix or not given.centre.is_origin:
            raise ObsynthError(
                "the form is not the one that is derived from its plant; give the plant, and "
                "prefer= to choose how it is written",
                option="prefer",
            )
        form = given
    if not form.proof.holds:
        raise DerivationError(
            f"the quasi-LPV form of {form.model.name} is not proved to be the plant: {form.proof}"
        )
    return _matrices(form)


def read_again(design: IntervalDesign) -> IntervalModel:
    """Read the stored equations as they were read."""
    return read(CLASS.check(design.plant), design.options.get("prefer"))


def _linear_parts(plant: Plant) -> tuple[FloatArray, FloatArray]:
    """Return C (m, n) and F (n, q), or refuse what is not y = C x + W2 w, or gains that vary."""
    rows, n = stacked_rows(plant), len(plant.x)
    outputs = [sp.expand(row) for row in rows[n:]]
    for name, row in zip(plant.output_names, outputs, strict=True):
        inside = [s.name for kind in "ufd" for s in getattr(plant, kind) if row.has(s.symbol)]
        rest = row - sum(sp.diff(row, s.symbol) * s.symbol for s in (*plant.x, *plant.w))
        if inside or sp.expand(rest) != 0:
            raise StructureError(
                f"the output {name} = {text(row)} has "
                f"{', '.join(inside) or 'more than multiples of states and disturbances'} in it; "
                "this method needs y = C x + W2 w: take what is known of it away from the reading "
                'and declare the rest, or take form="general", which has outputs of any form',
                symbol=name,
                row=name,
                inputs=tuple(inside),
            )
    C = _constant_slopes(plant.x, plant.output_names, outputs)
    _constant_slopes(plant.w, row_names(plant), rows)
    return C, _constant_slopes((*plant.f, *plant.d), plant.names("x"), rows[:n])


def _constant_slopes(
    signals: Sequence[Signal], names: Sequence[str], rows: Sequence[sp.Expr]
) -> FloatArray:
    """Return slopes as doubles, (rows, signals), or refuse one that varies."""
    found = np.zeros((len(rows), len(signals)))
    for (i, row), (j, s) in product(enumerate(rows), enumerate(signals)):
        slope = sp.diff(row, s.symbol)
        slope = sp.expand(slope) if slope.free_symbols else slope
        if varies := sorted(map(str, slope.free_symbols)):
            raise StructureError(
                f"{s.name} enters {names[i]} by {text(slope)}, which varies with "
                f"{', '.join(varies)}; this method needs constant C, F, W1 and W2, "
                'form="general" does not',
                symbol=s.name,
                row=names[i],
                symbols=tuple(varies),
                condition="constant block",
            )
        found[i, j] = float(slope)
    return found


def _matrices(form: QuasiLPV) -> IntervalModel:
    plant = form.model
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
        tuple(sorted(used & {*plant.names("x"), *plant.names("u")})),
    )


def _rational_block(form: QuasiLPV, name: str) -> Exact:
    form.constant(name)
    block = form.block(name)
    for i, j in np.ndindex(block.shape):
        if not block[i, j].is_Rational:
            raise StructureError(
                f"{name}[{i + 1},{j + 1}] = {block[i, j]} is irrational; the exact decoupling "
                "needs rational numbers: give the constant as a number",
                entry=(i, j),
                condition="rational block",
            )
    return exact(np.array(block.tolist(), dtype=object).reshape(block.shape))


def _check_ranks(plant: Plant, C: FloatArray, F: FloatArray) -> None:
    """Refuse rank(C F) < q, and rank(F) < q before it."""
    q, CF = F.shape[1], C @ F
    names = (*plant.names("f"), *plant.names("d"))
    facts: dict[str, Any] = {"rank_F": scaled_rank(F), "rank_CF": scaled_rank(CF), "q": q}
    if facts["rank_F"] < q:
        raise StructureError(
            f"rank(F) = {facts['rank_F']} for {q} faults and unknown inputs: {', '.join(names)} "
            "act on the states in the same way and cannot be told apart; merge or remove them",
            condition="rank(F) = q",
            symbols=names,
            **facts,
        )
    if facts["rank_CF"] < q:
        _, values, vectors = np.linalg.svd(CF, full_matrices=True)
        full = np.zeros(q)
        full[: len(values)] = values
        lost = vectors[full <= RANK * max(1.0, float(full.max()))].T
        symbols = tuple(s for j, s in enumerate(names) if np.abs(lost[j]).max() > 1e-6)
        states = tuple(
            s for i, s in enumerate(plant.names("x")) if np.abs(F[i] @ lost).max() > 1e-9
        )
        raise StructureError(
            f"rank(C F) = {facts['rank_CF']} but there are {q} faults and unknown inputs: "
            f"{', '.join(symbols)} acts on {', '.join(states)}, and no output "
            f"({', '.join(plant.output_names)}) shows it one step later. Full rank of C and "
            f"of F (Assumption 3) is not enough: measure {states[0]}, or treat {symbols[0]} as a "
            "bounded disturbance",
            condition="rank(C F) = q",
            symbols=symbols,
            states=states,
            **facts,
        )
