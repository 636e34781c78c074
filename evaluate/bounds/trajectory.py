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
    """What could have happened, v (N, n_v).

    bounds: that it needs, (n_groups,); infinite where none was found that meets the equations
    gap: by how much the equations and rates are not met, at most
    """

    bounds: FloatArray
    v: FloatArray = field(repr=False)
    gap: float


def explain(
    problem: Problem,
    weights: FloatArray,
    largest: FloatArray | None = None,
    start: FloatArray | None = None,
) -> Trajectory:
    """Return a trajectory of small ``weights'bounds``, from (N, n_v) where a start is given.

    largest: of the bounds, (n_groups,)
    """
    search = Search.of(problem)
    bounds = ca.MX.sym("bounds", len(problem.groups))
    size = ca.DM(problem.shape) * ca.vertcat(bounds, 1.0)[problem.group.tolist()]
    room = ca.vec(ca.repmat(size, 1, len(problem)))
    top = np.full(len(problem.groups), np.inf) if largest is None else largest
    bottom = np.minimum(problem.smallest, top)
    first = guess(problem) if start is None else start
    answer = search.minimise(
        ca.dot(ca.DM(weights), bounds),
        ca.vertcat(search.off - room, -search.off - room),
        first,
        bounds,
        (bottom, np.minimum(_reach(problem, first), top), top),
    )
    return measured(problem, answer)


@dataclass(frozen=True, eq=False)
class Search:
    """A search among the trajectories of a problem, v (n_v, N).

    zeros: what is zero of a trajectory that agrees with the readings
    off: disturbances less their middles, (n_w N,), one instant after the other
    rates: what is not positive of faults with a rate
    """

    problem: Problem
    v: ca.MX
    zeros: ca.MX
    off: ca.MX
    rates: ca.MX

    @classmethod
    def of(cls, problem: Problem) -> "Search":
        """Write the equations of every instant."""
        steps, n_u, n = len(problem), problem.u.shape[1], problem.n
        v = ca.MX.sym("v", len(problem.box), steps)
        inputs = ca.DM(problem.u.T).reshape((n_u, steps))
        rows, shown = problem.equations.map(steps)(v, inputs)
        equal = [ca.vec(v[:n, 1:] - rows[:, :-1])]
        for i, read in enumerate(np.isfinite(problem.y).T):
            k = np.flatnonzero(read).tolist()
            if k:
                equal.append((shown[i, k] - ca.DM(problem.y[k, i]).T).T)
        loose = problem.box[:, 0] < problem.box[:, 1]
        still = np.flatnonzero(problem.still & loose).tolist()
        equal.append(ca.vec(v[still, 1:] - v[still, :-1]))
        rates = [ca.MX(0, 1)]
        for j, signal in enumerate(problem.plant.f, problem.places["f"].start):
            moved = ca.vec(v[j, 1:] - v[j, :-1])
            if signal.constant:
                equal.append(moved)
            elif signal.rate is not None:
                rates += [moved - signal.rate, -moved - signal.rate]
        off = v[problem.places["w"], :] - ca.repmat(ca.DM(problem.middle), 1, steps)
        return cls(problem, v, ca.vertcat(*equal), ca.vec(off), ca.vertcat(*rates))

    def minimise(
        self,
        objective: ca.MX,
        within: ca.MX,
        start: FloatArray,
        extra: ca.MX,
        ends: tuple[FloatArray, FloatArray, FloatArray],
    ) -> FloatArray:
        """Return v of the smallest objective, (N, n_v), in the ranges.

        within: what else is not positive
        extra, ends: further variables; their lower ends, start and upper ends
        """
        problem, steps = self.problem, len(self.problem)
        box = problem.box.copy()
        box[problem.places["w"]] = [-np.inf, np.inf]
        low, high = (np.tile(box[:, side], steps) for side in (0, 1))
        inside = ca.vertcat(self.rates, within)
        solver = ca.nlpsol(
            "search",
            "ipopt",
            {
                "x": ca.vertcat(ca.vec(self.v), extra),
                "f": objective,
                "g": ca.vertcat(self.zeros, inside),
            },
            {
                "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 400, "tol": 1e-9},
                "ipopt.bound_relax_factor": 0.0,
                "print_time": False,
                "show_eval_warnings": False,
                "error_on_fail": False,
            },
        )
        zero = np.zeros(self.zeros.numel())
        found = solver(
            x0=np.concatenate([start.ravel(), ends[1]]),
            lbx=np.concatenate([low, ends[0]]),
            ubx=np.concatenate([high, ends[2]]),
            lbg=np.concatenate([zero, np.full(inside.numel(), -np.inf)]),
            ubg=np.concatenate([zero, np.zeros(inside.numel())]),
        )
        answer = np.array(found["x"]).ravel()[: self.v.numel()].reshape(steps, len(box))
        answer[:, problem.still] = answer[0, problem.still]
        inside_box: FloatArray = np.clip(answer, box[:, 0], box[:, 1])
        return inside_box


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
    """Return v with disturbances that close the equations best, and what stays open, (N, n + m).

    Those whose bounds are not looked for stay inside of theirs.
    """
    w, path = problem.places["w"], v.copy()
    free = (problem.group < len(problem.groups)) & (problem.shape > 0.0)
    held = np.where(free, np.inf, problem.shape)
    path[:, w] = np.clip(path[:, w], problem.middle - held, problem.middle + held)
    s = ca.MX.sym("v", v.shape[1])
    u = ca.MX.sym("u", problem.u.shape[1])
    both = ca.vertcat(*problem.equations(s, u))
    slope = ca.Function("slope", [s, u], [both, ca.jacobian(both, s)[:, w]])
    left = np.zeros((len(v), both.numel()))
    for k in range(len(v)):
        target = np.concatenate(
            [v[k + 1, : problem.n] if k + 1 < len(v) else np.full(problem.n, np.nan), problem.y[k]]
        )
        rows = np.isfinite(target)
        for _ in range(2):
            value, E = (np.array(part) for part in slope(path[k], problem.u[k]))
            miss = (target - value.ravel())[rows]
            path[k, w] += np.linalg.lstsq(E[rows] * free, miss, rcond=1e-12)[0]
        value = np.array(slope(path[k], problem.u[k])[0]).ravel()
        left[k, rows] = (target - value)[rows]
    return path, left


def measured(problem: Problem, v: FloatArray) -> Trajectory:
    """Return a trajectory with the bounds that it needs itself."""
    path, left = closed(problem, v)
    off = np.abs(path[:, problem.places["w"]] - problem.middle)
    needed = np.zeros(len(problem.groups))
    for g in range(len(problem.groups)):
        members = (problem.group == g) & (problem.shape > 0.0)
        needed[g] = (off[:, members] / problem.shape[members]).max(initial=0.0) * (1.0 + 1e-12)
    f = path[:, problem.places["f"]]
    rates = [0.0 if s.constant else s.rate or np.inf for s in problem.plant.f]
    moved = (np.abs(np.diff(f, axis=0)) - rates).max(initial=0.0)
    gap = max(float(np.abs(left).max(initial=0.0)), float(moved))
    size = float(np.abs(problem.y[np.isfinite(problem.y)]).max(initial=0.0))
    if not gap <= CLOSED * (1.0 + size):
        needed[:] = np.inf
    return Trajectory(np.maximum(needed, problem.smallest), path, gap)
