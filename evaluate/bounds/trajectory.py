"""A trajectory that explains a record with small bounds, by Ipopt; it proves itself."""

from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from obsynth.evaluate.bounds.problem import Problem
from obsynth.symbolic.arrays import FloatArray

CLOSED = 1e-9
"""By how much, relative to the readings, a trajectory may miss equations without disturbances."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """What could have happened.

    bounds: that it needs, (n_groups,); infinite where none was found that meets the equations
    v: (N, n_v)
    gap: by how much the equations are not met, at most
    where: for every group the instant and the disturbance that needs the most
    """

    bounds: FloatArray
    v: FloatArray = field(repr=False)
    gap: float
    where: tuple[tuple[int, str], ...]


def explain(
    problem: Problem,
    weights: FloatArray,
    largest: FloatArray | None = None,
    start: FloatArray | None = None,
    least: FloatArray | None = None,
) -> Trajectory:
    """Return a trajectory of small ``weights'bounds``, from (N, n_v) where a start is given.

    largest, least: of the bounds, (n_groups,)
    """
    steps, n_v, n_u = len(problem), len(problem.box), problem.u.shape[1]
    v = ca.MX.sym("v", n_v, steps)
    bounds = ca.MX.sym("bounds", len(problem.groups))
    rows, shown = problem.equations.map(steps)(v, ca.DM(problem.u.T).reshape((n_u, steps)))
    n = problem.n
    read = np.isfinite(problem.y)
    equal = [ca.vec(v[:n, 1:] - rows[:, :-1])]
    for i in range(read.shape[1]):
        k = np.flatnonzero(read[:, i]).tolist()
        if k:
            equal.append((shown[i, k] - ca.DM(problem.y[k, i]).T).T)
    still = np.flatnonzero(problem.still).tolist()
    if still and steps > 1:
        equal.append(ca.vec(v[still, 1:] - v[still, :-1]))
    zeros = ca.vertcat(*equal)
    w = v[problem.places["w"], :]
    size = ca.DM(problem.shape) * ca.vertcat(bounds, 1.0)[problem.group.tolist()]
    room = ca.repmat(size, 1, steps)
    off = w - ca.repmat(ca.DM(problem.middle), 1, steps)
    within = [ca.vec(off - room), ca.vec(-off - room)]
    faults = problem.places["f"]
    for j, signal in enumerate(problem.plant.f):
        rate = 0.0 if signal.constant else signal.rate
        if rate is not None:
            moved = ca.vec(v[faults.start + j, 1:] - v[faults.start + j, :-1])
            within += [moved - rate, -moved - rate]
    inside = ca.vertcat(*within)
    box = problem.box.copy()
    box[problem.places["w"]] = [-np.inf, np.inf]
    low, high = (np.tile(box[:, side], steps) for side in (0, 1))
    top = np.full(len(problem.groups), np.inf) if largest is None else largest
    bottom = np.zeros(len(problem.groups)) if least is None else least
    first = guess(problem) if start is None else start
    solver = ca.nlpsol(
        "explain",
        "ipopt",
        {
            "x": ca.vertcat(ca.vec(v), bounds),
            "f": ca.dot(ca.DM(weights), bounds),
            "g": ca.vertcat(zeros, inside),
        },
        {
            "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 400, "tol": 1e-9},
            "print_time": False,
            "show_eval_warnings": False,
            "error_on_fail": False,
        },
    )
    zero, below = np.zeros(zeros.numel()), np.full(inside.numel(), -np.inf)
    found = solver(
        x0=np.concatenate([first.ravel(), np.minimum(_reach(problem, first), top)]),
        lbx=np.concatenate([low, bottom]),
        ubx=np.concatenate([high, top]),
        lbg=np.concatenate([zero, below]),
        ubg=np.concatenate([zero, np.zeros(inside.numel())]),
    )
    answer = np.array(found["x"]).ravel()[: n_v * steps].reshape(steps, n_v)
    answer[:, problem.still] = answer[0, problem.still]
    return measured(problem, np.clip(answer, box[:, 0], box[:, 1]))


def _reach(problem: Problem, v: FloatArray) -> float:
    """Return a bound that is about large enough for a trajectory."""
    _, missed = closed(problem, v)
    return float(np.abs(missed).max(initial=0.0)) + 1e-3


def guess(problem: Problem) -> FloatArray:
    """Return a trajectory to begin with, (N, n_v): by readings, by equations where none tell."""
    box, n = problem.box, problem.n
    with np.errstate(invalid="ignore"):
        at = np.nan_to_num(0.5 * box[:, 0] + 0.5 * box[:, 1], nan=0.0, posinf=0.0, neginf=0.0)
    faults = problem.places["f"]
    at[faults] = np.clip(0.0, *problem.box[faults].T)
    at[problem.places["w"]] = problem.middle
    for j, signal in enumerate(problem.plant.x):
        at[j] = at[j] if signal.nominal is None else signal.nominal
    v, u = ca.MX.sym("v", len(box)), ca.MX.sym("u", problem.u.shape[1])
    C = ca.Function("C", [v, u], [ca.jacobian(problem.equations(v, u)[1], v)[:, :n]])
    path = np.tile(at, (len(problem), 1))
    for k in range(len(problem)):
        read = np.isfinite(problem.y[k])
        shown = np.array(problem.equations(path[k], problem.u[k])[1]).ravel()
        slopes = np.array(C(path[k], problem.u[k]))[read]
        if read.any():
            moved = np.linalg.pinv(slopes, rcond=1e-6) @ (problem.y[k] - shown)[read]
            path[k, :n] = np.clip(path[k, :n] + moved, box[:n, 0], box[:n, 1])
        if k + 1 < len(problem):
            onward = np.array(problem.equations(path[k], problem.u[k])[0]).ravel()
            path[k + 1, :n] = np.clip(
                np.where(np.isfinite(onward), onward, path[k, :n]), box[:n, 0], box[:n, 1]
            )
    return path


def closed(problem: Problem, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return v with disturbances that close the equations best, and what stays open, (N, n + m)."""
    w = problem.places["w"]
    s = ca.MX.sym("v", v.shape[1])
    u = ca.MX.sym("u", problem.u.shape[1])
    both = ca.vertcat(*problem.equations(s, u))
    slope = ca.Function("slope", [s, u], [both, ca.jacobian(both, s)[:, w]])
    path, left = v.copy(), np.zeros((len(v), both.numel()))
    for k in range(len(v)):
        target = np.concatenate(
            [v[k + 1, : problem.n] if k + 1 < len(v) else np.full(problem.n, np.nan), problem.y[k]]
        )
        rows = np.isfinite(target)
        for _ in range(2):
            value, E = (np.array(part) for part in slope(path[k], problem.u[k]))
            miss = (target - value.ravel())[rows]
            path[k, w] += np.linalg.lstsq(E[rows], miss, rcond=1e-12)[0]
        value = np.array(slope(path[k], problem.u[k])[0]).ravel()
        left[k, rows] = (target - value)[rows]
    return path, left


def measured(problem: Problem, v: FloatArray) -> Trajectory:
    """Return a trajectory with the bounds that it needs itself."""
    path, left = closed(problem, v)
    off = np.abs(path[:, problem.places["w"]] - problem.middle)
    names, bounds, where = problem.plant.names("w"), [], []
    for g in range(len(problem.groups)):
        members = np.flatnonzero((problem.group == g) & (problem.shape > 0.0))
        need = off[:, members] / problem.shape[members]
        k, j = np.unravel_index(int(need.argmax()), need.shape)
        bounds.append(float(need[k, j]) * (1.0 + 1e-12))
        where.append((int(k), names[members[j]]))
    gap = float(np.abs(left).max(initial=0.0))
    size = float(np.abs(problem.y[np.isfinite(problem.y)]).max(initial=0.0))
    needed = np.array(bounds) if gap <= CLOSED * (1.0 + size) else np.full(len(bounds), np.inf)
    return Trajectory(needed, path, gap, tuple(where))
