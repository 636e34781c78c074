"""How wide the intervals can get: a monotone recursion, its steady value and the proof.

Let e bound r_upper - r and r - r_lower, and w the width of the interval of r. One step maps both
by f with f(c e) <= c f(e) for c >= 1, so f(e*) <= (1 - delta) e*, which is checked exactly, bounds
the error in the limit whatever it was at the start.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.derive.rigour import (
    Exact,
    above,
    exact,
    inverse,
    magnitude,
    nearest,
    negative,
    positive,
)
from obsynth.designs.interval.rows import Part, Rows
from obsynth.symbolic.arrays import FloatArray

DELTA = exact([2.0**-40])[0]
INFLATION = 1.0 + 1e-6
LARGEST = 1e12
# above the relative rounding errors of one step in doubles
UP = 1.0 + 2.0**-40
# bounds that are no more than this multiple of their limits have settled
SETTLED = 1.01
MOST_CALLS = 100_000


@dataclass(frozen=True, eq=False)
class PartWidth:
    """What a `Part` adds: error <= E e + e_rest, width <= V w + V_mixed min(w, e) + w_rest."""

    E: Any
    e_rest: Any
    V: Any
    V_mixed: Any
    w_rest: Any

    def width(self, w: Any, e: Any) -> Any:
        """Return the widths of the rows for widths w and errors e of r."""
        return self.V @ w + self.V_mixed @ np.minimum(w, e) + self.w_rest


@dataclass(frozen=True, eq=False)
class Contraction:
    """One row of the measurement contraction: component <= others e + rest, likewise for w."""

    component: int
    others: Any
    rest: Any


@dataclass(frozen=True, eq=False)
class WidthMap:
    """One step of error and width of r, exact or in doubles; contractions of both sweeps."""

    part: PartWidth
    contractions: tuple[Contraction, ...]

    def error(self, e: Any) -> Any:
        """Map the bound of the error."""
        return self.contract(self.part.E @ e + self.part.e_rest)

    def width(self, w: Any, e: Any) -> Any:
        """Map the width, for errors of at most e."""
        return self.contract(self.part.width(w, e))

    def contract(self, values: Any) -> Any:
        """Cut errors or widths with the measurement, in place."""
        for row in self.contractions:
            bound = row.others @ values + row.rest
            values[row.component] = min(values[row.component], bound)
        return values

    def rounded(self) -> WidthMap:
        """Return the map in doubles."""
        part = PartWidth(**{name: nearest(value) for name, value in vars(self.part).items()})
        contractions = tuple(
            Contraction(c.component, nearest(c.others), float(nearest(np.array([c.rest]))[0]))
            for c in self.contractions
        )
        return WidthMap(part, contractions)


def part_width(part: Part, rows: Rows, slack: FloatArray, nominal: Exact | None) -> PartWidth:
    """Return the recursion of a part, for the vertex form or, with a nominal A, for the paper's."""
    widening = _widening(part, rows, slack)
    if nominal is None:
        return _vertex_width(part, widening)
    return _paper_width(part, nominal, widening)


def _sizes_of_signals(part: Part) -> tuple[Exact, Exact, Exact]:
    """Largest |r|, |y| and |u| over the declared boxes."""
    model = part.model
    x, w = model.size("x"), model.size("w")
    r = magnitude(inverse(part.S) @ part.decoupled.T2) @ x
    return r, magnitude(model.C) @ x + magnitude(model.W2) @ w, model.size("u")


def _widening(part: Part, rows: Rows, slack: FloatArray) -> tuple[Exact, Exact]:
    """Return (coefficient of the error in r, constant): twice what a bound is widened by."""
    table = exact(2.0 * slack)
    sizes = dict(zip("ryuo", (*_sizes_of_signals(part), exact(np.ones(1))), strict=True))
    of_e = np.zeros((rows.count, len(sizes["r"])), dtype=object)
    constant = np.zeros(rows.count, dtype=object)
    for name, place in rows.places.items():
        block = table[:, place]
        of_e = of_e + block if name.startswith("r_") else of_e
        constant = constant + block @ sizes[name[0]]
    return of_e, constant


def _vertex_width(part: Part, widening: tuple[Exact, Exact]) -> PartWidth:
    model = part.model
    a, _, _ = model.columns
    M = np.stack([part.on_r(v[:, a]) for v in model.vertices])
    G = np.stack([part.on_w(v[:, a]) for v in model.vertices])
    low, high = model.box("w").T
    spread = _spread(part)
    of_e, constant = widening
    both_signs, one_sign = _split_signs(M)
    mixed_G, plain_G = _split_signs(G)
    return PartWidth(
        E=magnitude(M).max(axis=0) + of_e,
        e_rest=spread + magnitude(G).max(axis=0) @ (high - low) + constant,
        V=one_sign,
        V_mixed=both_signs + of_e,
        w_rest=spread + (mixed_G + plain_G) @ (high - low) + constant,
    )


def _split_signs(stacked: Exact) -> tuple[Exact, Exact]:
    """Return (sum of both magnitudes where the sign changes, largest magnitude elsewhere)."""
    up, down = positive(stacked).max(axis=0), negative(stacked).max(axis=0)
    changes = (up > 0) & (down > 0)
    return np.where(changes, up + down, up * 0), np.where(changes, up * 0, up + down)


def _spread(part: Part) -> Exact:
    """Largest X (A_i - A_j) x + X (B_i - B_j) u + X (o_i - o_j) over the boxes."""
    model = part.model
    one = exact(np.ones((1, 2)))
    low, high = np.vstack([model.box("x"), model.box("u"), one]).T
    total = np.zeros(len(part.X), dtype=object)
    ranges, directions = exact(model.family.ranges), exact(model.family.directions)
    for (start, end), direction in zip(ranges, directions, strict=True):
        row = part.X @ direction
        least = positive(row) @ low - negative(row) @ high
        largest = positive(row) @ high - negative(row) @ low
        total = total + (end - start) * np.maximum(magnitude(least), magnitude(largest))
    return total


def _paper_width(part: Part, nominal: Exact, widening: tuple[Exact, Exact]) -> PartWidth:
    """Comparison matrix |R| + sigma_upper+ + sigma_lower- of errors and widths."""
    size_r, size_y, _ = _sizes_of_signals(part)
    parts = part.split(nominal)
    grown = positive(parts.sigma_upper) + negative(parts.sigma_lower)
    V = magnitude(parts.R) + grown
    inner = positive(parts.sigma_lower) + negative(parts.sigma_upper)
    of_e, constant = widening
    rest = (
        (grown - inner) @ size_r
        + (parts.M_upper - parts.M_lower) @ size_y
        + (parts.noise[1] - parts.noise[0])
        + constant
    )
    return PartWidth(V + of_e, rest, V, of_e, rest)


def contraction_width(rows: Rows, slack: FloatArray, part: Part, component: int) -> Contraction:
    """Return what one row of the contraction does to errors and widths."""
    of_e, constant = _widening(part, rows, slack)
    places, upper = rows.places, rows.upper[0][0]
    others = upper[places["r_upper"]] - upper[places["r_lower"]]
    noise = upper[-1] - rows.lower[0][0, -1]
    return Contraction(component, others + of_e[0], noise + constant[0])


def steady(step: WidthMap) -> tuple[FloatArray, FloatArray] | None:
    """Return (e*, w*) in doubles, or None if the errors grow without bound."""
    n2 = len(step.part.e_rest)
    if n2 == 0:
        return np.zeros(0), np.zeros(0)
    quick = step.rounded()
    E, rest = quick.part.E, quick.part.e_rest

    def error(e: FloatArray) -> FloatArray:
        return np.asarray(quick.error(e) * INFLATION, dtype=float)

    if float(np.abs(np.linalg.eigvals(E)).max()) * INFLATION < 1.0:
        linear = np.linalg.solve(np.eye(n2) - E * INFLATION, rest * INFLATION)
        e_star = _descend(linear, error)
    else:
        found = _ascend(n2, error) if step.contractions else None
        if found is None:
            return None
        e_star = found
    w_star = _descend(
        2.0 * e_star, lambda w: np.asarray(quick.width(w, e_star) * INFLATION, dtype=float)
    )
    return e_star, w_star


def _descend(value: FloatArray, step: Callable[[FloatArray], FloatArray]) -> FloatArray:
    for _ in range(1000):
        moved = np.minimum(step(value), value)
        if np.all(value - moved <= 1e-10 * value):
            return value
        value = moved
    return value


def _ascend(size: int, step: Callable[[FloatArray], FloatArray]) -> FloatArray | None:
    value = np.zeros(size)
    largest = LARGEST * max(1.0, float(step(value).max()))
    for _ in range(5000):
        moved = step(value)
        if not np.isfinite(moved).all() or moved.max() > largest:
            return None
        if np.all(moved - value <= 1e-12 * moved):
            return moved * INFLATION
        value = moved
    return None


def settling(
    step: WidthMap, e: FloatArray, w: FloatArray, first: FloatArray, calls: int | None
) -> tuple[int, FloatArray, FloatArray]:
    """Return how many calls errors and widths take to within 1 % of e* and w*, and both then.

    They begin with widths of at most `first`. A multiple of e* and w* above these is mapped below
    itself, so what it becomes after a number of calls holds for all later ones.
    """
    quick = step.rounded()
    begun = quick.contract(first * UP)
    scale = float((begun / np.minimum(e, w)).max(initial=1.0))
    error, width = scale * UP * e, scale * UP * w
    most = MOST_CALLS if calls is None else min(calls, MOST_CALLS)
    for k in range(1, most):
        if calls is None and np.all(error <= SETTLED * e) and np.all(width <= SETTLED * w):
            return k, error, width
        after = quick.error(error) * UP, quick.width(width, error) * UP
        error, width = np.minimum(error, after[0]), np.minimum(width, after[1])
    return most, error, width


def steady_holds(step: WidthMap, e: FloatArray, w: FloatArray) -> tuple[bool, float]:
    """Check f(e*) <= (1 - delta) e* and the same for the widths, exactly."""
    exact_e, exact_w = exact(e), exact(w)
    room = 1.0
    for value, moved in (
        (exact_e, step.error(exact_e)),
        (exact_w, step.width(exact_w, exact_e)),
    ):
        if any(not v > 0 for v in value):
            return False, 0.0
        left = np.array([1 - m / v for m, v in zip(moved, value, strict=True)], dtype=object)
        room = min(room, float(nearest(left).min(initial=1.0)))
        if any(gap < DELTA for gap in left):
            return False, room
    return True, room


def linear_widths(
    rows: Rows, slack: FloatArray, part: Part, w: FloatArray, more: Mapping[str, Exact]
) -> FloatArray:
    """Widths of bounds that are linear in r and y; `more`: sizes of what else they take."""
    places, high = rows.places, rows.upper[0]
    r, y, _ = _sizes_of_signals(part)
    r = r + exact(w)
    known = {"r_upper": r, "r_lower": r, "y": y, "one": exact(np.ones(1)), **more}
    of_r = magnitude(high[:, places["r_upper"]]) + magnitude(high[:, places["r_lower"]])
    total = of_r @ exact(w) + high[:, -1] - rows.lower[0][:, -1]
    for name, size in known.items():
        total = total + exact(2.0 * slack[:, places[name]]) @ size
    return above(total)


def row_widths(part: PartWidth, e: FloatArray, w: FloatArray) -> FloatArray:
    """Return the widths of a part's rows for the steady e and w, rounded upwards."""
    return above(part.width(exact(w), exact(e)))
