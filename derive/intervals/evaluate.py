"""Evaluation of an interval program over a batch of boxes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from obsynth.derive.intervals.program import Program
from obsynth.derive.intervals.schedule import Schedule
from obsynth.derive.rigour.interval import Array

__all__ = ["Enclosure", "enclose", "evaluate", "first_failure"]


@dataclass(frozen=True)
class Enclosure:
    """Ranges of outputs over a batch, and where their derivatives can be relied upon.

    Attributes
    ----------
    lower, upper : ndarray, shape (n_outputs, N)
        The ranges.
    rough : ndarray of bool, shape (n_outputs, N)
        True where an operation under the output may jump or be undefined inside the box, so that
        neither monotonicity nor the mean-value form says anything.
    """

    lower: Array
    upper: Array
    rough: NDArray[np.bool_]


def evaluate(
    program: Program, lower: Array, upper: Array, outputs: Sequence[int] | None = None
) -> tuple[Array, Array]:
    """Enclose outputs of a program over every box of a batch.

    Parameters
    ----------
    program : Program
        The function.
    lower, upper : ndarray, shape (n_variables, N)
        The boxes, one per column.
    outputs : sequence of int, optional
        Positions in ``program.outputs``; all of them by default.

    Returns
    -------
    (ndarray, ndarray), shape (n_outputs, N)
        Lower and upper bounds of the natural extension, rounded outwards; infinite where an
        operation is undefined or unbounded in the box.

    Examples
    --------
    >>> import casadi as ca, numpy as np
    >>> x = ca.SX.sym("x")
    >>> program = Program.from_casadi(ca.Function("f", [x], [ca.sqrt(x) - 1]))
    >>> lo, hi = evaluate(program, np.array([[1.0, 4.0]]), np.array([[4.0, 9.0]]))
    >>> np.round(hi, 12).tolist()
    [[1.0, 2.0]]
    """
    chosen = range(len(program.outputs)) if outputs is None else outputs
    result = enclose(program, lower, upper, chosen, 0)
    return result.lower, result.upper


def enclose(
    program: Program, lower: Array, upper: Array, outputs: Sequence[int], judged: int
) -> Enclosure:
    """Enclose outputs as `evaluate` does and judge the smoothness of the first few.

    Parameters
    ----------
    program : Program
        The function.
    lower, upper : ndarray, shape (n_variables, N)
        The boxes, one per column.
    outputs : sequence of int
        Positions in ``program.outputs``.
    judged : int
        How many of the outputs, from the first, are asked whether they are rough.

    Returns
    -------
    Enclosure
        Ranges and roughness; outputs that were not judged count as smooth.
    """
    schedule = program.schedule(outputs, judged)
    values = schedule.run(lower, upper)
    lo, hi = values.table[:, [values.row[program.outputs[k]] for k in outputs]]
    rough = np.zeros((len(outputs), lower.shape[1]), dtype=bool)
    rough[:judged] = schedule.rough(values)
    unknown = np.isnan(lo) | np.isnan(hi)
    lo[unknown], hi[unknown] = -np.inf, np.inf
    return Enclosure(lo, hi, rough)


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


def first_failure(program: Program, lower: Array, upper: Array, output: int) -> str:
    """Name the first operation without a finite result in one box.

    Parameters
    ----------
    program : Program
        The function.
    lower, upper : ndarray, shape (n_variables,)
        The box.
    output : int
        Position in ``program.outputs``.

    Returns
    -------
    str
        A phrase such as "a division by an interval that contains zero".
    """
    nodes = program.decisive(output)
    values = Schedule(program, program.live([output]), nodes).run(lower[:, None], upper[:, None])
    for index in nodes:
        node = program.nodes[index]
        finite = bool(np.isfinite(values.of(index)).all())
        if not finite and node.op != "input":
            return _SENTENCES.get(node.op, f"an overflow in the operation {node.op!r}")
    return "an unbounded box"
