"""How wide the intervals can get: a monotone recursion, its steady value and the proof.

Let e bound r_upper - r and r - r_lower, and w the width of the interval of r. One step maps both
by functions that grow with their argument but never faster than it: f(c e) <= c f(e) for c >= 1.
If f(e*) <= (1 - delta) e* with e* > 0, an error of c e*, c > 1, becomes at most (1 - delta) c e*,
so that e* bounds the error in the limit whatever it was at the start. That inequality is checked
in exact arithmetic; it proves stability and the steady widths at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.designs.interval.exact_arrays import (
    Exact,
    FloatArray,
    above,
    exact,
    inverse,
    magnitude,
    nearest,
    negative,
    positive,
)
from obsynth.designs.interval.model import columns_of
from obsynth.designs.interval.rows import Part, Rows

__all__ = [
    "Contraction",
    "PartWidth",
    "WidthMap",
    "contraction_width",
    "part_width",
    "row_widths",
    "steady",
    "steady_holds",
]

DELTA = exact([2.0**-40])[0]
INFLATION = 1.0 + 1e-6
LARGEST = 1e12


@dataclass(frozen=True, eq=False)
class PartWidth:
    """What one `Part` adds: error <= E e + e_rest, width <= V w + V_mixed min(w, e) + w_rest.

    All entries exact and nonnegative; shapes (rows, n - q) and (rows,).
    """

    E: Exact
    e_rest: Exact
    V: Exact
    V_mixed: Exact
    w_rest: Exact


@dataclass(frozen=True, eq=False)
class Contraction:
    """One row of the measurement contraction: component <= |others| e + rest, likewise for w."""

    component: int
    others: Exact
    rest: Exact


@dataclass(frozen=True, eq=False)
class WidthMap:
    """One step of the error and of the width of r.

    Attributes
    ----------
    part : PartWidth
        Of the prediction.
    contractions : tuple of Contraction
        In the order in which the step makes them, both sweeps.
    """

    part: PartWidth
    contractions: tuple[Contraction, ...]

    def error(self, e: Any, lift: Callable[[Exact], Any]) -> Any:
        """Map the bound of the error."""
        return self._contract(lift(self.part.E) @ e + lift(self.part.e_rest), lift)

    def width(self, w: Any, e: Any, lift: Callable[[Exact], Any]) -> Any:
        """Map the width, for errors of at most e."""
        part = self.part
        both = np.minimum(w, e)
        moved = lift(part.V) @ w + lift(part.V_mixed) @ both + lift(part.w_rest)
        return self._contract(moved, lift)

    def _contract(self, values: Any, lift: Callable[[Exact], Any]) -> Any:
        values = values.copy()
        for row in self.contractions:
            bound = lift(row.others) @ values + lift(row.rest).item()
            values[row.component] = min(values[row.component], bound)
        return values


def part_width(part: Part, rows: Rows, slack: FloatArray, nominal: Exact | None) -> PartWidth:
    """Return the recursion of a part, for the vertex form or, with a nominal A, for the paper's.

    Parameters
    ----------
    part : Part
    rows, slack
        The bounds that run, and by how much they are widened.
    nominal : exact array, shape (n, n), optional
    """
    size_r, size_y, size_u = _sizes_of_signals(part)
    widening = _widening(rows, slack, size_r, size_y, size_u)
    if nominal is None:
        return _vertex_width(part, widening)
    return _paper_width(part, nominal, size_r, size_y, widening)


def _sizes_of_signals(part: Part) -> tuple[Exact, Exact, Exact]:
    """Largest |r|, |y| and |u| over the declared boxes."""
    model = part.model
    x, w = model.size("x"), model.size("w")
    r = magnitude(inverse(part.S) @ part.plant.T2) @ x
    return r, magnitude(model.C) @ x + magnitude(model.W2) @ w, model.size("u")


def _widening(rows: Rows, slack: FloatArray, r: Exact, y: Exact, u: Exact) -> tuple[Exact, Exact]:
    """Return (coefficient of the error in r, constant): twice what a bound is widened by."""
    table = exact(2.0 * slack)
    of_e = np.zeros((rows.count, len(r)), dtype=object)
    constant = np.zeros(rows.count, dtype=object)
    at = 0
    for name, size in rows.sizes.items():
        block = table[:, at : at + size]
        at += size
        if name.startswith("r_"):
            of_e = of_e + block
            constant = constant + block @ r
        elif name.startswith("y"):
            constant = constant + block @ y
        elif name == "u":
            constant = constant + block @ u
        elif name == "one":
            constant = constant + block[:, 0]
    return of_e, constant


def _vertex_width(part: Part, widening: tuple[Exact, Exact]) -> PartWidth:
    model = part.model
    a, _, _ = columns_of(model)
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


def _paper_width(
    part: Part, nominal: Exact, size_r: Exact, size_y: Exact, widening: tuple[Exact, Exact]
) -> PartWidth:
    """Comparison matrix |R| + sigma_upper+ + sigma_lower- of errors and widths."""
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
    size_r, size_y, size_u = _sizes_of_signals(part)
    of_e, constant = _widening(rows, slack, size_r, size_y, size_u)
    start = list(rows.sizes).index("r_upper") * part.S.shape[0]
    n2 = part.S.shape[0]
    others = rows.upper[0][0, start : start + n2] - rows.upper[0][0, start + n2 : start + 2 * n2]
    noise = rows.upper[0][0, -1] - rows.lower[0][0, -1]
    return Contraction(component, others + of_e[0], np.array([noise + constant[0]], dtype=object))


def steady(step: WidthMap) -> tuple[FloatArray, FloatArray] | None:
    """Return (e*, w*) in doubles, or None if the errors grow without bound.

    Iterates from the solution without contraction where there is one, which is above what is
    sought, otherwise from zero; both end in the only positive fixed point.
    """
    lift = nearest
    n2 = len(step.part.e_rest)
    if n2 == 0:
        return np.zeros(0), np.zeros(0)
    E, rest = nearest(step.part.E), nearest(step.part.e_rest)
    table: dict[int, FloatArray] = {}

    def quick(values: Exact) -> FloatArray:
        if id(values) not in table:
            table[id(values)] = lift(values)
        return table[id(values)]

    e = np.zeros(n2)
    if float(np.abs(np.linalg.eigvals(E)).max()) * INFLATION < 1.0:
        e = np.maximum(np.linalg.solve(np.eye(n2) - E * INFLATION, rest * INFLATION), 0.0)
    e_star = _iterate(e, lambda v: step.error(v, quick) * INFLATION)
    if e_star is None:
        return None
    w_star = _iterate(e_star * 2.0, lambda v: step.width(v, e_star, quick) * INFLATION)
    return None if w_star is None else (e_star, w_star)


def _iterate(start: FloatArray, step: Callable[[FloatArray], FloatArray]) -> FloatArray | None:
    value = start
    largest = LARGEST * max(1.0, float(step(start * 0.0).max(initial=0.0)))
    for _ in range(100_000):
        moved = step(value)
        if not np.isfinite(moved).all() or moved.max() > largest:
            return None
        if np.all(np.abs(moved - value) <= 1e-9 * moved):
            return np.maximum(moved, value)
        value = moved
    return value


def steady_holds(step: WidthMap, e: FloatArray, w: FloatArray) -> tuple[bool, float]:
    """Check f(e*) <= (1 - delta) e* and the same for the widths, exactly.

    Returns
    -------
    (bool, float)
        Whether both hold, and the smallest relative room.
    """

    def same(values: Exact) -> Exact:
        return values

    exact_e, exact_w = exact(e), exact(w)
    room = 1.0
    for value, moved in (
        (exact_e, step.error(exact_e, same)),
        (exact_w, step.width(exact_w, exact_e, same)),
    ):
        if any(not v > 0 for v in value):
            return False, 0.0
        ratio = [
            float(nearest(np.array([m / v], dtype=object))[0])
            for m, v in zip(moved, value, strict=True)
        ]
        if any(m > (1 - DELTA) * v for m, v in zip(moved, value, strict=True)):
            return False, 1.0 - max(ratio)
        room = min(room, 1.0 - max(ratio, default=0.0))
    return True, room


def row_widths(part: PartWidth, e: FloatArray, w: FloatArray) -> FloatArray:
    """Return the widths of a part's rows for the steady e and w, rounded upwards."""
    exact_e, exact_w = exact(e), exact(w)
    both = np.minimum(exact_w, exact_e)
    return above(part.V @ exact_w + part.V_mixed @ both + part.w_rest)
