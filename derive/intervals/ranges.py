"""Guaranteed ranges of expressions over a box: the way into the interval engine."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive.errors import DerivationError
from obsynth.derive.intervals.evaluate import first_failure
from obsynth.derive.intervals.rewriting.quotients import Quotients
from obsynth.derive.intervals.search.batch import Problem
from obsynth.derive.intervals.search.branch import Budget, Outcome
from obsynth.derive.intervals.search.problem import make_problem
from obsynth.derive.intervals.search.stages import staged
from obsynth.symbolic.arrays import FloatArray


class Status(StrEnum):
    """How good a bound is; the value is a sentence for the reader.

    Examples
    --------
    >>> print(Status.CONVERGED)
    converged: the bound is within the tolerance of an attained value
    """

    EXACT = "exact: the bound is attained, up to rounding"
    CONVERGED = "converged: the bound is within the tolerance of an attained value"
    BUDGET = "budget: the bound is valid but looser than asked; raise the effort"
    UNBOUNDED = "unbounded: no finite bound over the box"


EFFORTS = {
    "fast": Budget(boxes=4_000, sweeps=60),
    "normal": Budget(boxes=400_000, sweeps=1_500),
    "tight": Budget(boxes=8_000_000, sweeps=10_000),
}


@dataclass(frozen=True, eq=False)
class Failure:
    """An expression without a finite bound.

    index: which expression
    operation: the first operation without a finite result
    lower, upper: the sub-box where that happens
    """

    index: int
    operation: str
    lower: FloatArray
    upper: FloatArray


@dataclass(frozen=True, eq=False)
class Ranges:
    """Guaranteed and attained ranges of m expressions of v variables.

    Attributes
    ----------
    lower, upper : ndarray, shape (m,)
        Guaranteed bounds, rounded outwards.
    attained_lower, attained_upper : ndarray, shape (m,)
        Values the expressions are guaranteed to reach or pass at ``points_lower`` and
        ``points_upper``, so that the true range lies between the two pairs.
    points_lower, points_upper : ndarray, shape (m, v)
        Where.
    gap : ndarray, shape (m,)
        Guaranteed width minus attained width.
    status_lower, status_upper, status : list of Status
        How good the bounds are; ``status`` is the worse of the two.
    failures : tuple of Failure
        Expressions without a finite bound.
    boxes, sweeps : int
        Work done.
    """

    lower: FloatArray
    upper: FloatArray
    attained_lower: FloatArray
    attained_upper: FloatArray
    points_lower: FloatArray
    points_upper: FloatArray
    gap: FloatArray
    status_lower: list[Status]
    status_upper: list[Status]
    failures: tuple[Failure, ...]
    boxes: int
    sweeps: int

    @property
    def status(self) -> list[Status]:
        """The worse status of the two bounds of every expression."""
        order = list(Status)
        return [
            max(pair, key=order.index)
            for pair in zip(self.status_lower, self.status_upper, strict=True)
        ]


def bound_ranges(
    expressions: Any,
    variables: Any,
    box: ArrayLike,
    constants: Any = None,
    constant_box: Sequence[tuple[float, float]] = (),
    rtol: float = 1e-6,
    effort: str = "normal",
    quotients: Quotients | None = None,
) -> Ranges:
    """Enclose the ranges of CasADi SX expressions over a box.

    Parameters
    ----------
    expressions : casadi.SX
        m expressions.
    variables : casadi.SX
        v symbols.
    box : array_like, shape (v, 2)
        Their ranges.
    constants : casadi.SX, optional
        Symbols with a fixed, not exactly representable value.
    constant_box : sequence of (float, float)
        Enclosures of these values.
    rtol : float
        Wanted gap relative to the width of the attained range.
    effort : {"fast", "normal", "tight"}
        How many boxes may be spent.
    quotients : Quotients, optional
        What further symbols in the expressions stand for, where they come from the derivatives of
        something with removable singularities. Such singularities in the expressions themselves
        are found without it.

    Returns
    -------
    Ranges
        Bounds, attained values and points, gaps, status.

    Raises
    ------
    DerivationError
        A box or an effort that is not understood, an operation without a range rule.

    Examples
    --------
    >>> import casadi as ca
    >>> x = ca.SX.sym("x")
    >>> found = bound_ranges(x * (1 - x), x, [(0, 1)])
    >>> bool(0.25 <= found.upper[0] < 0.25 + 1e-6), found.points_upper[0].tolist()
    (True, [0.5])
    """
    if effort not in EFFORTS:
        raise DerivationError(
            f"effort {effort!r} is not known; choose one of {', '.join(EFFORTS)}", effort=effort
        )
    if not 0.0 <= rtol < 1.0:
        raise DerivationError(f"rtol has to lie in [0, 1); given was {rtol}", rtol=rtol)
    problem = make_problem(expressions, variables, box, constants, constant_box, quotients)
    return _ranges(problem, staged(problem, rtol, EFFORTS[effort]))


def _ranges(problem: Problem, outcome: Outcome) -> Ranges:
    m = len(problem.gradient)
    gap = (outcome.bound - outcome.attained).reshape(m, 2)
    rounding = np.maximum(4.0 * outcome.noise, 1e-15 * np.abs(outcome.bound)).reshape(m, 2)
    finished = outcome.finished.reshape(m, 2)
    status: list[list[Status]] = []
    for e in range(m):
        pair = []
        for side in (0, 1):
            if 2 * e + side in outcome.singular:
                pair.append(Status.UNBOUNDED)
            elif gap[e, side] <= rounding[e, side]:
                pair.append(Status.EXACT)
            else:
                pair.append(Status.CONVERGED if finished[e, side] else Status.BUDGET)
        status.append(pair)
    failures: dict[int, Failure] = {}
    for goal, (lower, upper) in outcome.singular.items():
        operation = first_failure(problem.program, lower, upper, goal // 2)
        failures.setdefault(goal // 2, Failure(goal // 2, operation, lower, upper))
    return Ranges(
        0.0 - outcome.bound[0::2],
        outcome.bound[1::2] + 0.0,
        0.0 - outcome.attained[0::2],
        outcome.attained[1::2],
        outcome.points[0::2],
        outcome.points[1::2],
        gap.sum(axis=1),
        [pair[0] for pair in status],
        [pair[1] for pair in status],
        tuple(failures[k] for k in sorted(failures)),
        outcome.boxes,
        outcome.sweeps,
    )
