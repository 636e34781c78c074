"""Boxes that hold every trajectory which explains a record with bounds of some size."""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from obsynth.codegen.kernel import Call, dense
from obsynth.designs.core.backward import contract
from obsynth.designs.core.boxes import FAR, Lifted, Rounding
from obsynth.designs.core.lifted import lift
from obsynth.evaluate.bounds.problem import Problem
from obsynth.symbolic.arrays import FloatArray

PASSES = 3
"""Times that the record is gone through, forth and back."""


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes of v at every instant, (N, n_v, 2), and the first instant where nothing is left."""

    ends: FloatArray
    empty: int | None


def enclose(problem: Problem, bounds: FloatArray, passes: int = PASSES) -> Boxes:
    """Cut the ranges of v with the equations and readings, disturbances within bounds."""
    whole = problem.box.copy()
    size = problem.sizes(bounds)
    known = problem.box[:, 0] == problem.box[:, 1]
    w = problem.places["w"]
    whole[w] = np.column_stack([problem.middle - size, problem.middle + size])
    whole[~known] = _wider(whole[~known])
    whole = np.clip(whole, -FAR, FAR)
    step = Call(dense(_cut(problem, whole)))
    steps, n = len(problem), problem.n
    ends = np.broadcast_to(whole, (steps + 1, *whole.shape)).copy()
    ends[-1] = [-FAR, FAR]  # of what follows the record nothing is known
    if problem.first is not None:
        ends[0, :n] = _meet(ends[0, :n], problem.first)
    rates = [np.inf if s.rate is None else s.rate for s in problem.plant.f]
    rates = [0.0 if s.constant else r for r, s in zip(rates, problem.plant.f, strict=True)]
    fault = problem.places["f"]
    still = np.flatnonzero(problem.still)
    readings = np.where(np.isfinite(problem.y)[..., None], problem.y[..., None], [-FAR, FAR])
    order = [*range(steps), *reversed(range(steps))] * passes
    for count, k in enumerate(order):
        step.args[0][:], step.args[1][:] = ends[k, :, 0], ends[k, :, 1]
        step.args[2][:] = problem.u[k]
        step.args[3][:], step.args[4][:] = ends[k + 1, :n, 0], ends[k + 1, :n, 1]
        step.args[5][:], step.args[6][:] = readings[k, :, 0], readings[k, :, 1]
        step.evaluate()
        if step.results[4][0] != 0.0:
            return Boxes(ends[:-1], k)
        ends[k, :, 0], ends[k, :, 1] = step.results[0], step.results[1]
        ends[k + 1, :n, 0], ends[k + 1, :n, 1] = step.results[2], step.results[3]
        other = k + (1 if count // steps % 2 == 0 else -1)
        if 0 <= other < steps:
            ends[other, still] = _meet(ends[other, still], ends[k, still])
            reach = np.array(rates) * (1.0 + 2.0**-50)
            moved = _wider(ends[k, fault] + np.column_stack([-reach, reach]))
            ends[other, fault] = _meet(ends[other, fault], moved)
            if (ends[other, :, 0] > ends[other, :, 1]).any():
                return Boxes(ends[:-1], other)
    return Boxes(ends[:-1], None)


def _wider(ends: FloatArray) -> FloatArray:
    """Step ends outwards."""
    wider: FloatArray = np.nextafter(ends, [-np.inf, np.inf])
    return wider


def _meet(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.stack([np.maximum(a[..., 0], b[..., 0]), np.minimum(a[..., 1], b[..., 1])], axis=-1)


def _cut(problem: Problem, whole: FloatArray) -> ca.Function:
    """Return (v, u, next state, readings) -> (v, next state, 1 where nothing is left), by ends."""
    program, rounding, n = problem.program, Rounding(), problem.n
    sizes = (len(whole), len(whole), problem.u.shape[1], n, n, *2 * (problem.y.shape[1],))
    names = ("v_lower", "v_upper", "u", "x_lower", "x_upper", "y_lower", "y_upper")
    given = [ca.SX.sym(name, size) for name, size in zip(names, sizes, strict=True)]
    v_lower, v_upper, u, x_lower, x_upper, y_lower, y_upper = given
    v = [
        Lifted.number(low) if low == high else Lifted(v_lower[j], v_upper[j], low, high)
        for j, (low, high) in enumerate(whole.tolist())
    ]
    variables = v + [Lifted.point(u[j]) for j in range(u.numel())]
    lower, upper = ca.vertcat(x_lower, y_lower), ca.vertcat(x_upper, y_upper)
    nodes = program.outputs
    image = lift(program, nodes, variables, rounding)
    met = [
        Lifted(ca.fmax(a.lower, lower[i]), ca.fmin(a.upper, upper[i]), a.low, a.high)
        for i, a in enumerate(image)
    ]
    told: dict[int, Lifted] = {}
    for node, value in zip(nodes, met, strict=True):
        if node in told:
            value = Lifted(
                ca.fmax(value.lower, told[node].lower), ca.fmin(value.upper, told[node].upper)
            )
        if node not in program.constants:
            told[node] = value
    found, empty = contract(program, told, variables, rounding)
    for value in met:
        empty = ca.logic_or(empty, value.lower > value.upper)
    columns = [
        ca.vertcat(*(getattr(a, end) for a in part))
        for part in (found[: len(v)], met[:n])
        for end in ("lower", "upper")
    ]
    return ca.Function("cut", given, [*columns, empty])
