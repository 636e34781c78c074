"""A continuous plant as CasADi columns with one box, and derivatives along its solutions."""

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from obsynth.derive.errors import DerivationError, UnboundedError
from obsynth.derive.intervals.program import Program, enclose
from obsynth.derive.intervals.ranges import Ranges, bound_ranges
from obsynth.derive.intervals.rules import JUMPS
from obsynth.derive.rigour import Interval, enclose_number
from obsynth.symbolic.arrays import BoolArray, FloatArray
from obsynth.symbolic.discretise import Step, composed
from obsynth.symbolic.plant import Plant

_HELD = ("u", "d", "f", "w", "p", "rho")


@dataclass(frozen=True, eq=False)
class System:
    """dx/dt = f(x, v), s the time within a step; the signals v are held but for their ``rates``."""

    x: ca.SX
    v: ca.SX
    s: ca.SX
    rhs: ca.SX
    names: tuple[str, ...]
    held: tuple[str, ...]
    lower: FloatArray
    upper: FloatArray
    constants: ca.SX
    constant_box: list[tuple[float, float]]
    rates: FloatArray

    @property
    def variables(self) -> ca.SX:
        """States, held signals and time, as a column."""
        return ca.vertcat(self.x, self.v, self.s)

    def box(self, lower: FloatArray, upper: FloatArray, step: float) -> FloatArray:
        """Box for `variables` with other states, and time in [0, step]."""
        n = len(self.names)
        low = np.concatenate([lower[:n], self.lower[n:], [0.0]])
        high = np.concatenate([upper[:n], self.upper[n:], [step]])
        return np.column_stack([low, high])

    def program(self, column: ca.SX) -> Program:
        """Return a column of expressions as an interval program of `variables`."""
        function = ca.Function("column", [self.variables, self.constants], [ca.densify(column)])
        return Program.from_casadi(function, {1: self.constant_box})

    def ranges(self, column: ca.SX, box: FloatArray, what: str, rtol: float, effort: str) -> Ranges:
        """Bound one expression per state over a box."""
        found = bound_ranges(
            column,
            self.variables,
            box,
            self.constants,
            self.constant_box,
            rtol=rtol,
            effort=effort,
        )
        if found.failures:
            failure = found.failures[0]
            sub_box = failure.box((*self.names, *self.held, "time in the step"))
            where = ", ".join(f"{k} in [{a:.6g}, {b:.6g}]" for k, (a, b) in sub_box.items())
            raise UnboundedError(
                f"{what} has no finite bound in the row of {self.names[failure.index]} "
                f"({failure.operation} at {where}). Keep the ranges further away from there, or "
                "take a shorter step",
                entries=(f"{what} of {self.names[failure.index]}",),
                operation=failure.operation,
                sub_box=sub_box,
            )
        return found

    def may_jump(self, column: ca.SX, box: FloatArray) -> bool:
        """Tell whether an expression contains an operation that may jump inside the box."""
        program = self.program(column)
        outputs = range(len(program.outputs))
        jumps = any(program.nodes[k].op in JUMPS for o in outputs for k in program.breaks(o))
        return jumps and bool(self.rough(column, (box[:, :1], box[:, 1:])).any())

    def rough(self, column: ca.SX, boxes: Interval) -> BoolArray:
        """Where an expression may jump or be undefined, over a batch of boxes."""
        program = self.program(column)
        outputs = range(len(program.outputs))
        found = enclose(program, *boxes, outputs, len(outputs))
        return np.asarray(found.rough.any(axis=0))


def system(
    plant: Plant, ranges: Mapping[str, tuple[float, float]] | None = None, moving: bool = False
) -> System:
    """Read a continuous plant, faults with a rate moving within a step or held."""
    if plant.check().Ts is not None:
        raise DerivationError(
            f"plant {plant.name!r} is discrete (Ts = {plant.Ts:g} s); the remainder belongs to the "
            "step from a continuous plant: give that one (plant.continuous)",
            Ts=plant.Ts,
        )
    given = {str(name): pair for name, pair in (ranges or {}).items()}
    sx = plant.sx(constants="symbol")
    present = {str(symbol) for symbol in ca.symvar(sx.rhs)}
    known = {s.name for kind in ("x", *_HELD) for s in getattr(plant, kind)}
    unknown = sorted(set(given) - known)
    if unknown:
        raise DerivationError(
            f"ranges= names {', '.join(unknown)}, which the plant does not have", symbols=unknown
        )
    lower, upper, held, columns, rates = [], [], [], [], []
    for kind in ("x", *_HELD):
        for signal, element in zip(
            getattr(plant, kind), ca.vertsplit(getattr(sx, kind)), strict=True
        ):
            if kind != "x" and signal.name not in present:
                continue
            low, high = (float(e) for e in given.get(signal.name, (signal.lower, signal.upper)))
            if low > high:
                raise DerivationError(
                    f"the range of {signal.name} is empty: ({low}, {high})", symbol=signal.name
                )
            if not (np.isfinite(low) and np.isfinite(high)):
                raise UnboundedError(
                    f"the {signal.role} {signal.name} enters the dynamics without a finite range, "
                    "so nothing bounds what happens within a step; declare a range, or assume one "
                    f"here: ranges={{{signal.name!r}: (lower, upper)}}",
                    entries=(signal.name,),
                    operation="an unbounded signal",
                    sub_box={signal.name: (low, high)},
                )
            lower.append(low)
            upper.append(high)
            if kind != "x":
                held.append(signal.name)
                columns.append(element)
                fixed = signal.rate is None or signal.constant or not moving
                rates.append(0.0 if fixed else float(signal.rate))
    return System(
        sx.x,
        ca.vertcat(*columns) if columns else ca.SX(0, 1),
        ca.SX.sym("s"),
        sx.rhs,
        plant.names("x"),
        tuple(held),
        np.array(lower),
        np.array(upper),
        sx.c,
        [enclose_number(value) for value in plant.constant_values.values()],
        np.array(rates, dtype=float),
    )


def time_derivatives(dynamics: System, order: int) -> list[ca.SX]:
    """Form the time derivatives of a solution as functions of the state: f, J f, J(J f) f, ..."""
    found = [dynamics.rhs]
    for _ in range(order - 1):
        found.append(ca.cse(ca.jtimes(found[-1], dynamics.x, dynamics.rhs)))
    return found


def step_derivatives(dynamics: System, step: Step, order: int) -> list[ca.SX]:
    """Form the derivatives of a step by its length s, as functions of x and s."""
    value = composed(step, dynamics.x, dynamics.rhs, dynamics.s)
    found = []
    for _ in range(order):
        value = ca.cse(ca.densify(ca.jacobian(value, dynamics.s)))
        found.append(value)
    return found
