"""What the method reads of a plant: x' = A(rho) x + B u + phi + G theta + W1 w, y = C x + v."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import sympy as sp

from obsynth.derive import QuasiLPV, Split, StructureError, quasi_lpv
from obsynth.derive.jacobian.entries import matrix_entries
from obsynth.derive.rigour import middle_and_radius, round_number, substitute
from obsynth.designs.core.given import PlantClass
from obsynth.designs.set_adaptive.bounds import EndBounds, derive_bounds
from obsynth.designs.set_adaptive.record import SetDesign, System
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray

_NO_RANGE = " has no range; declare it with range="
CLASS = PlantClass(
    who="the set adaptive observer",
    time="continuous",
    discretised=True,
    forbids={
        "d": ": this method decouples none; declare one with a range as a "
        "disturbance, or as a fault",
    },
    finite={
        "x": " has no range, and the bounds of A x are those of ranges, even where it enters "
        "linearly; declare it with range= (in the plant's own coordinates from 0 on)",
        "f": _NO_RANGE,
    },
    needs={"f": "this method bounds faults"},
)


@dataclass(frozen=True, eq=False)
class SetModel(System):
    """A plant of the class with all that is derived; form: with the proof that it is the plant."""

    form: QuasiLPV

    def extremes(self, Ts: float) -> tuple[FloatArray, FloatArray]:
        """Return the least A_m and the largest A_M for what is known over a step of Ts."""
        box = self.plant.box("u")
        with np.errstate(invalid="ignore"):
            push = np.where(self.input_rate == 0.0, 0.0, self.input_rate * box.T[:, None])
        speed = np.abs(self.rate).max(axis=1) + np.abs(push).max(axis=0, initial=0.0).sum(axis=1)
        names = self.plant.names("x")
        rows = [int(np.argmax(self.C[:, names.index(s.name)] != 0.0)) for s in self.bounds.states]
        scale = np.array([self.C[k].sum() for k in rows])
        return self.bounds.extremes((self.noise + Ts * speed)[rows] / scale)

    @cached_property
    def motion(self) -> tuple[FloatArray, FloatArray]:
        """As rate and input_rate, of all states."""
        return _speed(self.plant, np.eye(len(self.plant.x)))

    @cached_property
    def A_span(self) -> tuple[FloatArray, FloatArray]:
        """The extremes of the continuous form."""
        return self.extremes(0.0)

    @cached_property
    def A_lower_box(self) -> FloatArray:
        """The least A_m for ends anywhere in the declared ranges."""
        return self.bounds.extremes(np.inf)[0]


def read(given: Plant | Split, noise: bool = True, own: bool = True) -> SetModel:
    """Read a plant, or refuse it by name; own: for bounds in its own coordinates, x >= 0."""
    plant = CLASS.check(given if isinstance(given, Plant) else given.model)
    plant.check()
    for signal in plant.x:
        if own and signal.lower < 0.0:
            raise StructureError(
                f"the state {signal.name} may be negative ({signal.lower:g}); A_m x <= A x <= A_M "
                f"x needs states that are not: use {signal.name} - ({signal.lower:g}) as state, or "
                "design in other coordinates, as the form that is not printed does",
                symbol=signal.name,
                condition="nonnegative states",
            )
    form = quasi_lpv(plant)
    faults = {s.symbol for s in plant.f}
    for block in ("A", "B", "offset"):
        bad = form.block(block).free_symbols & faults
        if bad:
            name = str(sorted(map(str, bad))[0])
            raise StructureError(
                f"the fault {name} multiplies other signals in {block}; this method needs faults "
                "that enter additively with a constant factor",
                symbol=name,
                condition="additive faults",
            )
    C, G = form.constant("C"), form.constant("B_f")
    W1, W2 = form.constant("W1"), form.constant("W2")
    if np.any(form.constant("D_f")):
        name = plant.names("f")[int(np.nonzero(form.constant("D_f"))[1][0])]
        raise StructureError(
            f"the fault {name} enters an output; this method bounds faults of the dynamics only",
            symbol=name,
            condition="faults in the dynamics",
        )
    if np.any(form.constant("feedthrough")) or np.any(form.constant("output_offset")):
        raise StructureError(
            "an output has an input or a constant in it; declare the output without them",
            condition="y = C x + v",
        )
    _check_signs(plant, C)
    box = plant.box("w")
    if noise and not np.isfinite(box).all():
        name = plant.names("w")[int(np.flatnonzero(~np.isfinite(box).all(axis=1))[0])]
        raise StructureError(
            f"the disturbance {name} has no bound; declare it with bound=",
            symbol=name,
            condition="bounded disturbances",
        )
    if not noise:
        box = np.zeros_like(box)
    bounds = derive_bounds(form)
    _check_readings(plant, bounds, C)
    rate, input_rate = _speed(plant, C)
    return SetModel(
        plant=plant,
        bounds=bounds,
        C=C,
        G=G,
        W1=W1,
        W2=W2,
        w_centre=box.mean(axis=1),
        w_radius=middle_and_radius(*box.T)[1],
        rate=rate,
        input_rate=input_rate,
        form=form,
    )


def read_again(design: SetDesign) -> SetModel:
    """Derive it from the stored equations."""
    return read(design.plant, design.noisy, own=design.coordinates is None)


def output_of_fault(
    C: FloatArray, flow: FloatArray, G: FloatArray, names: tuple[str, ...]
) -> list[int]:
    """Return for every fault the output that shows it first, by derivatives, then by size."""
    found = []
    for j, name in enumerate(names):
        reached = G[:, j]
        for _ in range(len(flow)):
            shown = np.abs(C @ reached)
            if shown.max() > 0.0:
                found.append(int(np.argmax(shown)))
                break
            reached = flow @ reached
        else:
            raise StructureError(
                f"no output is certain to show the fault {name}; measure a state that it drives",
                symbol=name,
                condition="a fault that shows",
            )
    return found


def _check_signs(plant: Plant, C: FloatArray) -> None:
    if np.any(C < 0.0):
        k, i = np.argwhere(C < 0.0)[0]
        raise StructureError(
            f"the output {plant.output_names[k]} falls with {plant.names('x')[i]}; Assumption 1 "
            "needs C >= 0: measure its negative",
            symbol=plant.output_names[k],
            condition="C >= 0",
        )


def _check_readings(plant: Plant, bounds: EndBounds, C: FloatArray) -> None:
    shown = {plant.names("x").index(s.name) for s in bounds.states}
    for k, row in enumerate(C):
        states = np.flatnonzero(row)
        if len(states) != 1 or int(states[0]) not in shown:
            raise StructureError(
                f"the output {plant.output_names[k]} does not show one state; this method needs "
                "outputs that are a positive multiple of one state each, plus noise",
                symbol=plant.output_names[k],
                condition="outputs show states",
            )
    if len({int(np.flatnonzero(row)[0]) for row in C}) != len(C):
        raise StructureError(
            "two outputs show the same state; keep the better one", condition="one output a state"
        )


def _speed(plant: Plant, C: FloatArray) -> tuple[FloatArray, FloatArray]:
    values = plant.constant_values
    rhs = [substitute(e, values) for e in plant.rhs]
    u = [s.symbol for s in plant.u]
    input_rate = np.zeros((len(C), len(u)))
    rows: dict[tuple[int, int], sp.Expr] = {}
    for k, output in enumerate(C):
        i = int(np.flatnonzero(output)[0])
        # as typed: written out, a root of a sum of squares is one of a difference
        row = sp.Rational(float(output[i])) * rhs[i]
        for j, symbol in enumerate(u):
            factor = sp.diff(sp.expand(row), symbol)
            if factor.is_number:
                input_rate[k, j] = round_number(factor)[0]
                row = substitute(row, {symbol: sp.Integer(0)})
        rows[(k, 0)] = row
    rate = np.zeros((len(C), 2))
    entries = matrix_entries(rows, plant)
    if entries.places:
        found = entries.ranges(1e-3, "fast", "speed of output")
        for position, (k, _) in enumerate(entries.places):
            rate[k] = found.lower[position], found.upper[position]
    return rate, input_rate
