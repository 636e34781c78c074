"""The run-time functions of the observer: the differential equation (7) and its fixed step."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from obsynth.designs.core.boxes import LIMITS, Ends, Rounding, select
from obsynth.designs.core.core import Core, Known, Parts, Seen
from obsynth.designs.core.given import Start, read_vector
from obsynth.designs.core.half_widths import above
from obsynth.designs.core.stepping import all_finite, largest_level, make_ode, slices
from obsynth.designs.qpv.equations import Equations, build_update, symbols_of
from obsynth.designs.qpv.record import QPVDesign
from obsynth.designs.qpv.rounding import of_outputs
from obsynth.symbolic.arrays import FloatArray

REAL = {"double": np.float64, "single": np.float32}
SETTLED = 20.0
"""Time constants of the bound of V for which a copy is kept by default."""
# Above the rounding of numbers that are formed in doubles.
_UP = 1.0 + 2.0**-40
# What the root of V is at estimates that were placed anew.
_PLACED = 0.999


def memory_sizes(design: QPVDesign) -> dict[str, int]:
    """Return the parts: xhat, fhat, and level, a bound of V = e'P e, infinite if none is known."""
    plant = design.plant
    return {"xhat": len(plant.x), "fhat": len(plant.f), "level": 1}


def first_memory(
    design: QPVDesign, start: Start, fhat0: ArrayLike | None = None
) -> dict[str, ArrayLike]:
    """Start at the guess; fhat0 is the middle of f_range, or given; y0 is not needed."""
    plant = design.plant
    fhat = start.f.mean(axis=1) if fhat0 is None else read_vector(fhat0, "fhat0", plant.names("f"))
    # the numbers of the memory, which the bound speaks of
    state = np.concatenate([start.guess, fhat]).astype(REAL[design.precision]).astype(float)
    x_box = plant.box("x") if start.x_range is None else start.x_range
    box = np.concatenate([x_box, start.f]) - state[:, None]
    offset = state - design.region.c
    level = float((np.sqrt(offset @ design.P @ offset) + design.reset) ** 2 * _UP)
    if np.isfinite(box).all():
        level = min(level, largest_level(design.P, box[:, 0], box[:, 1]))
    n, level = len(plant.x), level * above(design.precision, 0)
    return {"xhat": state[:n], "fhat": state[n:], "level": level if level <= 1.0 else np.inf}


def build_ode(design: QPVDesign) -> ca.Function:
    """Return `Observer.ode`: (memory, u, y[, theta]) -> dmemory."""
    plant = design.plant
    layout = slices(memory_sizes(design))
    memory = ca.SX.sym("memory", layout["level"].stop)
    found = symbols_of(plant)
    u, y, theta = found["u"], found["y"], found["theta"]
    equations = Equations(design)
    state = memory[: layout["fhat"].stop]
    level = memory[layout["level"]]
    rate, limit = equations.level_rate()
    grown = ca.if_else(level <= 1.0, rate * (limit - level), 0.0)
    nu, gain = equations.innovation(state, u, y, theta), equations.gain(u, theta)
    d_state = equations.rate(state, u, theta, gain, nu)
    outputs = ca.vertcat(d_state, grown)
    return make_ode({"memory": memory, **found}, outputs)


def _shown(design: QPVDesign) -> tuple[FloatArray, FloatArray]:
    """Bound what errors in E and disturbances move the outputs, (m,) each, from the proved P."""
    data, box = design.data, design.plant.box("w")
    outputs = np.einsum("vmi,ij,vmj->vm", data.C, np.linalg.inv(design.P), data.C).max(axis=0)
    radius = np.maximum(box[:, 1] - design.w_centre, design.w_centre - box[:, 0])
    H = np.abs(data.H[:, :, : len(radius)]).max(axis=0)
    with np.errstate(invalid="ignore"):
        noise = np.where(H > 0, H * radius, 0.0).sum(axis=1)
    return np.sqrt(outputs) * _UP, noise * _UP


def _region(design: QPVDesign) -> tuple[FloatArray, float]:
    """Return the inverse of the region's Q, and how far errors in E reach in its norm."""
    Q, root = design.region.Q, np.linalg.cholesky(np.linalg.inv(design.P))
    largest = np.linalg.eigvalsh(root.T @ np.linalg.solve(Q, root))[-1]
    return np.asarray(np.linalg.inv(Q), dtype=np.float64), float(np.sqrt(largest)) * _UP


def build_core(design: QPVDesign) -> Core:
    """Build the Runge-Kutta step, readings held, and the bound of V, begun anew after gaps."""
    n, m = len(design.plant.x), len(design.plant.output)
    equations, follow = Equations(design), build_update(design)
    precision, lost = design.precision, of_outputs(design)
    sides, (seen_of_E, noise) = np.sqrt(design.inverse_diagonal) * _UP, _shown(design)
    inverse_Q, largest = _region(design)
    ulp, up = Rounding(precision).step, above(precision, 2 * n)
    added = design.rounding * up

    def run(seen: Seen) -> Known:
        state = ca.vertcat(seen.memory["xhat"], seen.memory["fhat"])
        expected = equations.model(state, seen.u, seen.theta)[1]
        y = seen.readings(expected)
        offset = state - ca.DM(design.region.c)
        level = seen.memory["level"]
        if design.reset < 1.0:
            level = ca.fmin(level, _region_level(design, offset) ** 2 * up)
        certified = ca.logic_and(level <= 1.0, equations.scheduled(seen.theta))
        reach = ca.sqrt(level) * up + added if design.bounded else ca.SX(1)
        consistent = ca.SX(1)
        for i in range(m):
            if np.isfinite(noise[i]):
                allowed = up * (reach * seen_of_E[i] + noise[i]) + lost[i]
                allowed = allowed + ulp * ca.fabs(y[i])
                fits = ca.fabs(y[i] - expected[i]) <= allowed
                consistent = ca.logic_and(consistent, fits)
        away = _root(inverse_Q, offset, design.region.c, precision)
        if design.bounded:
            away = away + reach * largest
        x = f = None
        if design.bounded:
            half = ca.DM(sides * up) * reach
            half = half + 8.0 * ulp * (ca.fabs(state) + half)
            found = Ends(state - half, state + half).where(
                certified, Ends.unbounded(state.numel(), precision)
            )
            x = Ends(found.lower[:n], found.upper[:n])
            f = Ends(found.lower[n:], found.upper[n:])
        after = follow(state, seen.u, y, seen.theta)[0]
        going = all_finite(after, LIMITS[precision].finite)
        after = select(going, after, state)
        moved = {"xhat": after[:n], "fhat": after[n:], "level": equations.next_level(level)}
        return Known(
            state[:n],
            state[n:],
            x,
            f,
            moved,
            sound=ca.logic_and(ca.logic_and(certified, seen.all_used), going),
            empty=ca.logic_and(certified, ca.logic_not(consistent)),
            outside=ca.logic_not(ca.logic_and(certified, away <= 1.0)),
            valid=certified,
        )

    def begin(x: Ends, f: Ends, kept: Parts) -> Parts:
        state = ca.vertcat(kept["xhat"], kept["fhat"])
        box = Ends(ca.vertcat(x.lower, f.lower), ca.vertcat(x.upper, f.upper))
        return {"level": _box_level(design, box, state)}

    def place(x: Ends, f: Ends, kept: Parts) -> Parts:
        """Move the estimates towards the middle, as little as their bound needs to be below 1."""
        box = Ends(ca.vertcat(x.lower, f.lower), ca.vertcat(x.upper, f.upper))
        middle, state = box.middle(precision), ca.vertcat(kept["xhat"], kept["fhat"])
        state = select(all_finite(state, LIMITS[precision].finite), state, middle)
        least, away = ca.sqrt(_box_level(design, box, middle)), _length(design.P, state - middle)
        share = ca.fmin((_PLACED - least) / ca.fmax(away, _PLACED - least), 1.0)
        share = ca.if_else(least < _PLACED, share, 1.0)
        state = middle + share * (state - middle)
        placed = {"xhat": state[:n], "fhat": state[n:]}
        return placed if design.bounded else {**placed, **begin(x, f, placed)}

    c, half = design.region.c[:n], design.region.half_widths[:n]
    domain = np.column_stack([c - half * _UP, c + half * _UP])
    return Core(run, begin, place, domain=domain, bridges=True, nonnegative=("level",))


def found_again(design: QPVDesign) -> bool:
    """Whether the bound of V begins below 1 from the declared ranges, around their middle."""
    boxes = [design.plant.box(kind).reshape(-1, 2) for kind in ("x", "f")]
    reach = 0.5 * np.diff(np.vstack(boxes), axis=1)[:, 0]
    return design.reset < 1.0 or bool(reach @ np.abs(design.P) @ reach <= 1.0)


def shared(design: QPVDesign) -> tuple[str, ...]:
    """Return what both copies have in common: the level too where no set follows from it."""
    return ("xhat", "fhat") if design.bounded else ("xhat", "fhat", "level")


def _form(matrix: FloatArray, vector: ca.SX) -> ca.SX:
    """Return v'M v for a symmetric M."""
    total = ca.SX(0)
    for i in range(len(matrix)):
        row = matrix[i, i] * vector[i]
        for j in range(i + 1, len(matrix)):
            row += 2.0 * matrix[i, j] * vector[j]
        total += row * vector[i]
    return total


def _length(matrix: FloatArray, vector: ca.SX) -> ca.SX:
    """Bound the root of v'M v, and of |v|'|M||v|, by sum M_ii^1/2 |v_i|, up to rounding."""
    return ca.dot(ca.DM(np.sqrt(np.diag(matrix)) * _UP), ca.fabs(vector))


def _root(matrix: FloatArray, offset: ca.SX, centre: FloatArray, precision: str) -> ca.SX:
    """Bound the root of v'M v for what was rounded to ``offset = state - centre``."""
    up, size = above(precision, len(matrix) ** 2), ca.SX(ca.DM(np.abs(centre)))
    slack = float(ca.evalf(_length(matrix, size))) * Rounding(precision).step
    squared = (up - 1.0) * _length(matrix, offset) ** 2
    return ca.sqrt(ca.fmax(_form(matrix, offset), 0.0) + squared) * up + slack * up


def _box_level(design: QPVDesign, box: Ends, state: ca.SX) -> ca.SX:
    """Bound V for a truth in a box by sum |P_ij| r_i r_j."""
    reach = ca.fmax(box.upper - state, state - box.lower)
    return _form(np.abs(design.P), reach) * above(design.precision, len(design.P) ** 2)


def _region_level(design: QPVDesign, offset: ca.SX) -> ca.SX:
    """Bound the root of V for a truth in the region, by the triangle inequality."""
    return _root(design.P, offset, design.region.c, design.precision) + design.reset
