"""A box that no solution leaves within one step, and hulls over many pieces of a box.

Hulls are for expressions that only have to be bounded in their order of magnitude: one sweep over a
batch of pieces costs far less than gradients of a long program.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from obsynth.derive.errors import DerivationError
from obsynth.derive.intervals.program import Program, evaluate
from obsynth.derive.intervals.ranges import EFFORTS, make_problem
from obsynth.derive.intervals.search.batch import Problem
from obsynth.derive.intervals.search.branch import maximise
from obsynth.derive.remainder.system import System
from obsynth.derive.rigour import down, up
from obsynth.symbolic.arrays import BoolArray, FloatArray

PIECES = {"fast": 256, "normal": 4096, "tight": 65536}


def hull_over_pieces(
    program: Program, box: FloatArray, pieces: int, cuts: Sequence[int] | None = None
) -> tuple[FloatArray, FloatArray]:
    """Enclose all outputs of a program over a box."""
    lower, upper = box[:, :1].copy(), box[:, 1:].copy()
    for axis in plan_cuts(program, box, pieces) if cuts is None else cuts:
        lower, upper = _halve(lower, upper, axis)
    low, high = evaluate(program, lower, upper)
    return low.min(axis=1), high.max(axis=1)


def plan_cuts(program: Program, box: FloatArray, pieces: int) -> list[int]:
    """Choose which variables to halve by a trial each; a cut gives half of what the last gave."""
    used = sorted({j for k in range(len(program.outputs)) for j in program.support(k)})
    axes = [j for j in used if box[j, 1] > box[j, 0]]
    if not axes or pieces < 2:
        return []
    lower, upper = box[:, :1], box[:, 1:]
    # the whole box and all trials in one batch
    trials = [(lower, upper), *(_halve(lower, upper, j) for j in axes)]
    low, high = evaluate(
        program, np.hstack([t[0] for t in trials]), np.hstack([t[1] for t in trials])
    )
    whole = high[:, 0] - low[:, 0]
    gains = {}
    for row, j in enumerate(axes):
        pair = slice(1 + 2 * row, 3 + 2 * row)
        halved = high[:, pair].max(axis=1) - low[:, pair].min(axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.where(whole > 0.0, 1.0 - halved / whole, 0.0)
        # an infinite hull that becomes finite is the best that can happen
        share = np.where(np.isfinite(halved) & ~np.isfinite(whole), 1.0, share)
        gains[j] = float(np.where(np.isfinite(share), share, 0.0).sum())
    cuts: list[int] = []
    while 2 << len(cuts) <= pieces:
        axis = max(axes, key=lambda j: gains[j])
        gains[axis] *= 0.5
        cuts.append(axis)
    return cuts


def _halve(lower: FloatArray, upper: FloatArray, axis: int) -> tuple[FloatArray, FloatArray]:
    middle = np.clip(0.5 * (lower[axis] + upper[axis]), lower[axis], upper[axis])
    left, right = upper.copy(), lower.copy()
    left[axis], right[axis] = middle, middle
    return np.hstack([lower, right]), np.hstack([left, upper])


_ATTEMPTS = 40
_RTOL = 1e-2


class FlowError(DerivationError):
    """No box could be found that the solutions do not leave within a step."""


def flow_box(dynamics: System, step: float) -> tuple[FloatArray, FloatArray]:
    """Enclose all solutions over one step that start in the box.

    A candidate Y holds them when, for every state and both sides, Y reaches further out than the
    rate on the slab between the box and Y can carry within a step: a solution that left Y first
    there would have spent the time since it left the box inside that slab.
    """
    n = len(dynamics.names)
    low, high = dynamics.lower[:n], dynamics.upper[:n]
    rows = [_problem(dynamics, i) for i in range(n)]
    margin = 1e-9 * np.maximum(high - low, np.maximum(np.abs(low), np.abs(high))) + 1e-300
    bottom, top = low - margin, high + margin
    for attempt in range(_ATTEMPTS):
        fall = np.array([_rate(rows[i], dynamics, bottom, top, i, -1) for i in range(n)])
        rise = np.array([_rate(rows[i], dynamics, bottom, top, i, +1) for i in range(n)])
        wrong = ~(np.isfinite(fall) & np.isfinite(rise))
        if wrong.any():
            raise _failure(dynamics, int(np.argmax(wrong)), bottom, top, step)
        below = down(low - up(step * fall))
        above = up(high + up(step * rise))
        holds = (below > bottom) & (above < top)
        if holds.all():
            # what the slabs of a box that holds allow is an enclosure itself
            return below, above
        growth = 1.05 + 0.1 * attempt
        bottom = np.where(below > bottom, bottom, low - growth * step * fall - margin)
        top = np.where(above < top, top, high + growth * step * rise + margin)
    raise _failure(dynamics, int(np.argmin(holds)), bottom, top, step)


def _problem(dynamics: System, row: int) -> Problem:
    columns = ca.vertcat(dynamics.x, dynamics.v)
    box = np.column_stack([dynamics.lower, dynamics.upper])
    return make_problem(dynamics.rhs[row], columns, box, dynamics.constants, dynamics.constant_box)


def _rate(
    problem: Problem, dynamics: System, bottom: FloatArray, top: FloatArray, row: int, side: int
) -> float:
    """Bound the outward rate of a state on the slab next to the box; never negative."""
    n = len(dynamics.names)
    lower, upper = dynamics.lower.copy(), dynamics.upper.copy()
    lower[:n], upper[:n] = bottom, top
    if side > 0:
        lower[row] = dynamics.upper[row]
    else:
        upper[row] = dynamics.lower[row]
    outcome = maximise(replace(problem, lower=lower, upper=upper), _RTOL, EFFORTS["fast"])
    return max(0.0, float(outcome.bound[1 if side > 0 else 0]))


def _failure(
    dynamics: System, row: int, bottom: FloatArray, top: FloatArray, step: float
) -> FlowError:
    name = dynamics.names[row]
    return FlowError(
        f"no box holds the solutions over {step:g} s: next to the range of {name} "
        f"(tried [{bottom[row]:.6g}, {top[row]:.6g}]) the rates are undefined, unbounded or too "
        f"fast. Take a shorter Ts, or keep the range of {name} away from there",
        symbol=name,
        step=step,
        tried=(float(bottom[row]), float(top[row])),
    )


def flow_tubes(
    dynamics: System, first: FloatArray, last: FloatArray, held: FloatArray, step: float
) -> tuple[FloatArray, FloatArray]:
    """Enclose the solutions over one step from every small box of a batch."""
    program = dynamics.program(dynamics.rhs)
    others = np.vstack([held, np.zeros((1, first.shape[1]))])
    margin = 1e-12 * np.maximum(np.abs(first), np.abs(last)) + 1e-300
    lower, upper = first - margin, last + margin
    found: BoolArray = np.zeros(first.shape[1], dtype=np.bool_)
    for attempt in range(_ATTEMPTS):
        with np.errstate(invalid="ignore", over="ignore"):
            low, high = evaluate(program, np.vstack([lower, others]), np.vstack([upper, others]))
            fall = np.minimum(0.0, down(step * low))
            rise = np.maximum(0.0, up(step * high))
            below, above = down(first + fall), up(last + rise)
            inside = (below >= lower) & (above <= upper)
            found = np.asarray(inside.all(axis=0), dtype=np.bool_)
            if found.all():
                return below, above
            growth = 1.05 + 0.05 * attempt
            wider = np.minimum(lower, first + growth * fall - margin)
            lower = np.where(found, lower, wider)
            upper = np.where(found, upper, np.maximum(upper, last + growth * rise + margin))
    return np.where(found, lower, -np.inf), np.where(found, upper, np.inf)
