"""The linear program that every trajectory which explains a record satisfies, and its certificate.

Variables are the nodes of the equations at every instant (`relaxation`), the parameters that stand
still, and the bounds. From any multipliers of its rows, however found, a lower bound follows in
exact rationals: with rows ``A z <= b`` (and equalities), ``lo <= z <= hi`` and ``r = c + A' lam``,

    c'z >= -lam'b + sum_j min(r_j lo_j, r_j hi_j)        for every lam >= 0 (free for equalities).
"""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import csr_array, hstack, vstack

from obsynth.derive.intervals.graph import Schedule
from obsynth.derive.rigour import Interval
from obsynth.derive.rigour.rationals import number
from obsynth.designs.core.boxes import FAR
from obsynth.evaluate.bounds.boxes import Boxes
from obsynth.evaluate.bounds.problem import Problem
from obsynth.evaluate.bounds.relaxation import relax
from obsynth.evaluate.errors import BoundsError
from obsynth.symbolic.arrays import BoolArray, FloatArray, IntArray

_TOLERANCES = ("primal_feasibility_tolerance", "dual_feasibility_tolerance")


@dataclass(frozen=True, eq=False)
class Solution:
    """What a linear program says.

    value: by the solver, infinite where it found no point
    certified: what the objective is proved not to be below; infinite: proved to have no point
    """

    value: float
    certified: float
    z: FloatArray = field(repr=False)
    multipliers: FloatArray = field(repr=False)


@dataclass(frozen=True, eq=False)
class Linear:
    """Rows ``A z <= b`` (equalities where `equal`) and ends of the variables.

    noise: the two rows of every disturbance at every instant, (N, n_w, 2), -1 where there are none
    bounds: places of the bounds in z, (n_groups,)
    shared: places of the variables of v at every instant in z, (N, n_v)
    """

    A: Any
    b: FloatArray
    equal: BoolArray
    lower: FloatArray
    upper: FloatArray
    noise: IntArray
    bounds: IntArray
    shared: IntArray

    def cost(self, weights: FloatArray) -> FloatArray:
        """Return the objective ``weights'bounds``."""
        cost = np.zeros(len(self.lower))
        cost[self.bounds] = weights
        return cost

    def limited(self, weights: FloatArray, most: float) -> "Linear":
        """Return the program with ``weights'bounds <= most`` besides."""
        row = csr_array(self.cost(weights)[None])
        return replace(
            self,
            A=vstack([self.A, row]).tocsr(),
            b=np.append(self.b, most),
            equal=np.append(self.equal, False),
        )

    def range_of(self, place: int) -> tuple[float, float]:
        """Return certified ends of a variable; they cross where there is no point."""
        found = []
        for sign in (1.0, -1.0):
            cost = np.zeros(len(self.lower))
            cost[place] = sign
            solution = self.minimise(cost)
            if solution.certified == np.inf:
                return np.inf, -np.inf
            found.append(sign * solution.certified)
        return max(found[0], float(self.lower[place])), min(found[1], float(self.upper[place]))

    def elastic(self, bounds: FloatArray) -> FloatArray:
        """Return by how much every disturbance is past its bound, least in sum, (N, n_w)."""
        which = self.noise[self.noise >= 0]
        count = len(which)
        slack = csr_array((-np.ones(count), (which, np.arange(count))), (len(self.b), count))
        lower, upper = self.lower.copy(), self.upper.copy()
        lower[self.bounds] = upper[self.bounds] = bounds
        wider = replace(
            self,
            A=hstack([self.A, slack]).tocsr(),
            lower=np.append(lower, np.zeros(count)),
            upper=np.append(upper, np.full(count, np.inf)),
        )
        cost = np.append(np.zeros(len(lower)), np.ones(count))
        found, z = np.zeros(self.noise.shape), wider.minimise(cost, certify=False).z
        if not len(z):
            raise BoundsError("where the bounds are too small was not found: no linear program.")
        found[self.noise >= 0] = z[len(lower) :]
        total: FloatArray = found.sum(axis=2)
        return total

    def minimise(self, cost: FloatArray, certify: bool = True) -> Solution:
        """Return the least ``cost'z``."""
        upper, same = ~self.equal, self.equal
        for tolerance, presolve in ((1e-9, True), (1e-9, False), (1e-7, True), (1e-7, False)):
            # what is as tight as a bound that is attained is called empty at times
            with np.errstate(all="ignore"):
                found = linprog(
                    cost,
                    A_ub=self.A[upper] if upper.any() else None,
                    b_ub=self.b[upper] if upper.any() else None,
                    A_eq=self.A[same] if same.any() else None,
                    b_eq=self.b[same] if same.any() else None,
                    bounds=np.column_stack([self.lower, self.upper]),
                    method="highs",
                    options=dict.fromkeys(_TOLERANCES, tolerance) | {"presolve": presolve},
                )
            if found.status == 0:
                break
            if certify and found.status == 2 and self.empty():
                return Solution(np.inf, np.inf, np.empty(0), np.empty(0))
        else:
            return Solution(np.inf, -np.inf, np.empty(0), np.empty(0))
        multipliers = np.zeros(len(self.b))
        multipliers[upper] = np.maximum(-found.ineqlin.marginals, 0.0)
        multipliers[same] = -found.eqlin.marginals
        proved = self.certify(cost, multipliers) if certify else -np.inf
        return Solution(float(found.fun), proved, found.x, multipliers)

    def empty(self) -> bool:
        """Prove that there is no point: all rows together have to give way by something."""
        same = self.equal
        A, b = vstack([self.A, -self.A[same]]), np.append(self.b, -self.b[same])
        slack = csr_array(np.full((len(b), 1), -1.0))
        relaxed = replace(
            self,
            A=hstack([A, slack]).tocsr(),
            b=b,
            equal=np.zeros(len(b), dtype=bool),
            lower=np.append(self.lower, 0.0),
            upper=np.append(self.upper, np.inf),
        )
        cost = np.zeros(len(self.lower) + 1)
        cost[-1] = 1.0
        multipliers = relaxed.minimise(cost, certify=False).multipliers
        relaxed.upper[-1] = 1.0  # a point of ours would be there, with nothing
        crossed = bool((self.lower > self.upper).any())
        return crossed or relaxed.certify(cost, multipliers) > 0.0

    def certify(self, cost: FloatArray, multipliers: FloatArray) -> float:
        """Return what multipliers prove, rounded down from exact rationals."""
        reduced = {int(j): number(cost[j]) for j in np.flatnonzero(cost)}
        total = number(0.0)
        for row in np.flatnonzero(multipliers):
            weight = number(multipliers[row])
            total -= weight * number(self.b[row])
            part = slice(self.A.indptr[row], self.A.indptr[row + 1])
            for j, value in zip(
                self.A.indices[part].tolist(), self.A.data[part].tolist(), strict=True
            ):
                reduced[j] = reduced.get(j, 0) + weight * number(value)
        for j, r in reduced.items():
            if r != 0:
                end = float(self.lower[j] if r > 0 else self.upper[j])
                if not np.isfinite(end):
                    return -np.inf
                total += r * number(end)
        nearest = int(total.p) / int(total.q)
        return float(np.nextafter(nearest, -np.inf)) if number(nearest) > total else float(nearest)


def assemble(problem: Problem, boxes: Boxes, largest: FloatArray) -> Linear:
    """Write what every trajectory in boxes satisfies, with bounds up to the largest."""
    return _Assembly(problem, boxes, largest).done()


class _Assembly:
    """Rows in the making: every block has one row for each of some instants."""

    def __init__(self, problem: Problem, boxes: Boxes, largest: FloatArray) -> None:
        self.problem, self.steps = problem, len(problem)
        self.program = problem.program
        self.live = self.program.live(range(len(self.program.outputs)))
        self.ranges = self._ranges(boxes)
        self.blocks: list[tuple[IntArray, FloatArray, FloatArray, bool]] = []
        self.count = 0
        self.ends: list[FloatArray] = []
        self.columns: dict[int, IntArray] = {}
        self._place()
        least = np.minimum(problem.smallest, largest)
        self.bounds = self._add(np.column_stack([least, largest]))

    def done(self) -> Linear:
        given = self.program.constants
        moving = [k for k in self.live if k not in given and self.program.nodes[k].op != "input"]
        for row in relax(self.program, moving, self.ranges):
            places = [self.columns[k] for k in row.nodes]
            self.rows(places, row.factors, row.right, row.equal)
        self._moves()
        noise = self._noise()
        self._rates()
        return self._matrix(noise)

    def _add(self, ends: FloatArray) -> IntArray:
        """Make variables between ends, (k, 2)."""
        start = sum(map(len, self.ends))
        self.ends.append(ends)
        return np.arange(start, start + len(ends))

    def _ranges(self, boxes: Boxes) -> dict[int, Interval]:
        """Return the interval of every node at every instant."""
        v = boxes.ends.transpose(1, 2, 0)
        u = np.stack([self.problem.u.T, self.problem.u.T], axis=1)
        given = np.concatenate([v, u])
        run = Schedule(self.program, self.live, self.live).run(given[:, 0], given[:, 1])
        found = {}
        for node in self.live:
            low, high = run.of(node)
            nothing = np.isnan(low) | np.isnan(high)
            found[node] = np.where(nothing, -np.inf, low), np.where(nothing, np.inf, high)
        for i, node in enumerate(self.program.outputs):
            low, high = found[node]
            if i < self.problem.n:  # the state of the next instant
                known = np.vstack([boxes.ends[1:, i], [[-np.inf, np.inf]]])
            else:
                y = self.problem.y[:, i - self.problem.n, None]
                known = np.where(np.isfinite(y), y, [-np.inf, np.inf])
            found[node] = np.maximum(low, known[:, 0]), np.minimum(high, known[:, 1])
        return found

    def _place(self) -> None:
        """Give every node its variables; what stands still and what is a number has one."""
        problem, one = self.problem, np.zeros(self.steps, dtype=np.int64)
        self.shared = np.full((self.steps, len(problem.box)), -1)
        for node in self.live:
            low, high = self.ranges[node]
            ends = np.column_stack([low, high])
            which = self.program.nodes[node]
            variable = which.number if which.op == "input" else -1
            if node in self.program.constants:
                self.columns[node] = self._add(ends[:1])[one]
            elif 0 <= variable < len(problem.box) and problem.still[variable]:
                narrow = np.array([[low.max(), high.min()]])
                self.columns[node] = self._add(narrow)[one]
            else:
                self.columns[node] = self._add(ends)
            if 0 <= variable < len(problem.box):
                self.shared[:, variable] = self.columns[node]

    def rows(
        self,
        places: list[IntArray],
        factors: tuple[FloatArray | float, ...],
        right: FloatArray | float,
        equal: bool = False,
    ) -> IntArray:
        """Add rows; return their numbers, -1 for those that say nothing."""
        index = np.stack(places, axis=1)
        count = len(index)
        weights = np.stack([np.broadcast_to(f, count) for f in factors], axis=1)
        right = np.broadcast_to(right, count)
        kept = np.isfinite(right)
        numbers = np.where(kept, self.count + np.cumsum(kept) - 1, -1)
        self.blocks.append((index[kept], weights[kept], right[kept], equal))
        self.count += int(kept.sum())
        return numbers

    def _moves(self) -> None:
        """Say that the next state is the state of the next instant."""
        inputs = {
            self.program.nodes[k].number: k
            for k in self.live
            if self.program.nodes[k].op == "input"
        }
        for i, node in enumerate(self.program.outputs[: self.problem.n]):
            if i in inputs:
                after = self.columns[inputs[i]][1:]
                self.rows([self.columns[node][:-1], after], (1.0, -1.0), 0.0, equal=True)

    def _noise(self) -> IntArray:
        """Hold every disturbance within its bound of its middle; return its rows."""
        problem, start = self.problem, self.problem.places["w"].start
        found = np.full((self.steps, len(problem.group), 2), -1)
        for j, g in enumerate(problem.group.tolist()):
            places = self.shared[:, start + j]
            if g == len(self.bounds) or (places < 0).any():
                continue
            bound = np.full(self.steps, self.bounds[g])
            for side, sign in enumerate((1.0, -1.0)):
                middle = sign * problem.middle[j]
                size = problem.shape[j]
                found[:, j, side] = self.rows([places, bound], (sign, -size), middle)
        return found

    def _rates(self) -> None:
        """Let faults with a rate move no further from one instant to the next."""
        start = self.problem.places["f"].start
        for j, signal in enumerate(self.problem.plant.f):
            places = self.shared[:, start + j]
            rate = 0.0 if signal.constant else signal.rate
            if rate is None or (places < 0).any():
                continue
            for sign in (1.0, -1.0):
                self.rows([places[1:], places[:-1]], (sign, -sign), rate)

    def _matrix(self, noise: IntArray) -> Linear:
        sizes = [index.shape for index, *_ in self.blocks]
        row = np.concatenate([np.repeat(np.arange(m), t) for m, t in sizes])
        shift = np.cumsum([0, *(m for m, _ in sizes)])[:-1]
        row += np.repeat(shift, [m * t for m, t in sizes])
        column = np.concatenate([index.ravel() for index, *_ in self.blocks])
        value = np.concatenate([weights.ravel() for _, weights, *_ in self.blocks])
        ends = np.vstack(self.ends)
        ends = np.where(np.abs(ends) >= FAR, np.copysign(np.inf, ends), ends)
        return Linear(
            A=csr_array((value, (row, column)), shape=(self.count, len(ends))),
            b=np.concatenate([right for _, _, right, _ in self.blocks]),
            equal=np.concatenate([np.full(len(right), same) for _, _, right, same in self.blocks]),
            lower=ends[:, 0],
            upper=ends[:, 1],
            noise=noise,
            bounds=self.bounds,
            shared=self.shared,
        )
