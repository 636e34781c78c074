"""Guaranteed ranges of expressions over a box: the way into the interval engine."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive.errors import DerivationError
from obsynth.derive.intervals.program import Program, first_failure
from obsynth.derive.intervals.rewriting.quotients import Quotients
from obsynth.derive.intervals.rewriting.removable import remove_singularities
from obsynth.derive.intervals.rules import JUMPS
from obsynth.derive.intervals.search.batch import Problem, Rows, Source, enclose_rows
from obsynth.derive.intervals.search.branch import Budget, Outcome, Search, maximise
from obsynth.derive.intervals.search.reduction import Reduction, preimage, reduce_variables
from obsynth.symbolic.arrays import FloatArray


def make_problem(
    expressions: Any,
    variables: Any,
    box: ArrayLike,
    constants: Any = None,
    constant_box: Sequence[tuple[float, float]] = (),
    quotients: Quotients | None = None,
) -> Problem:
    """Program of expressions and their gradients, ready for `maximise`."""
    box = np.asarray(box, dtype=float)
    column = ca.densify(ca.vec(ca.SX(expressions)))
    variables = ca.vec(ca.SX(variables))
    m, v = column.numel(), variables.numel()
    if box.shape != (v, 2) or np.isnan(box).any() or (box[:, 0] > box[:, 1]).any():
        raise DerivationError(
            f"the box needs one (lower, upper) pair in this order for each of the {v} variables, "
            f"shape ({v}, 2); given was {box.tolist()}",
            box=box,
        )
    extra = ca.SX(0, 1) if constants is None else ca.vec(ca.SX(constants))
    if extra.numel() != len(constant_box):
        raise DerivationError(
            f"{extra.numel()} constants came with {len(constant_box)} enclosures",
            constants=extra.numel(),
            enclosures=len(constant_box),
        )
    given = ca.SX(0, 1) if quotients is None else quotients.column
    inputs = [variables, extra, given]
    free = sorted(map(str, ca.Function("f", inputs, [column], {"allow_free": True}).free_sx()))
    if free:
        raise DerivationError(
            f"the expressions contain the symbols {', '.join(free)}, which have no range here",
            symbols=tuple(free),
        )
    source = None
    if quotients is None:
        source = Source(column, variables, extra, list(constant_box))
        found = remove_singularities(column, variables, extra, box, constant_box)
        column, quotients = (column, Quotients()) if found is None else found
    jacobian = quotients.jacobian(column, variables)
    rows, columns = jacobian.sparsity().get_triplet()
    slopes = ca.SX(jacobian.nz[:]) if rows else ca.SX(0, 1)
    function = ca.Function("ranges", [variables, extra, quotients.column], [column, slopes])
    program = Program(n_variables=v)
    nodes = [program.variable(j) for j in range(v)]
    fixed = [program.number(*pair) for pair in constant_box]
    inside = quotients.insert(program, (variables, nodes), (extra, fixed))
    program.outputs = program.insert(function, [nodes, fixed, inside])
    gradient = np.full((m, v), -1, dtype=np.int64)
    relevant, affine = np.zeros((m, v), dtype=bool), np.zeros((m, v), dtype=bool)
    for k, (e, j) in enumerate(zip(rows, columns, strict=True)):
        gradient[e, j] = m + k
    for e in range(m):
        relevant[e, list(program.support(e))] = True
        if any(program.nodes[k].op in JUMPS for k in program.breaks(e)):
            continue
        for j in np.flatnonzero(relevant[e]).tolist():
            position = int(gradient[e, j])
            affine[e, j] = position >= 0 and j not in program.support(position)
    lower, upper = box[:, 0].copy(), box[:, 1].copy()
    return Problem(program, gradient, relevant, affine, lower, upper, source)


# What a few sweeps over a few boxes settle needs no further thought.
_QUICK = Budget(boxes=4_000, sweeps=7)
# Ranges of quantities that become variables are to add next to nothing to the gap.
_INNER = 1e-3


def staged(problem: Problem, rtol: float, budget: Budget) -> Outcome:
    """Bound every expression of a problem, in fewer variables where it does not see all of them."""
    quick = Budget(min(_QUICK.boxes, budget.boxes), min(_QUICK.sweeps, budget.sweeps))
    search = Search(problem, rtol)
    outcome = search.run(quick)
    left = [
        e for e in range(len(problem.gradient)) if not outcome.finished[2 * e : 2 * e + 2].all()
    ]
    source, found, reduced = problem.source, None, None
    if left and source is not None and np.isfinite(problem.upper - problem.lower).all():
        found = reduce_variables(source.column, source.variables, source.extra, left)
        if found is not None:
            reduced = _reduced(problem, source, found, rtol, budget)
    which = [] if found is None or reduced is None else found.which
    left = [e for e in left if e not in which]
    if left and quick != budget:
        outcome = search.run(budget, left)
    return outcome if reduced is None else _merged(outcome, reduced, which)


def _merged(first: Outcome, second: Outcome, expressions: list[int]) -> Outcome:
    """Take the better of two outcomes for some expressions, the first one for the others."""
    goals = (2 * np.array(expressions)[:, None] + np.arange(2)).ravel()
    merged = replace(
        first,
        bound=first.bound.copy(),
        attained=first.attained.copy(),
        points=first.points.copy(),
        noise=np.maximum(first.noise, second.noise),
        finished=first.finished.copy(),
        singular={},
        boxes=first.boxes + second.boxes,
        sweeps=first.sweeps + second.sweeps,
    )
    merged.bound[goals] = np.minimum(first.bound, second.bound)[goals]
    better = goals[second.attained[goals] > first.attained[goals]]
    merged.attained[better] = second.attained[better]
    merged.points[better] = second.points[better]
    merged.finished[goals] = second.finished[goals]
    for goal, where in (first.singular | second.singular).items():
        if not np.isfinite(merged.bound[goal]):
            merged.singular[goal] = where
    return merged


def _reduced(
    problem: Problem, source: Source, found: Reduction, rtol: float, budget: Budget
) -> Outcome | None:
    """Bound expressions in fewer variables; None where a quantity or a result has no bound."""
    box = np.column_stack([problem.lower, problem.upper])
    constants = source.extra, source.constant_box
    inner_problem = make_problem(found.quantities, source.variables, box, *constants)
    inner = staged(inner_problem, _INNER * rtol, budget)
    ranges = np.column_stack([0.0 - inner.bound[0::2], inner.bound[1::2]])
    if not np.isfinite(ranges).all():
        return None
    variables = ca.vertcat(source.variables, found.symbols)
    outer_problem = make_problem(found.column, variables, np.vstack([box, ranges]), *constants)
    outer = maximise(outer_problem, 0.5 * rtol, budget)
    if outer.singular:
        return None
    return _in_all_variables(problem, source, found, inner, outer, rtol)


def _in_all_variables(
    problem: Problem,
    source: Source,
    found: Reduction,
    inner: Outcome,
    outer: Outcome,
    rtol: float,
) -> Outcome:
    """Carry bounds over, and find points of the original box for what is attained."""
    count, v = 2 * len(problem.gradient), len(problem.lower)
    middles = [0.5 * (low + high) for low, high in source.constant_box]
    quantities = ca.substitute(found.quantities, source.extra, ca.DM(middles))
    function = ca.Function("quantities", [source.variables], [quantities])
    goals, points = [], []
    for k, expression in enumerate(found.which):
        for side in (0, 1):
            there = outer.points[2 * k + side]
            point = np.clip(there[:v], problem.lower, problem.upper)
            for number in found.used[k]:
                ends = inner.points[2 * number], inner.points[2 * number + 1]
                near = preimage(function, number, float(there[v + number]), *ends)
                support = found.supports[number]
                point[support] = np.clip(near, problem.lower, problem.upper)[support]
            goals.append(2 * expression + side)
            points.append(point)
    goal, at = np.array(goals), np.array(points).T
    values = enclose_rows(problem, Rows(goal, at, at, np.zeros(len(goal))), slopes=False)
    bound, attained = np.full(count, np.inf), np.full(count, -np.inf)
    noise, finished = np.zeros(count), np.ones(count, dtype=bool)
    where = np.tile(0.5 * (problem.lower + problem.upper), (count, 1))
    bound[goal], where[goal] = outer.bound, at.T
    attained[goal] = np.where(np.isfinite(values.lower), values.lower, -np.inf)
    noise[goal] = outer.noise
    width = np.repeat(attained[0::2] + attained[1::2], 2)[goal]
    slack = np.maximum(0.5 * rtol * np.maximum(width, 0.0), 4.0 * outer.noise)
    finished[goal] = outer.finished & (outer.bound - attained[goal] <= slack)
    boxes, sweeps = inner.boxes + outer.boxes, inner.sweeps + outer.sweeps
    return Outcome(bound, attained, where, noise, finished, {}, boxes, sweeps)


class Status(StrEnum):
    """How good a bound is; the value is a sentence for the reader."""

    EXACT = "exact: the bound is attained, up to rounding"
    CONVERGED = "converged: the bound is within the tolerance of an attained value"
    BUDGET = "budget: the bound is valid but looser than asked; raise the effort"
    UNBOUNDED = "unbounded: no finite bound over the box"

    @property
    def word(self) -> str:
        """The sentence in one word."""
        return self.value.split(":")[0]

    @classmethod
    def worst(cls, found: Iterable["Status"]) -> "Status":
        """Return the worst of several; EXACT of none."""
        return max(found, key=list(cls).index, default=cls.EXACT)


EFFORTS = {
    "fast": Budget(boxes=4_000, sweeps=60),
    "normal": Budget(boxes=400_000, sweeps=1_500),
    "tight": Budget(boxes=8_000_000, sweeps=10_000),
}


@dataclass(frozen=True, eq=False)
class Failure:
    """An expression without a finite bound: the first operation without one, and the sub-box."""

    index: int
    operation: str
    lower: FloatArray
    upper: FloatArray

    def box(self, names: Sequence[str]) -> dict[str, tuple[float, float]]:
        """Return the sub-box by the names of all variables."""
        ends = zip(self.lower.tolist(), self.upper.tolist(), strict=True)
        return dict(zip(names, ends, strict=True))


@dataclass(frozen=True, eq=False)
class Ends:
    """Guaranteed ranges of m expressions of v variables, (m,), and where they are extreme, (m, v).

    points_lower, points_upper: points with values near the ends
    """

    lower: FloatArray
    upper: FloatArray
    points_lower: FloatArray
    points_upper: FloatArray


@dataclass(frozen=True, eq=False)
class Ranges(Ends):
    """Guaranteed and attained ranges, rounded outwards.

    attained_lower, attained_upper (m,): values the expressions are guaranteed to reach or pass at
        ``points_lower`` and ``points_upper``, so that the true range lies between the two pairs
    gap (m,): guaranteed width minus attained width
    status_lower, status_upper, status: how good the bounds are; ``status`` is the worse of the two
    failures: expressions without a finite bound
    boxes, sweeps: work done
    """

    attained_lower: FloatArray
    attained_upper: FloatArray
    gap: FloatArray
    status_lower: list[Status]
    status_upper: list[Status]
    failures: tuple[Failure, ...]
    boxes: int
    sweeps: int

    @property
    def status(self) -> list[Status]:
        """The worse status of the two bounds of every expression."""
        return list(map(Status.worst, zip(self.status_lower, self.status_upper, strict=True)))


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
    """Enclose the ranges of m CasADi SX expressions of v symbols over their box, (v, 2).

    constants, constant_box: symbols with a fixed value that is no double, and their enclosures
    rtol: wanted gap relative to the width of the attained range
    effort: how many boxes may be spent, see `EFFORTS`
    quotients: what further symbols in the expressions stand for, where they come from the
        derivatives of something with removable singularities. Such singularities in the
        expressions themselves are found without it
    """
    if effort not in EFFORTS:
        raise DerivationError(
            f"effort {effort!r} is not known; choose one of {', '.join(EFFORTS)}", effort=effort
        )
    if not 0.0 <= rtol < 1.0:
        raise DerivationError(f"rtol has to lie in [0, 1); given was {rtol}", rtol=rtol)
    problem = make_problem(expressions, variables, box, constants, constant_box, quotients)
    budget = EFFORTS[effort].for_nodes(len(problem.program.nodes))
    return _ranges(problem, staged(problem, rtol, budget))


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
        outcome.points[0::2],
        outcome.points[1::2],
        0.0 - outcome.attained[0::2],
        outcome.attained[1::2],
        gap.sum(axis=1),
        [pair[0] for pair in status],
        [pair[1] for pair in status],
        tuple(failures[k] for k in sorted(failures)),
        outcome.boxes,
        outcome.sweeps,
    )
