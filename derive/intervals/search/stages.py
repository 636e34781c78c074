"""The order of attack: a quick look, fewer variables where possible, then all the budget."""

from dataclasses import replace

import casadi as ca
import numpy as np

from obsynth.derive.intervals.search.batch import Problem, Rows, Source, enclose_rows
from obsynth.derive.intervals.search.branch import Budget, Outcome, Search, maximise
from obsynth.derive.intervals.search.problem import make_problem
from obsynth.derive.intervals.search.reduction import Reduction, preimage, reduce_variables

# What a few sweeps over a few boxes settle needs no further thought.
_QUICK = Budget(boxes=4_000, sweeps=7)
# A gap that falls to this share in two sweeps over few boxes is soon closed.
_FEW, _FAST = 400, 0.25
# Ranges of quantities that become variables are to add next to nothing to the gap.
_INNER = 1e-3


def staged(problem: Problem, rtol: float, budget: Budget) -> Outcome:
    """Bound every expression of a problem, in fewer variables where it does not see all of them."""
    quick = Budget(min(_QUICK.boxes, budget.boxes), min(_QUICK.sweeps, budget.sweeps))
    search = Search(problem, rtol)
    outcome = _while_quick(search, quick, budget)
    left = [
        e for e in range(len(problem.gradient)) if not outcome.finished[2 * e : 2 * e + 2].all()
    ]
    if left and problem.source is not None and np.isfinite(problem.upper - problem.lower).all():
        source = problem.source
        found = reduce_variables(source.column, source.variables, source.extra, left)
        reduced = None if found is None else _reduced(problem, source, found, rtol, budget)
        if found is not None and reduced is not None:
            outcome = _merged(outcome, reduced, found.which)
            left = [e for e in left if e not in found.which]
    if not left or quick == budget:
        return outcome
    spent = search.boxes, search.sweeps
    last = search.run(budget, left)
    # what was spent before is counted already
    last = replace(last, boxes=last.boxes - spent[0], sweeps=last.sweeps - spent[1])
    return _merged(outcome, last, left)


def _while_quick(search: Search, quick: Budget, budget: Budget) -> Outcome:
    """Search for a while, and on as long as few boxes are left and the gap falls fast."""
    outcome = search.run(quick)
    while 0 < search.open.count <= _FEW and search.sweeps < budget.sweeps:
        before = search.excess()
        outcome = search.run(replace(budget, sweeps=search.sweeps + 2))
        after = search.excess()
        if not np.isfinite(after) or after > _FAST * before:
            break
    return outcome


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
        singular=first.singular | second.singular,
        boxes=first.boxes + second.boxes,
        sweeps=first.sweeps + second.sweeps,
    )
    merged.bound[goals] = np.minimum(first.bound, second.bound)[goals]
    better = goals[second.attained[goals] > first.attained[goals]]
    merged.attained[better] = second.attained[better]
    merged.points[better] = second.points[better]
    merged.finished[goals] = second.finished[goals]
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
