"""Evaluation of an interval program over a batch of boxes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from obsynth.derive.intervals.program import Program
from obsynth.derive.intervals.schedule import Schedule
from obsynth.symbolic.arrays import BoolArray, FloatArray


@dataclass(frozen=True)
class OutputRanges:
    """Ranges of outputs over a batch, and where their derivatives can be relied upon.

    lower, upper: the ranges
    rough: true where an operation under the output may jump or be undefined inside the box, so that
        neither monotonicity nor the mean-value form says anything
    """

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


_SENTENCES = {
    "divide": "a division by an interval that contains zero",
    "sqrt": "a square root of an interval that reaches below zero",
    "nonnegative": "a square root of an interval that reaches below zero",
    "log": "a logarithm of an interval that reaches zero",
    "log1p": "a logarithm of an interval that reaches zero",
    "power": "a power of an interval that reaches zero",
    "power_const": "a fractional or negative power of an interval that reaches zero",
    "tangent": "a tangent over a pole",
    "asin": "an arc sine of an interval that leaves [-1, 1]",
    "acos": "an arc cosine of an interval that leaves [-1, 1]",
    "acosh": "an inverse hyperbolic cosine of an interval that reaches below 1",
    "atanh": "an inverse hyperbolic tangent of an interval that reaches -1 or 1",
}


def first_failure(program: Program, lower: FloatArray, upper: FloatArray, output: int) -> str:
    """Name the first operation without a finite result in one box."""
    nodes = program.decisive(output)
    values = Schedule(program, program.live([output]), nodes).run(lower[:, None], upper[:, None])
    for index in nodes:
        node = program.nodes[index]
        finite = bool(np.isfinite(values.of(index)).all())
        if not finite and node.op != "input":
            return _SENTENCES.get(node.op, f"an overflow in the operation {node.op!r}")
    return "an unbounded box"
