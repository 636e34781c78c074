"""How wide the sets of a step are, at most: contractor and core followed call by call.

A core (`Running`): ``s+ = decay s + offset``, all nonnegative, and half widths ``reach s + add``.
The map is monotone: from an s that it maps below itself nothing that follows exceeds what that s
says.

The contractor (`HalfWidths`): the map of one call, in the order of the step, is monotone: from an
envelope that it maps into itself it falls with every call, so what p calls make of it holds for
every copy that is as old.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, reduce

import casadi as ca
import numpy as np

from obsynth.designs.core.boxes import Rounding, cut_box
from obsynth.designs.core.contractor import SWEEPS, Contractor
from obsynth.designs.core.rounding import rounding_bound
from obsynth.designs.core.signals import finite_box
from obsynth.symbolic.arrays import FloatArray

ROUND_UP = 1.0 + 2.0**-50
# Of an estimate, in doubles: covers the rounding of estimate - half and estimate + half.
ULPS = 2.0**-50
# Above the relative rounding error of the few dozen operations of each formula here, in doubles.
UP = 1.0 + 2.0**-44
# Far below the rounding of estimates in either precision, which half widths count.
UNDERFLOW = 2.0**-900
SETTLED = 0.01
"""Half widths have settled where they stay within this share of their limits."""
MOST_CALLS = 100_000
MOST_PASSES = 200
# Of half widths that slopes and strips give: far above what their formulas round.
_WIDER = 1.0 + 2.0**-30
# Of ranges: above what the few roundings of an end take.
_ENDS = {"double": 2.0**-30, "single": 2.0**-18}
# How often an end steps outwards by what rounding an operation takes, at most.
_STEPS = 8.0


def above(precision: str, terms: int) -> float:
    """Return a factor above what rounding numbers of nonnegative terms that often takes in code."""
    return max(UP, 1.0 + (terms + 8) * Rounding(precision).step)


def shaken(gamma: float, rho: float) -> tuple[float, float]:
    """Return decay and offset of V where ``sqrt V+ <= sqrt((1 - gamma) V + gamma) + rho``.

    With W = (1 - gamma) V + gamma, ``2 rho sqrt(W) <= rho (W / a + a)`` for every a, exact where V
    stands still for the a taken.
    """
    kept = 1.0 - gamma
    a = (kept * rho + float(np.hypot(kept * rho, np.sqrt(gamma * (kept * rho**2 + gamma))))) / gamma
    grown = 1.0 + rho / a
    return kept * grown * UP, (gamma * grown + rho * a + rho**2) * UP


@dataclass(frozen=True, eq=False)
class Running:
    """One recursion of s (k,): decay (k, k), offset (k,), reach (N, k), add (N,).

    root: the half widths are ``sqrt(reach s) + add``, for ellipsoids, where s bounds V
    """

    decay: FloatArray
    offset: FloatArray
    reach: FloatArray
    add: FloatArray
    root: bool
    precision: str = "double"

    @property
    def more(self) -> float:
        """A factor above what rounding takes of these in code; 1 in doubles: they have it."""
        return 1.0 if self.precision == "double" else above(self.precision, len(self.decay))

    @property
    def limit(self) -> FloatArray:
        """What s goes to, (k,)."""
        decay, offset = self.decay * self.more**2, self.offset * self.more**2
        return np.asarray(np.linalg.solve(np.eye(len(decay)) - decay, offset))

    @property
    def steady(self) -> FloatArray:
        """The half widths after long, (N,)."""
        return self.half_widths(self.limit)

    def half_widths(self, s: FloatArray) -> FloatArray:
        """Return the half widths that belong to a value of s."""
        inner = self.reach @ s * self.more**2
        inner = np.sqrt(inner) if self.root else inner
        return np.asarray(inner * ROUND_UP + self.add * self.more**2)

    def falls(self, s: FloatArray) -> bool:
        """Whether s is mapped below itself, however that is rounded; underflow does not count."""
        return bool(np.all(self.next(s) <= s + UNDERFLOW))

    def next(self, s: FloatArray) -> FloatArray:
        """Return what is not below the next s of the code."""
        return np.asarray((self.decay @ s + self.offset) * (UP * self.more**2))


def all_around(bounds: Sequence[Running], s: ca.SX, estimate: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return the smallest half widths of bounds that all hold, and their next s, stacked."""
    ends = np.cumsum([0, *(len(bound.offset) for bound in bounds)]).tolist()
    halves, moved, precision = [], [], bounds[0].precision
    for bound, part in zip(bounds, ca.vertsplit(s, ends), strict=True):
        numbers = (bound.reach, bound.decay, bound.add[:, None], bound.offset[:, None])
        reach, decay, add, offset = (ca.sparsify(ca.DM(part * bound.more)) for part in numbers)
        inner = reach @ part
        halves.append((ca.sqrt(inner) if bound.root else inner) * ROUND_UP + ca.densify(add))
        moved.append(decay @ part + offset if bound.offset.any() else decay @ part)
    ulps = ULPS * Rounding(precision).step / Rounding().step
    return reduce(ca.fmin, halves) + ulps * ca.fabs(estimate), ca.vertcat(*moved)


def all_steady(bounds: Sequence[Running]) -> FloatArray:
    """Return the half widths after long, the smallest of bounds that all hold, (N,)."""
    return _least(bounds, [bound.limit for bound in bounds])


def settle(
    bounds: Sequence[Running], first: FloatArray, calls: int | None
) -> tuple[int, FloatArray]:
    """Return after how many calls half widths stay within 1 % of limits, and the largest then.

    They are the smallest of bounds that all hold, begun from `first`, stacked. With `calls` given,
    the largest from so many on. Infinite where it is not shown that they stay below anything.
    """
    s = np.split(first, np.cumsum([len(bound.offset) for bound in bounds])[:-1])
    limits = [bound.limit * (1.0 + 2.0**-20) for bound in bounds]
    near = all_steady(bounds) * (1.0 + SETTLED)
    since, largest = 0, np.zeros(len(near))
    for k in range(MOST_CALLS + 1):
        tops = [np.maximum(*pair) for pair in zip(s, limits, strict=True)]
        now = _least(bounds, tops)
        if k < MOST_CALLS and (np.any(now > near) if calls is None else k < calls):
            since = k + 1
        else:
            largest = np.maximum(largest, now)
            if all(bound.falls(top) for bound, top in zip(bounds, tops, strict=True)):
                return since, largest * (1.0 + 2.0**-30)
        pairs = zip(bounds, s, strict=True)
        s = [bound.next(part) for bound, part in pairs]
    return since, np.full(len(near), np.inf)


def _least(bounds: Sequence[Running], s: Sequence[FloatArray]) -> FloatArray:
    pairs = zip(bounds, s, strict=True)
    return np.asarray(np.min([bound.half_widths(part) for bound, part in pairs], axis=0))


@dataclass(frozen=True, eq=False)
class HalfWidths:
    """Half widths of the cut sets, states then faults, shape (n + n_f,), with all readings.

    delay: of the fault interval, 0 or 1
    nominal: with the derivatives of the nominal point: what is to be expected near it, no promise
    """

    contractor: Contractor
    delay: int
    nominal: bool = False

    @cached_property
    def slopes(self) -> FloatArray:
        """Ranges of the rows' derivatives, see `Equations`."""
        equations = self.contractor.equations
        return equations.nominal_slopes if self.nominal else equations.slopes

    @cached_property
    def declared(self) -> FloatArray:
        """Half of the declared ranges."""
        plant = self.contractor.plant
        boxes = np.vstack([plant.box("x"), plant.box("f").reshape(-1, 2)])
        half: FloatArray = 0.5 * np.diff(boxes, axis=1)[:, 0]
        return half

    @cached_property
    def lost(self) -> tuple[FloatArray, FloatArray]:
        """What rounding adds to an image and a reading, (n,), (m,); in doubles too little."""
        plant, precision = self.contractor.plant, self.contractor.precision
        n, m = len(plant.x), len(plant.output_names)
        if precision == "double":
            return np.zeros(n), np.zeros(m)
        function = plant.function()
        kinds = zip(function.name_in(), ("x", "u", "d", "f", "w", "p", "rho"), strict=True)
        boxes = {name: finite_box(plant, k, precision).reshape(-1, 2) for name, k in kinds}
        ends = {name: (box[:, :1], box[:, 1:]) for name, box in boxes.items()}
        ends["x"] = cut_box(boxes["x"], 64)
        rows, shown = rounding_bound(function, ends, precision).values()
        unit = Rounding(precision).step
        return _STEPS * rows.error, _STEPS * (shown.error + unit * shown.size)

    @cached_property
    def ranges(self) -> FloatArray:
        """Half of the ranges that every call cuts with."""
        half = self.declared.copy()
        n = len(self.contractor.domain)
        half[:n] = 0.5 * np.diff(self.contractor.domain, axis=1)[:, 0]
        return half if "ranges" in self.contractor.cuts else np.full(half.size, np.inf)

    @cached_property
    def envelope(self) -> FloatArray:
        """What holds at every call of a copy, infinite where a call would add to the ranges."""
        held = self.declared.copy()
        nothing = np.full(held.size, np.inf)
        while True:
            grown = self._call(held, nothing)[0] > held
            if not grown.any():
                return held
            held[grown] = np.inf

    @property
    def begun(self) -> FloatArray:
        """What a core begins from: what one instant says, faults by ranges or one call late."""
        n = len(self.contractor.domain)
        waits = not np.isfinite(self.declared[n:]).all()
        found = (self.envelope if waits else self.declared).copy()
        found[:n] = self._strips(np.minimum(found[:n], self.ranges[:n]))
        if waits:
            after = self._call(found, np.full(found.size, np.inf))[0][n:]
            found[n:] = np.minimum(self.declared[n:], after + self.contractor.rates)
        return found

    def steady(self, core: FloatArray, passes: int = MOST_PASSES) -> tuple[FloatArray, int]:
        """Return half widths for a core of given ones, and by how many calls they lag behind it."""
        plant, held, taken = self.contractor.plant, self.envelope, 0
        while True:
            after, shown = self._call(held, core)
            if taken == passes or np.all(after >= held * (1.0 - 1e-9)):
                break
            held, taken = after, taken + 1
        size = np.vstack([np.abs(plant.box("x")), np.abs(plant.box("f")).reshape(-1, 2)])
        share = _ENDS[self.contractor.precision]
        slack = share * np.where(np.isfinite(size), size, 0.0).max(axis=1)
        found: FloatArray = shown + slack
        return found, taken

    def _call(self, held: FloatArray, core: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what one call carries on, and what it returns."""
        cuts, equations = self.contractor.cuts, self.contractor.equations
        n, slopes = len(self.contractor.domain), np.abs(self.slopes).max(axis=2)
        fixed = 0.5 * np.diff(equations.box[held.size :], axis=1)[:, 0]
        x = self.ranges[:n].copy()
        for i in np.flatnonzero(equations.usable).tolist() if "image" in cuts else ():
            x[i] = min(x[i], _times(slopes[i], np.append(held, fixed)) * _WIDER + self.lost[0][i])
        x = np.minimum(self._strips(x), core[:n])
        late = held[n:].copy()
        for j, i in equations.invertible if "inversion" in cuts else ():
            rest = np.where(np.arange(slopes.shape[1]) == n + j, 0.0, slopes[i])
            halves = np.concatenate([held[:n], late, fixed])
            told = x[i] + _times(rest, halves) + self.lost[0][i]
            told = self._divided(i, j, told, halves)
            late[j] = min(late[j], told * _WIDER)
        late = np.minimum(late, core[n:]) if self.delay else late
        now = np.minimum(
            self.ranges[n:], late + self.contractor.rates if "rates" in cuts else np.inf
        )
        now = now if self.delay else np.minimum(now, core[n:])
        return np.append(x, now), np.append(x, late if self.delay else now)

    def _divided(self, row: int, fault: int, half: float, halves: FloatArray) -> float:
        """Bound the half width of what a row says of a fault, from those of all variables.

        Of n / J with n within `half` of J f, and J in an interval of half width s: at most
        ``half / |J| + (|f| |J| + half) s / |J|^2``, each with the worst J.
        """
        equations, plant = self.contractor.equations, self.contractor.plant
        place = row, len(self.contractor.domain) + fault
        ends = np.abs(self.slopes[place])
        low, high = float(ends.min()), float(ends.max())
        spread = min(0.5 * (high - low), _times(equations.bends[place], halves))
        if spread <= 1e-9 * high:
            return half / low
        largest = float(np.abs(plant.box("f")[fault]).max())
        return half / low + (largest * high + half) * spread / low**2

    def _strips(self, x: FloatArray) -> FloatArray:
        """Cut states with what readings say of them."""
        x = x.copy()
        strips = [
            (s, lost)
            for s, lost in zip(self.contractor.strips, self.lost[1].tolist(), strict=True)
            if s is not None
        ]
        for strip, lost in strips * SWEEPS if "strips" in self.contractor.cuts else ():
            for j in np.flatnonzero(strip.row).tolist():
                others = np.where(np.arange(len(x)) == j, 0.0, np.abs(strip.row))
                told = 0.5 * (strip.high - strip.low) + _times(others, x) + lost
                x[j] = min(x[j], told / abs(strip.row[j]) * _WIDER)
        return x


def _times(size: FloatArray, halves: FloatArray) -> float:
    """Return a product in which what is not asked for may be without bound."""
    return float(np.where(size > 0.0, size * np.where(size > 0.0, halves, 0.0), 0.0).sum())
