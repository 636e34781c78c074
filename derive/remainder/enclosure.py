"""What `Plant.discretise` asks for: the remainder of a step per state, and the order that will do.

Importing this module hands the function to `Plant`, as rooms import only to their left.
"""

from typing import Any
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np
import sympy as sp

from obsynth.derive.errors import UnboundedError
from obsynth.derive.jacobian.bounds import refuse_jumps
from obsynth.derive.remainder.certify import certified_bounds
from obsynth.derive.rigour import Interval
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.discretise import ENCLOSURES, HIGHEST_ORDER, PREFIX, is_smooth, step_formula
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.signals import KINDS, Role

GAIN = 0.02
"""Share of what else is unknown that another order has to gain."""

_RTOL, _EFFORT = 1e-2, "fast"
_SHARE = 1e-3
# What was found for a plant that is still there: a design asks again.
_FOUND: WeakKeyDictionary[Plant, dict[str, Any]] = WeakKeyDictionary()


def enclose_remainder(
    plant: Plant, method: str, Ts: sp.Expr, order: int | None = None
) -> tuple[int, dict[str, tuple[float, float]]]:
    """Return the order of a step and what it leaves out, state by state, faults moving."""
    key = f"{method} {order} {Ts}"
    known = _FOUND.setdefault(plant, {})
    if key not in known:
        known[key] = _enclosed(plant, method, Ts, order)
    chosen, found = known[key]
    return chosen, dict(found)


def carries_remainder(plant: Plant) -> str:
    """Prove that the disturbances of a plant hold what its step leaves out; say what fails."""
    origin, formula, Ts = plant.continuous, plant.step, plant.exact_Ts
    if origin is None or formula is None or plant.remainder is None:
        return "the plant was not discretised with its remainder"
    order = formula.order if formula.method == "taylor" else None
    _, fresh = enclose_remainder(origin, formula.method, Ts, order)
    kept = {s.name.removeprefix(PREFIX): (s.lower, s.upper) for s in plant.remainder}
    for name, (low, high) in fresh.items():
        there = kept.get(name, (0.0, 0.0))
        if not there[0] <= low <= high <= there[1]:
            return f"what is left out of {name} lies in [{low!r}, {high!r}], not in {there}"
    return ""


def _enclosed(
    plant: Plant, method: str, Ts: sp.Expr, order: int | None
) -> tuple[int, dict[str, tuple[float, float]]]:
    refuse_jumps(plant.check())
    quiet = _bounded_or_refused(plant)
    if order is not None or method != "taylor":
        formula = step_formula(method, order if method == "taylor" else None)
        low, high = certified_bounds(plant, formula, Ts, quiet, _RTOL, _EFFORT)
    else:
        formula, (low, high) = _chosen(plant, Ts, quiet)
    ranges = zip(plant.names("x"), low.tolist(), high.tolist(), strict=True)
    return formula.order, {name: (a, b) for name, a, b in ranges if (a, b) != (0.0, 0.0)}


def _chosen(plant: Plant, Ts: sp.Expr, quiet: dict[str, tuple[float, float]]) -> Any:
    """Return the lowest order after which the remainder no longer matters, and its remainder."""
    highest = HIGHEST_ORDER if is_smooth(plant) else 1
    others = other_unknowns(plant, float(Ts))
    formula = step_formula("taylor", 1)
    found = certified_bounds(plant, formula, Ts, quiet, _RTOL, _EFFORT)
    for order in range(2, highest + 1):
        if not matters(found, others):
            break
        better = step_formula("taylor", order)
        try:
            next_one = certified_bounds(plant, better, Ts, quiet, _RTOL, _EFFORT)
        except UnboundedError:
            break
        if not gains(found, next_one, others):
            break
        formula, found = better, next_one
    return formula, found


def matters(found: Interval, others: FloatArray) -> bool:
    """Whether a remainder adds to what else is unknown of some state."""
    return bool((0.5 * (found[1] - found[0]) > GAIN * others).any())


def gains(found: Interval, better: Interval, others: FloatArray) -> bool:
    """Whether another order takes away from what is unknown of some state, remainder included.

    This is where a design's own widths may decide instead, once they are known.
    """
    one, two = (0.5 * (high - low) for low, high in (found, better))
    return bool((one - two > GAIN * (others + two)).any())


def other_unknowns(plant: Plant, Ts: float) -> FloatArray:
    """Estimate half widths of what disturbances and moving faults add to a state in a step, (n,).

    Other states have the noise of a reading of them, or a small share of their range.
    """
    sx = plant.sx()
    pairs = (sx.rhs, sx.w), (sx.rhs, sx.f), (sx.y, sx.w), (sx.y, sx.x)
    boxes = [plant.box(kind).reshape(-1, 2) for kind in KINDS]
    at = [np.nan_to_num(box, posinf=1.0, neginf=-1.0).mean(axis=1) for box in boxes]
    columns = [getattr(sx, kind) for kind in KINDS]
    values = ca.Function("slopes", columns, [ca.jacobian(of, by) for of, by in pairs])(*at)
    by_w, by_f, read_w, read_x = (np.nan_to_num(np.abs(np.array(v))) for v in values)
    half = {kind: 0.5 * np.ptp(plant.box(kind).reshape(-1, 2), axis=1) for kind in "xw"}
    noise = np.where(np.isfinite(half["w"]), half["w"], 0.0)
    rates = np.array([0.0 if s.rate is None or s.constant else s.rate for s in plant.f])
    moved = Ts * (by_w @ noise + by_f @ rates * Ts)
    reading = (read_w @ noise)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        seen = np.where(read_x * reading > 0.0, reading / read_x, np.inf)
    seen = seen.min(axis=0, initial=np.inf)
    plain = np.where(np.isfinite(seen), seen, _SHARE * half["x"])
    others: FloatArray = np.where(moved > 0.0, moved, plain)
    return others


def _bounded_or_refused(plant: Plant) -> dict[str, tuple[float, float]]:
    """Refuse signals without a range that matter within a step; return those that do not.

    An unknown input D d without a range reaches Ts^2 / 2 J D d further than its own direction. It
    stays within it where D is constant and no derivative depends on the states it moves: what is
    left out does not contain it then.
    """
    sx = plant.sx()
    elements = {str(e): e for kind in KINDS for e in ca.vertsplit(getattr(sx, kind))}
    signals = [s for kind in KINDS if kind != "x" for s in getattr(plant, kind)]
    loose = [s for s in signals if not s.bounded and ca.depends_on(sx.rhs, elements[s.name])]
    free = [s for s in loose if s.role is Role.UNKNOWN_INPUT]
    if free and len(free) == len(loose):
        slopes = ca.jacobian(sx.rhs, ca.vertcat(*(elements[s.name] for s in free)))
        rows = sorted(set(slopes.sparsity().row()))
        further = ca.jacobian(sx.rhs, sx.x[rows])
        if not ca.symvar(slopes) and further.nnz() == 0:
            return {s.name: (0.0, 0.0) for s in free}
    if not loose:
        return {}
    names = ", ".join(s.name for s in loose)
    raise UnboundedError(
        f"no range is declared for {names}, so nothing bounds what that adds within a step (an "
        f"unknown input reaches further than its own direction, by Ts^2/2 J D d): declare range= "
        f"for {names} in {plant.name!r}, or leave the remainder out with remainder=False",
        entries=tuple(s.name for s in loose),
        operation="an unbounded signal",
        sub_box={s.name: (s.lower, s.upper) for s in loose},
    )


ENCLOSURES[:] = [enclose_remainder]
