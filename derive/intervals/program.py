"""Expressions as a program of interval operations, and its evaluation over a batch of boxes.

The instruction list of a CasADi function is turned into a graph in which equal sub-expressions are
one node, and on the way some forms are replaced by narrower ones, see `rewriting`. Numbers with at
most 24 significant bits are taken as meant; all others are widened by `CONSTANT_ULPS`, which covers
the rounding of the constants that CasADi folds while an expression is built. Inputs named in
``constants`` become intervals once and for all, as exact rational parameters do.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from obsynth.derive.errors import DerivationError
from obsynth.derive.intervals.graph import Graph, Node, Schedule, reached
from obsynth.derive.intervals.rewriting.rewrites import REWRITES
from obsynth.derive.intervals.rules import JUMPS, NAMES, PARTIAL
from obsynth.symbolic.arrays import BoolArray, FloatArray

CONSTANT_ULPS = 4
_SIGNIFICANT_BITS = 24


def constant_interval(value: float) -> tuple[float, float]:
    """Enclose what a constant of a CasADi expression stands for."""
    if not math.isfinite(value):
        return (math.nan, math.nan) if math.isnan(value) else (value, value)
    mantissa, _ = math.frexp(value)
    if (mantissa * 2.0**_SIGNIFICANT_BITS).is_integer():
        return value, value
    lo = hi = value
    for _ in range(CONSTANT_ULPS):
        lo, hi = math.nextafter(lo, -math.inf), math.nextafter(hi, math.inf)
    return lo, hi


@dataclass
class Program(Graph):
    """A function of a box as a list of interval operations, see `from_casadi` and `enclose`.

    outputs: node of every scalar output, in the order of the function's nonzeros
    """

    n_variables: int = 0
    outputs: list[int] = field(default_factory=list)
    _live: dict[tuple[int, ...], list[int]] = field(default_factory=dict, repr=False)
    _breaks: dict[int, list[int]] = field(default_factory=dict, repr=False)
    _schedules: dict[tuple[tuple[int, ...], int], Schedule] = field(
        default_factory=dict, repr=False
    )

    @classmethod
    def from_casadi(
        cls,
        function: ca.Function,
        constants: Mapping[int, Sequence[tuple[float, float]]] | None = None,
    ) -> Program:
        """Build the program of an SX function."""
        given = dict(constants or {})
        arguments: list[list[int]] = []
        program = cls()
        for index in range(function.n_in()):
            if index in given:
                arguments.append([program.number(*pair) for pair in given[index]])
                continue
            count = function.numel_in(index)
            first, program.n_variables = program.n_variables, program.n_variables + count
            arguments.append([program.variable(first + k) for k in range(count)])
        program.outputs = program.insert(function, arguments)
        return program

    def variable(self, number: int) -> int:
        """Return the node of a box variable."""
        return self.append(Node("input", (), number))

    def insert(self, function: ca.Function, arguments: Sequence[Sequence[int]]) -> list[int]:
        """Add what an SX function computes from nodes."""
        work: dict[int, int] = {}
        results: dict[tuple[int, int], int] = {}
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            out, args = function.instruction_output(k), function.instruction_input(k)
            if code == ca.OP_CONST:
                work[out[0]] = self.number(*constant_interval(function.instruction_constant(k)))
            elif code == ca.OP_INPUT:
                work[out[0]] = arguments[args[0]][args[1]]
            elif code == ca.OP_OUTPUT:
                results[(out[0], out[1])] = work[args[0]]
            else:
                name = NAMES.get(code)
                if name is None:
                    raise DerivationError(
                        f"the operation number {code} of CasADi has no range rule; write the "
                        "equation with elementary functions",
                        operation=code,
                    )
                operands = [work[a] for a in args]
                work[out[0]] = (
                    REWRITES[name](self, operands)
                    if name in REWRITES
                    else self.plain(name, operands)
                )
        return [
            results[(i, j)] for i in range(function.n_out()) for j in range(function.nnz_out(i))
        ]

    def live(self, outputs: Sequence[int]) -> list[int]:
        """List the nodes needed for some outputs, in order; remembered between calls."""
        key = tuple(outputs)
        if key not in self._live:
            self._live[key] = sorted(
                reached(
                    (self.outputs[k] for k in outputs),
                    lambda k: () if k in self.constants else self.nodes[k].args,
                )
            )
        return self._live[key]

    def schedule(self, outputs: Sequence[int], judged: int) -> Schedule:
        """Arrange the nodes needed for some outputs; remembered between calls."""
        key = tuple(outputs), judged
        if key not in self._schedules:
            breaks = [self.breaks(k) for k in outputs[:judged]]
            wanted = [self.outputs[k] for k in outputs]
            self._schedules[key] = Schedule(self, self.live(outputs), wanted, breaks)
        return self._schedules[key]

    def breaks(self, output: int) -> list[int]:
        """List the operations under an output that may jump or be undefined."""
        if output not in self._breaks:
            self._breaks[output] = [
                k
                for k in self.decisive(output)
                if self.nodes[k].op in PARTIAL.keys() | JUMPS and not self._divides_by_number(k)
            ]
        return self._breaks[output]

    def _divides_by_number(self, index: int) -> bool:
        node = self.nodes[index]
        if node.op != "divide" or node.args[1] not in self.constants:
            return False
        lo, hi = self.constants[node.args[1]]
        return bool(lo[0] > 0.0 or hi[0] < 0.0)

    def decisive(self, output: int) -> list[int]:
        """List the nodes under an output without which it has no range, in order."""

        def onwards(k: int) -> tuple[int, ...]:
            node = self.nodes[k]
            return node.args[1:] if node.op == "meet" else () if k in self.constants else node.args

        found = reached([self.outputs[output]], onwards)
        return sorted(found.difference(self.constants))

    def support(self, output: int) -> tuple[int, ...]:
        """List the variables on which an output depends."""
        found = {self.nodes[k].number for k in self.live([output]) if self.nodes[k].op == "input"}
        return tuple(sorted(found))


@dataclass(frozen=True)
class OutputRanges:
    """Ranges of outputs over a batch; what is rough may jump or be undefined in the box."""

    lower: FloatArray
    upper: FloatArray
    rough: BoolArray


def evaluate(
    program: Program, lower: FloatArray, upper: FloatArray, outputs: Sequence[int] | None = None
) -> tuple[FloatArray, FloatArray]:
    """Enclose outputs of a program over every box of a batch."""
    chosen = range(len(program.outputs)) if outputs is None else outputs
    result = enclose(program, lower, upper, chosen, 0)
    return result.lower, result.upper


def enclose(
    program: Program, lower: FloatArray, upper: FloatArray, outputs: Sequence[int], judged: int
) -> OutputRanges:
    """Enclose outputs as `evaluate` does and judge the smoothness of the first few."""
    schedule = program.schedule(outputs, judged)
    values = schedule.run(lower, upper)
    lo, hi = values.table[:, [values.row[program.outputs[k]] for k in outputs]]
    rough = np.zeros((len(outputs), lower.shape[1]), dtype=bool)
    rough[:judged] = schedule.rough(values)
    unknown = np.isnan(lo) | np.isnan(hi)
    lo[unknown], hi[unknown] = -np.inf, np.inf
    return OutputRanges(lo, hi, rough)


def first_failure(program: Program, lower: FloatArray, upper: FloatArray, output: int) -> str:
    """Name the first operation without a finite result in one box."""
    nodes = program.decisive(output)
    values = Schedule(program, program.live([output]), nodes).run(lower[:, None], upper[:, None])
    for index in nodes:
        node = program.nodes[index]
        finite = bool(np.isfinite(values.of(index)).all())
        if not finite and node.op != "input":
            return PARTIAL.get(node.op, f"an overflow in the operation {node.op!r}")
    return "an unbounded box"
