"""What runs: contraction, the sets of x_k and f_{k-1}, the prediction, all rounded outwards."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive.rigour import nearest
from obsynth.designs.core.boxes import Ends, column
from obsynth.designs.core.core import Core, Known, Parts, Seen
from obsynth.designs.core.given import Start
from obsynth.designs.interval import widths
from obsynth.designs.interval.record import SWEEPS, IntervalDesign
from obsynth.designs.interval.rows import Rows
from obsynth.symbolic.arrays import FloatArray


def memory_sizes(design: IntervalDesign) -> dict[str, int]:
    """Return the parts: bounds of r at the next call, and of the share of the fault known now."""
    n2, n_f = len(design.P), design.n_f
    return {"r_lower": n2, "r_upper": n2, "share_lower": n_f, "share_upper": n_f}


def first_memory(design: IntervalDesign, start: Start) -> dict[str, ArrayLike]:
    """Start with nothing: everything begins from the box of the first state."""
    return {}


def settling(
    design: IntervalDesign, box: FloatArray, calls: int | None = None
) -> tuple[int, FloatArray] | None:
    """Return how many calls the sets take to settle, and their half widths from then on.

    From half widths `box`, of states alone, infinite where one that matters is; None if unproved.
    """
    declared = 0.5 * np.diff(design.plant.box("x"), axis=1)[:, 0]
    first = design.first_width(np.minimum(box[: len(declared)], declared))
    if design.error.shape != first.shape:
        return None
    if not np.isfinite(first).all():
        return 0, np.full(box.shape, np.inf)
    calls, e, w = widths.settling(design.width_map, design.error, design.width, first, calls)
    return calls, design.half_widths_of(e, w)


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

    def bounds(self, known: Mapping[str, ca.SX]) -> Ends:
        """Return both ends, widened so that rounding cannot spoil them."""
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
        return Ends(column(lower), column(upper))


def _sum(coefficients: FloatArray, entries: list[ca.SX]) -> ca.SX:
    total = ca.SX(0)
    for coefficient, entry in zip(coefficients, entries, strict=True):
        if coefficient != 0.0:
            total = total + float(coefficient) * entry
    return total


def _signs(name: str, value: ca.SX) -> dict[str, ca.SX]:
    """Return a vector with its positive and negative parts, which cost no rounding."""
    return {name: value, f"{name}+": ca.fmax(value, 0), f"{name}-": ca.fmax(-value, 0)}


def _known(r: Ends, y: ca.SX, u: ca.SX) -> dict[str, ca.SX]:
    vectors = {"r_upper": r.upper, "r_lower": r.lower, "y": y}
    named = {k: v for name, value in vectors.items() for k, v in _signs(name, value).items()}
    return {**named, "u": u, "one": ca.SX(1)}


def _contract(design: IntervalDesign, r: Ends, y: ca.SX, u: ca.SX) -> Ends:
    """Cut the box of r with the measurement; nothing may be left."""
    lower, upper = r.lower[:], r.upper[:]
    evaluated = [(j, _Evaluated.of(rows, design)) for j, rows in design.contraction_rows]
    for j, rows in evaluated * SWEEPS:
        found = rows.bounds(_known(Ends(lower, upper), y, u))
        lower[j] = ca.fmax(lower[j], found.lower)
        upper[j] = ca.fmin(upper[j], found.upper)
    return Ends(lower, upper)


def build_core(design: IntervalDesign) -> Core:
    """Build the observer: contraction, sets of x_k and f_{k-1}, prediction from all readings."""
    plant, n_f = design.plant, design.n_f
    first = _Evaluated.of(design.first_rows, design)
    rows = ("state_rows", "estimate_rows", "prediction_rows", "share_rows")
    states, estimate, prediction, share = (
        _Evaluated.of(getattr(design, name), design) for name in rows
    )

    def run(seen: Seen) -> Known:
        part = seen.memory
        r = _contract(design, Ends(part["r_lower"], part["r_upper"]), seen.y, seen.u)
        now = _known(r, seen.y, seen.u)
        early = {name: part[name] for name in ("share_lower", "share_upper")}
        x, f = states.bounds(now), estimate.bounds({**now, **early})
        after, late = prediction.bounds(now), share.bounds(now)
        moved = {
            "r_lower": after.lower,
            "r_upper": after.upper,
            "share_lower": late.lower,
            "share_upper": late.upper,
        }
        return Known(
            x.middle(design.precision),
            f.middle(design.precision),
            x,
            f if n_f else None,
            moved,
            empty=r.empty(),
        )

    def begin(x: Ends, f: Ends, kept: Parts) -> Parts:
        r = first.bounds({"x_upper": x.upper, "x_lower": x.lower, "one": ca.SX(1)})
        open_ends = Ends.unbounded(n_f, design.precision)
        return {
            "r_lower": r.lower,
            "r_upper": r.upper,
            "share_lower": open_ends.lower,
            "share_upper": open_ends.upper,
        }

    scheduled = [name in design.model.scheduled for name in plant.names("x")]
    domain = np.where(np.array(scheduled)[:, None], plant.box("x"), [-np.inf, np.inf])
    return Core(run, begin, domain=domain)
