"""What the data say whatever the method: strips, image, inversion for faults, rates and ranges.

Each cut keeps every point that the plant's equations and ranges allow; docs/step.md says what each
is. A row with an unbounded unknown input or disturbance has no image and no inversion; in
continuous time there are strips, ranges and rates alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import casadi as ca
import numpy as np

from obsynth.derive.intervals.program import CONSTANT_ULPS, constant_interval
from obsynth.derive.rigour import outward
from obsynth.designs.core.boxes import FAR, Ends, Lifted, Rounding
from obsynth.designs.core.equations import Before, Equations
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray

Cut = Literal["ranges", "strips", "image", "inversion", "rates", "sweeps"]
EVERY_CUT: tuple[Cut, ...] = get_args(Cut)
"""Parts of the contractor, for an option that names those that are used."""
CUTS = EVERY_CUT[:-1]
"""Those that are used where nothing is said."""

SWEEPS = 2


@dataclass(frozen=True, eq=False)
class Strip:
    """An output ``C x + W2 w`` with constant numbers: its row of C and the range of W2 w."""

    row: FloatArray
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Contractor:
    """The cuts that a plant in the time of the method allows; Ts: from one call to the next."""

    plant: Plant
    Ts: float
    cuts: tuple[Cut, ...] = CUTS
    precision: str = "double"

    @cached_property
    def rounding(self) -> Rounding:
        """How ends step outwards."""
        return Rounding(self.precision)

    @cached_property
    def equations(self) -> Equations:
        """The rows of the plant with their derivatives."""
        return Equations(self.plant)

    @cached_property
    def domain(self) -> FloatArray:
        """Ranges of the states on which a derivative depends, infinite for others, (n, 2)."""
        return np.where(self.equations.curved[:, None], self.plant.box("x"), [-np.inf, np.inf])

    @cached_property
    def rates(self) -> FloatArray:
        """What every fault moves at most from one call to the next, shape (n_f,)."""
        step = 1.0 if self.plant.Ts is not None else self.Ts * (1.0 + 2.0**-50)
        found = [np.inf if s.rate is None else float(s.rate) * step for s in self.plant.f]
        still = [0.0 if s.constant else r for s, r in zip(self.plant.f, found, strict=True)]
        ends = np.column_stack([np.zeros(len(still)), still])
        limits: FloatArray = outward(ends, self.precision)
        return limits[:, 1]

    @cached_property
    def strips(self) -> tuple[Strip | None, ...]:
        """Every output as a strip; None where it is not affine, or its noise has no bound."""
        return _strips(self.plant)

    def shown(self, box: FloatArray) -> FloatArray:
        """Return the ranges of the outputs over a box of states, (m, 2), rounded outwards."""
        rows = []
        for strip in self.strips:
            ends = np.full((1, 2), np.inf)
            if strip is not None:
                used = np.flatnonzero(strip.row)
                ends = np.sort(strip.row[used, None] * box[used], axis=1)
                ends = np.vstack([ends, [(strip.low, strip.high)]])
            size = float(np.abs(ends).sum())
            slack = 2.0**5 * self.rounding.step * size
            low, high = ends.sum(axis=0)
            rows.append((low - slack, high + slack) if np.isfinite(size) else (-np.inf, np.inf))
        return np.array(rows).reshape(-1, 2)

    def measure(self, X: Ends, y: ca.SX, used: Sequence[ca.SX]) -> Ends:
        """Cut a box of states with the strips of the readings that are used."""
        if "strips" not in self.cuts:
            return X
        low, high = ca.SX(X.lower), ca.SX(X.upper)
        several = any(s is not None and np.count_nonzero(s.row) > 1 for s in self.strips)
        for _ in range(SWEEPS if several else 1):
            for i, strip in enumerate(self.strips):
                if strip is None:
                    continue
                for j in np.flatnonzero(strip.row).tolist():
                    below, above = self._told(strip, j, y[i], low, high)
                    higher = ca.logic_and(used[i], below > low[j])
                    lower = ca.logic_and(used[i], above < high[j])
                    low[j] = ca.if_else(higher, below, low[j])
                    high[j] = ca.if_else(lower, above, high[j])
        return Ends(low, high)

    def _told(self, strip: Strip, j: int, y: ca.SX, low: ca.SX, high: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Return what one reading says of a state, the others of its strip in their ends."""
        r, slack = self.rounding, ca.SX(0)
        if self.precision != "double":
            # the reading and the numbers of the strip are rounded too
            slack = r.step * (ca.fabs(y) + max(abs(strip.low), abs(strip.high)))
        below, above = r.down(y - strip.high - slack), r.up(y - strip.low + slack)
        for k in np.flatnonzero(strip.row).tolist():
            if k != j:
                c, units = float(strip.row[k]), self._units(strip.row[k])
                least, most = (low[k], high[k]) if c > 0 else (high[k], low[k])
                below = r.down(below - r.up(c * most, units, tiny=True))
                above = r.up(above - r.down(c * least, units, tiny=True))
        c, units = float(strip.row[j]), self._units(strip.row[j])
        if c == 1.0:
            return below, above
        ends = (below / c, above / c) if c > 0 else (above / c, below / c)
        return r.down(ends[0], units, tiny=True), r.up(ends[1], units, tiny=True)

    def _units(self, coefficient: float) -> float:
        """Return how many roundings a product takes: a coefficient may stand for one near it."""
        low, high = constant_interval(float(coefficient))
        exact = self.precision == "double" or float(np.float32(coefficient)) == coefficient
        return (1.0 if low == high else 2.0 + CONSTANT_ULPS) + (0.0 if exact else 1.0)

    def image(self, before: Before) -> Ends:
        """Return what the states can be one call later, unbounded where a row has no image."""
        # what has no range may have been given one by what it did
        swept = before.rest.lower.numel() > 0
        usable = self.equations.small if swept else self.equations.usable
        rows = [
            self.equations.image(i, before, self.rounding)
            if "image" in self.cuts and usable[i]
            else self.rounding.number(-FAR, FAR, self.rounding.limits.far)
            for i in range(self.equations.n)
        ]
        return Ends(ca.vertcat(*(r.lower for r in rows)), ca.vertcat(*(r.upper for r in rows)))

    def invert(self, before: Before, X: Ends) -> Ends:
        """Return the faults of the call before, cut with where the states are now."""
        low, high = ca.SX(before.faults.lower), ca.SX(before.faults.upper)
        pairs = [*self.equations.invertible, *self.equations.turning]
        for j, i in pairs if "inversion" in self.cuts else ():
            known = Before(before.states, Ends(low, high), before.known)
            now = Lifted(X.lower[i], X.upper[i])
            found = self.equations.invert(i, j, known, now, self.rounding)
            low[j] = ca.if_else(found.lower > low[j], found.lower, low[j])
            high[j] = ca.if_else(found.upper < high[j], found.upper, high[j])
        return Ends(low, high)

    def drift(self, F: Ends) -> Ends:
        """Return where the faults can be one call later, by their rates."""
        low, high, far = ca.SX(F.lower), ca.SX(F.upper), self.rounding.limits.far
        for j, rate in enumerate(self.rates.tolist()):
            if not np.isfinite(rate) or "rates" not in self.cuts:
                low[j], high[j] = -far, far
            elif rate > 0.0:
                low[j] = self.rounding.down(low[j] - rate)
                high[j] = self.rounding.up(high[j] + rate)
        return Ends(low, high)


def _strips(plant: Plant) -> tuple[Strip | None, ...]:
    """Read every output as a strip: constant slopes in states and disturbances, nothing else."""
    kinds = ("x", "u", "d", "f", "w", "p", "rho")
    s = {kind: ca.SX.sym(kind, len(plant.names(kind))) for kind in kinds}
    y = ca.densify(plant.function()(*(s[kind] for kind in kinds))[1])
    found: list[Strip | None] = []
    for i in range(y.numel()):
        given = ca.vertcat(*s.values())
        slopes = ca.jacobian(y[i], given)
        origin = ca.Function("y", list(s.values()), [y[i]])(
            *(ca.DM.zeros(v.numel()) for v in s.values())
        )
        others = ca.vertcat(*(s[kind] for kind in kinds if kind not in ("x", "w")))
        if ca.depends_on(slopes, given) or ca.depends_on(y[i], others) or float(origin) != 0.0:
            found.append(None)
            continue
        numbers = np.array(ca.DM(slopes)).ravel()
        n, start = len(plant.x), sum(s[kind].numel() for kind in kinds[:4])
        found.append(_strip(numbers[:n], numbers[start : start + len(plant.w)], plant.box("w")))
    return tuple(found)


def _strip(row: FloatArray, noise: FloatArray, box: FloatArray) -> Strip | None:
    used = np.flatnonzero(noise)
    if not np.isfinite(box[used]).all():
        return None
    ends = np.sort(noise[used, None] * box[used], axis=1)
    low, high = ends.sum(axis=0) if used.size else np.zeros(2)
    slack = 2.0**-50 * (used.size + 1) * float(np.abs(ends).sum())
    return Strip(row, low - slack, high + slack)
