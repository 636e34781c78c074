"""The parts of a remainder: leading terms, tails over the flow box, values that are attained."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
import sympy as sp

from obsynth.derive.errors import UnboundedError
from obsynth.derive.intervals.program import evaluate
from obsynth.derive.remainder.flow import PIECES, flow_box, flow_tubes, hull_over_pieces, plan_cuts
from obsynth.derive.remainder.system import System, step_derivatives, time_derivatives
from obsynth.derive.remainder.trees import difference_term
from obsynth.derive.rigour import Interval, enclose_number, up
from obsynth.derive.rigour.interval import add, multiply, subtract
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.discretise import Step

_QUARTERS = 4
_PARTS = 16
_ZERO, _ONE = sp.Integer(0), sp.Integer(1)


def step_factor(
    Ts: sp.Expr, order: int, first: sp.Expr = _ZERO, last: sp.Expr = _ONE
) -> tuple[float, float]:
    """Enclose the integral of (Ts - s)^(order - 1) / (order - 1)! over a part of the step."""
    weight = (1 - first) ** order - (1 - last) ** order
    return enclose_number(Ts**order * weight / sp.factorial(order))


def _interval(pair: tuple[float, float]) -> Interval:
    return np.array([pair[0]]), np.array([pair[1]])


@dataclass(frozen=True, eq=False)
class Work:
    """One plant, method and step, with flow boxes until the end of every quarter of the step.

    The effort says how many pieces hulls are made of.
    """

    dynamics: System
    formula: Step
    Ts: sp.Expr
    flows: list[tuple[FloatArray, FloatArray]]
    effort: str

    @classmethod
    def prepare(cls, dynamics: System, formula: Step, Ts: sp.Expr, effort: str) -> "Work":
        """Enclose the flow of a plant over a step and its parts."""
        shares = [sp.Rational(k, _QUARTERS) for k in range(1, _QUARTERS + 1)]
        flows = [flow_box(dynamics, enclose_number(share * Ts)[1]) for share in shares]
        return cls(dynamics, formula, Ts, flows, effort)

    @property
    def step(self) -> float:
        """Upper bound of the sampling time."""
        return enclose_number(self.Ts)[1]

    @property
    def whole_box(self) -> FloatArray:
        """The plant's box, and the time within the step."""
        return self.dynamics.box(self.dynamics.lower, self.dynamics.upper, self.step)

    @property
    def flow(self) -> FloatArray:
        """The flow box over the whole step."""
        return self.dynamics.box(*self.flows[-1], self.step)

    def factor(self, order: int) -> Interval:
        """Ts^order / order!."""
        return _interval(step_factor(self.Ts, order))

    def along(self, order: int) -> ca.SX:
        """Return the derivative of solutions of an order."""
        return time_derivatives(self.dynamics, order)[-1]

    def of_step(self, order: int) -> ca.SX:
        """Return the derivative of the step by its length, of an order."""
        return step_derivatives(self.dynamics, self.formula, order)[-1]

    def continuous(self, order: int) -> bool:
        """Tell whether the derivatives of an order, of solution and step, have no jump."""
        return not (
            self.dynamics.may_jump(self.along(order), self.flow)
            or self.dynamics.may_jump(self.of_step(order), self.whole_box)
        )

    def leading(self, order: int) -> ca.SX:
        """Return the terms of order q and q + 1 of the remainder, as functions of the start."""
        total = ca.SX(len(self.dynamics.names), 1)
        for k in (order, order + 1):
            term = difference_term(self.dynamics.x, self.dynamics.rhs, self.formula.method, k)
            total = total + float(self.Ts**k / sp.factorial(k)) * term
        return ca.cse(total)

    def tail(self, order: int) -> Interval:
        """Enclose the remainder of Taylor's formula of an order, one interval per state.

        The integral of (Ts - s)^(q-1) / (q-1)! (D_q(x(s)) - S_q(x(0), s)): the start of the step
        counts most, so that every quarter is taken with its own flow box.
        """
        pieces = PIECES[self.effort]
        along = self.dynamics.program(self.along(order))
        along_cuts = plan_cuts(along, self.flow, pieces)
        gone = self.formula.is_polynomial and order > self.formula.order
        steps = None if gone else self.dynamics.program(self.of_step(order))
        step_cuts = [] if steps is None else plan_cuts(steps, self.whole_box, pieces)
        n = len(self.dynamics.names)
        found = np.zeros(n), np.zeros(n)
        for quarter, flow in enumerate(self.flows):
            first, last = (sp.Rational(k, _QUARTERS) for k in (quarter, quarter + 1))
            box = self.dynamics.box(*flow, 0.0)
            part = hull_over_pieces(along, box, pieces, along_cuts)
            if steps is not None:
                box = self.whole_box
                box[-1] = enclose_number(first * self.Ts)[0], enclose_number(last * self.Ts)[1]
                part = subtract(part, hull_over_pieces(steps, box, pieces, step_cuts))
            weight = _interval(step_factor(self.Ts, order, first, last))
            found = add(found, multiply(part, weight))
        for name, low, high in zip(self.dynamics.names, *found, strict=True):
            if not (np.isfinite(low) and np.isfinite(high)):
                raise UnboundedError(
                    f"derivative {order} of {name} along solutions has no finite bound over a step "
                    f"of {float(self.Ts):g} s; take a shorter step, narrower ranges or more effort",
                    entries=(name,),
                    operation=f"derivative {order}",
                    sub_box={},
                )
        return found

    def moved(self, order: int) -> FloatArray:
        """Bound what moving signals add to the remainder of Taylor's formula of an order, (n,).

        Along x' = f(x, v), v' = rho the derivative of g_k, the k-th one at held v, is g_(k+1) plus
        the slope of g_k by v times rho: parts in k < order add the integral of
        (Ts - s)^k / k! (dg_k/dv rho)(s), for any rho(s) within the rates.
        """
        n, total = len(self.dynamics.names), np.zeros(len(self.dynamics.names))
        moving = np.flatnonzero(self.dynamics.rates)
        if not len(moving):
            return total
        pieces = PIECES[self.effort]
        for k in range(1, order):
            slopes = ca.jacobian(self.along(k), self.dynamics.v[moving.tolist()])
            program = self.dynamics.program(ca.vec(ca.densify(slopes)))
            low, high = hull_over_pieces(program, self.flow, pieces)
            size = np.maximum(np.abs(low), np.abs(high)).reshape(len(moving), n)
            for column, rate in zip(size, self.dynamics.rates[moving], strict=True):
                term = up(up(column * rate) * step_factor(self.Ts, k + 1)[1])
                # what does not enter adds nothing, not even a rounding
                total = np.where(column == 0.0, total, up(total + term))
        return total

    def attained(self, points: FloatArray, order: int) -> Interval:
        """Enclose the remainder at points, by the leading terms and a tail over their solutions."""
        dynamics, level = self.dynamics, order + 2
        n, count = len(dynamics.names), points.shape[1]
        lower, upper = points[:n], points[:n]
        held, zero = points[n:], np.zeros((1, count))
        starts, ends, weights = [], [], []
        tubes: list[tuple[FloatArray, FloatArray]] = []
        for part in range(_PARTS):
            first, last = sp.Rational(part, _PARTS), sp.Rational(part + 1, _PARTS)
            early, late = enclose_number(first * self.Ts)[0], enclose_number(last * self.Ts)[1]
            length = float(up(late - early))
            lower, upper = flow_tubes(dynamics, lower, upper, held, length)
            tubes.append((np.vstack([lower, held, zero]), np.vstack([upper, held, zero])))
            starts.append(np.vstack([points, zero + early]))
            ends.append(np.vstack([points, zero + late]))
            weights += [step_factor(self.Ts, level, first, last)] * count
        tube = np.hstack([t[0] for t in tubes]), np.hstack([t[1] for t in tubes])
        line = np.hstack(starts), np.hstack(ends)
        rate = evaluate(dynamics.program(self.along(level)), *tube)
        move = evaluate(dynamics.program(self.of_step(level)), *line)
        scale = np.array([w[0] for w in weights]), np.array([w[1] for w in weights])
        with np.errstate(invalid="ignore"):
            parts = multiply(subtract(rate, move), scale)
        at = np.vstack([points, zero])
        total = evaluate(dynamics.program(self.leading(order)), at, at)
        for part in range(_PARTS):
            index = slice(part * count, (part + 1) * count)
            total = add(total, (parts[0][:, index], parts[1][:, index]))
        kinked = dynamics.rough(self.along(level - 1), tube)
        kinked |= dynamics.rough(self.of_step(level - 1), line)
        unknown = (
            kinked.reshape(_PARTS, count).any(axis=0) | np.isnan(total[0]) | np.isnan(total[1])
        )
        return np.where(unknown, -np.inf, total[0]), np.where(unknown, np.inf, total[1])
