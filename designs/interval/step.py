"""The run-time function of the interval observer, with its outward rounding."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive.rigour import Exact, exact, image, nearest
from obsynth.designs.core.given import Start
from obsynth.designs.core.stepping import (
    all_finite,
    finite_or,
    inside,
    make_step,
    select,
    slices,
    status_word,
)
from obsynth.designs.interval.record import SWEEPS, IntervalDesign
from obsynth.designs.interval.rows import Rows
from obsynth.symbolic.arrays import FloatArray


def memory_sizes(design: IntervalDesign) -> dict[str, int]:
    """Return the parts of the memory vector.

    ``r_lower`` and ``r_upper`` (bounds of r = P z2 at the instant of the next call),
    ``share_lower`` and ``share_upper`` (of the fault, without what the next measurement tells),
    ``prediction`` (of the state, shown when a measurement is missing), ``known`` (whether the
    share is) and ``initialised`` (0 or 1).
    """
    n, n2, n_f = design.model.n, len(design.P), design.n_f
    return {
        "r_lower": n2,
        "r_upper": n2,
        "share_lower": n_f,
        "share_upper": n_f,
        "prediction": n,
        "known": 1,
        "initialised": 1,
    }


def first_memory(design: IntervalDesign, start: Start) -> dict[str, ArrayLike]:
    """Start from a box of states; neither the first fault nor y0 are needed."""
    lower, upper = first_box(design, start.x)
    return {"r_lower": lower, "r_upper": upper, "prediction": start.guess}


@dataclass(frozen=True, eq=False)
class _Evaluated:
    """Rows in doubles: for every row the different candidates, and the slack."""

    sizes: Mapping[str, int]
    upper: tuple[FloatArray, ...]
    lower: tuple[FloatArray, ...]
    slack: FloatArray

    @classmethod
    def of(cls, rows: Rows, design: IntervalDesign) -> _Evaluated:
        def different(stacked: list[FloatArray]) -> tuple[FloatArray, ...]:
            table = np.stack(stacked)
            return tuple(np.unique(table[:, i], axis=0) for i in range(rows.count))

        return cls(
            rows.sizes,
            different([nearest(u) for u in rows.upper]),
            different([nearest(v) for v in rows.lower]),
            rows.slack(design.precision),
        )

    def bounds(self, known: Mapping[str, ca.SX]) -> tuple[ca.SX, ca.SX]:
        """Return (lower, upper), widened so that rounding cannot spoil them."""
        entries = [known[name][i] for name, size in self.sizes.items() for i in range(size)]
        lower, upper = [], []
        for low, high, slack in zip(self.lower, self.upper, self.slack, strict=True):
            widening = _sum(slack, [ca.fabs(entry) for entry in entries])
            least, largest = _sum(low[0], entries), _sum(high[0], entries)
            for row in low[1:]:
                least = ca.fmin(least, _sum(row, entries))
            for row in high[1:]:
                largest = ca.fmax(largest, _sum(row, entries))
            lower.append(least - widening)
            upper.append(largest + widening)
        return _column(lower), _column(upper)


def _sum(coefficients: FloatArray, entries: list[ca.SX]) -> ca.SX:
    total = ca.SX(0)
    for coefficient, entry in zip(coefficients, entries, strict=True):
        if coefficient != 0.0:
            total = total + float(coefficient) * entry
    return total


def _column(parts: list[ca.SX]) -> ca.SX:
    return ca.vertcat(*parts) if parts else ca.SX(0, 1)


def _signs(name: str, value: ca.SX) -> dict[str, ca.SX]:
    """Return a vector with its positive and negative parts, which cost no rounding."""
    return {name: value, f"{name}+": ca.fmax(value, 0), f"{name}-": ca.fmax(-value, 0)}


def _known(r_lower: ca.SX, r_upper: ca.SX, y: ca.SX, u: ca.SX) -> dict[str, ca.SX]:
    vectors = {"r_upper": r_upper, "r_lower": r_lower, "y": y}
    named = {k: v for name, value in vectors.items() for k, v in _signs(name, value).items()}
    return {**named, "u": u, "one": ca.SX(1)}


def first_box(design: IntervalDesign, x_range: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return bounds of r for a box of states, rounded outwards in the precision of the step."""
    low, high = exact(np.asarray(x_range, dtype=float)).T
    lower, upper = image(exact(design.P) @ design.decoupled.T2, low, high)
    kind = np.float64 if design.precision == "double" else np.float32
    return -_up(-lower, kind), _up(upper, kind)


def _up(values: Exact, kind: type[np.floating[Any]]) -> FloatArray:
    """Return the smallest numbers of a precision that are not below the values."""
    rounded = nearest(values).astype(kind)
    higher = np.nextafter(rounded, kind(np.inf)).astype(float)
    rounded = rounded.astype(float)
    return np.where(exact(rounded) < values, higher, rounded)


def _contract(
    design: IntervalDesign, r_lower: ca.SX, r_upper: ca.SX, y: ca.SX, u: ca.SX
) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Cut the box of r with the measurement; also tell whether nothing is left."""
    lower, upper = r_lower[:], r_upper[:]
    evaluated = [(j, _Evaluated.of(rows, design)) for j, rows in design.contraction_rows]
    for j, rows in evaluated * SWEEPS:
        low, high = rows.bounds(_known(lower, upper, y, u))
        lower[j] = ca.fmax(lower[j], low)
        upper[j] = ca.fmin(upper[j], high)
    empty = ca.SX(0)
    for i in range(lower.numel()):
        empty = ca.logic_or(empty, lower[i] > upper[i])
    return lower, upper, empty


def build_step(design: IntervalDesign) -> ca.Function:
    """Build `Observer.step`: contraction, sets of x_k and f_{k-1}, prediction."""
    plant, C = design.plant, nearest(design.model.C)
    n2, n_f, m = len(design.P), design.n_f, len(C)
    layout = slices(memory_sizes(design))
    memory = ca.SX.sym("memory", layout["initialised"].stop)
    u, y = ca.SX.sym("u", len(plant.u)), ca.SX.sym("y", m)
    part = {name: memory[place] for name, place in layout.items()}
    initialised, known = part["initialised"] > 0.5, part["known"] > 0.5
    y_finite, u_finite = all_finite(y), all_finite(u)
    y_used = finite_or(y, ca.DM(C) @ part["prediction"])
    u_used = finite_or(
        u, [0.0 if s.nominal is None else float(s.nominal) for s in plant.u] or ca.DM(0, 1)
    )

    lower, upper, empty = _contract(design, part["r_lower"], part["r_upper"], y_used, u_used)
    keep = ca.logic_or(empty, ca.logic_not(y_finite))
    r_lower = select(keep, part["r_lower"], lower) if n2 else lower
    r_upper = select(keep, part["r_upper"], upper) if n2 else upper
    at_k = _known(r_lower, r_upper, y_used, u_used)
    x_lower, x_upper = _Evaluated.of(design.state_rows, design).bounds(at_k)
    shares = {"share_lower": part["share_lower"], "share_upper": part["share_upper"]}
    f_lower, f_upper = _Evaluated.of(design.estimate_rows, design).bounds({**at_k, **shares})

    seen = ca.logic_and(initialised, y_finite)
    valid = ca.logic_and(seen, known)
    xhat = select(seen, 0.5 * (x_lower + x_upper), part["prediction"])
    f_box = plant.box("f")
    quiet = [0.5 * (a + b) if np.isfinite([a, b]).all() else 0.0 for a, b in f_box]
    fhat = select(valid, 0.5 * (f_lower + f_upper), ca.SX(ca.DM(quiet))) if n_f else ca.SX(0, 1)
    x_lower, x_upper = _or_infinite(seen, x_lower, x_upper)
    f_lower, f_upper = _or_infinite(valid, f_lower, f_upper)

    status = {
        "not_initialised": ca.logic_not(initialised),
        "non_finite_input": ca.logic_not(ca.logic_and(y_finite, u_finite)),
        "outside_domain": ca.logic_not(_in_domain(design, x_lower, x_upper, u_used)),
        "inconsistent_measurement": ca.logic_and(empty, seen),
        "fault_not_valid": ca.logic_not(valid) if n_f else ca.SX(0),
    }

    next_lower, next_upper = _Evaluated.of(design.prediction_rows, design).bounds(at_k)
    share_lower, share_upper = _Evaluated.of(design.share_rows, design).bounds(at_k)
    going = ca.logic_and(y_finite, u_finite)
    box = plant.box("x")
    restarts = bool(np.isfinite(box).all())
    if restarts and n2:
        low, high = first_box(design, box)
        next_lower = select(going, next_lower, ca.SX(ca.DM(low)))
        next_upper = select(going, next_upper, ca.SX(ca.DM(high)))
    alive = ca.SX(1) if restarts else going
    moved = ca.vertcat(
        next_lower,
        next_upper,
        share_lower,
        share_upper,
        _predict(design, xhat, u_used, fhat),
        going,
        alive,
    )
    return make_step(
        {"memory": memory, "u": u, "y": y},
        {
            "memory": select(initialised, moved, memory),
            "xhat": xhat,
            "fhat": fhat,
            "x_lower": x_lower,
            "x_upper": x_upper,
            "f_lower": f_lower,
            "f_upper": f_upper,
            "status": status_word(status),
        },
    )


def _or_infinite(condition: ca.SX, lower: ca.SX, upper: ca.SX) -> tuple[ca.SX, ca.SX]:
    rows = range(lower.numel())
    return (
        _column([ca.if_else(condition, lower[i], -ca.inf) for i in rows]),
        _column([ca.if_else(condition, upper[i], ca.inf) for i in rows]),
    )


def _in_domain(design: IntervalDesign, x_lower: ca.SX, x_upper: ca.SX, u: ca.SX) -> ca.SX:
    """Whether the states and inputs on which the matrices depend are inside their ranges."""
    plant, result = design.plant, ca.SX(1)
    for kind, lower, upper in (("x", x_lower, x_upper), ("u", u, u)):
        for i, name in enumerate(plant.names(kind)):
            if name in design.model.scheduled:
                box = plant.box(kind)[i : i + 1]
                result = ca.logic_and(result, inside(lower[i], upper[i], box))
    return result


def _predict(design: IntervalDesign, xhat: ca.SX, u: ca.SX, fhat: ca.SX) -> ca.SX:
    """Next state at the middle of all ranges; an estimate only, no bound rests on it."""
    middle, n = design.model.family.midpoint, design.model.n
    n_u = len(design.plant.u)
    value = ca.DM(middle[:, :n]) @ xhat + ca.DM(middle[:, n + n_u])
    if n_u:
        value = value + ca.DM(middle[:, n : n + n_u]) @ u
    if design.n_f:
        value = value + ca.DM(nearest(design.model.F[:, : design.n_f])) @ fhat
    return value
