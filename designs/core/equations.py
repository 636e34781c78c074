"""One step of a discrete plant over boxes: its image, and the faults that explain it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import casadi as ca
import numpy as np

from obsynth.derive.intervals.program import Program, evaluate
from obsynth.designs.core.boxes import FAR, Ends, Lifted, Rounding, cut_box
from obsynth.designs.core.lifted import clamped, combine, lift
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import BoolArray, FloatArray

CELLS = 4096
"""Cells of the domain over which the signs of derivatives are proved."""
MOST_NODES = 4000
"""Operations of a row and its derivatives above which it is left alone."""


@dataclass(frozen=True, eq=False)
class Before:
    """What is known of an instant: sets of states, faults and the rest, inputs, scheduling."""

    states: Ends
    faults: Ends
    known: ca.SX
    rest: Ends = field(default_factory=lambda: Ends(ca.SX(0, 1), ca.SX(0, 1)))

    def where(self, condition: ca.SX, other: "Before") -> "Before":
        """Return this where a condition holds, the other elsewhere."""
        return Before(
            self.states.where(condition, other.states),
            self.faults.where(condition, other.faults),
            self.known,
            self.rest.where(condition, other.rest),
        )


class Equations:
    """Rows of a plant and their derivatives as programs over (x, f, rest) and (u, theta).

    form: other rows over these than those of the dynamics, ((x, f, rest), (u, theta)) -> (rows,)
    rest: unknown inputs, disturbances, parameters and scheduling that is not measured
    box: ranges of (x, f, rest), `FAR` where there is none or where it does not matter
    curved: states on which some derivative by a state or a fault depends, (n,)
    slopes: ranges of the derivatives of every row over the box, (n, variables, 2)
    small: rows of few enough operations, in discrete time, (n,)
    usable: those that no unbounded signal enters, (n,)
    """

    def __init__(self, plant: Plant, form: ca.Function | None = None) -> None:
        self.plant = plant
        n, n_f = len(plant.x), len(plant.f)
        v, known, rows, _, rest = symbols(plant)
        if form is not None:
            rows = ca.densify(ca.SX(form(v, known)))
        self.n_rows = int(rows.numel())
        self.curved = curved = curved_states(plant)
        self.n, self.n_f, self.n_v = n, n_f, int(v.numel())
        faults = plant.box("f") + 0.0
        faults = np.column_stack([np.minimum(faults[:, 0], 0.0), np.maximum(faults[:, 1], 0.0)])
        states = np.where(curved[:, None], plant.box("x"), [-np.inf, np.inf])
        given = np.vstack([states, faults.reshape(-1, 2), rest.reshape(-1, 2)])
        self.box: FloatArray = np.clip(given, -FAR, FAR)
        self.known_box: FloatArray = np.clip(_known_box(plant, rows, v, known), -FAR, FAR)
        J = ca.jacobian(rows, v)
        self.program = Program.from_casadi(ca.Function("rows", [v, known], [rows, J.nz[:]]))
        places = zip(J.sparsity().row(), J.sparsity().get_col(), strict=True)
        self.entries: dict[tuple[int, int], int] = {
            (i, j): self.n_rows + k for k, (i, j) in enumerate(places) if not J.nz[k].is_zero()
        }
        self.slopes = self._slopes()
        free = [j for j in range(n + n_f, self.n_v) if not np.isfinite(given[j]).all()]
        self.small: BoolArray = np.array(
            [plant.Ts is not None and self._size(i) <= MOST_NODES for i in range(self.n_rows)]
        )
        bounded = [not any((i, j) in self.entries for j in free) for i in range(self.n_rows)]
        self.usable: BoolArray = self.small & np.array(bounded)

    def _size(self, row: int) -> int:
        entries = [k for (i, _), k in self.entries.items() if i == row]
        return len(self.program.live([row, *entries]))

    def _slopes(self) -> FloatArray:
        slopes = np.zeros((self.n_rows, self.n_v, 2))
        whole = np.vstack([self.box, self.known_box])
        for (i, j), k in self.entries.items():
            support = list(self.program.support(k))
            with np.errstate(all="ignore"):
                cells = cut_box(whole, CELLS, support, most=64)
                low, high = evaluate(self.program, *cells, [k])
            slopes[i, j] = low.min(), high.max()
        return slopes

    @property
    def nominal_slopes(self) -> FloatArray:
        """The derivatives at nominal states and inputs, or middles of ranges, without faults."""
        plant = self.plant
        known = (*plant.u, *(s for s in plant.rho if s.measured))
        at = np.concatenate([self.box.mean(axis=1), np.zeros(len(known))])
        at[self.n : self.n + self.n_f] = 0.0
        for j, s in [*enumerate(plant.x), *enumerate(known, self.n_v)]:
            middle = 0.5 * (s.lower + s.upper) if s.bounded else 0.0
            at[j] = middle if s.nominal is None else float(s.nominal)
        slopes, which = self.slopes.copy(), [*self.entries.values()]
        with np.errstate(all="ignore"):
            ends = evaluate(self.program, at[:, None], at[:, None], which)
        for pair, found in zip(self.entries, np.hstack(ends).tolist(), strict=True):
            slopes[pair] = found if np.isfinite(found).all() else slopes[pair]
        return slopes

    @cached_property
    def outputs(self) -> Program:
        """The outputs over the same variables."""
        v, known, _, outputs, _ = symbols(self.plant)
        return Program.from_casadi(ca.Function("outputs", [v, known], [outputs]))

    @cached_property
    def shown(self) -> frozenset[int]:
        """Variables that enter an output."""
        program = self.outputs
        places = [program.support(k) for k in range(len(program.outputs))]
        return frozenset(j for support in places for j in support if j < self.n_v)

    @cached_property
    def bends(self) -> dict[tuple[int, int], FloatArray]:
        """How slopes by faults vary: bounds of their derivatives over the box, (variables,)."""
        n = self.n
        which = [(i, n + j) for j, i in self.invertible]
        if not which:
            return {}
        v, known, rows, _, _ = symbols(self.plant)
        slopes = ca.vertcat(*(ca.jacobian(rows[i], v)[j] for i, j in which))
        second = ca.densify(ca.jacobian(slopes, ca.vertcat(v, known)))
        program = Program.from_casadi(ca.Function("bends", [v, known], [second]))
        whole = np.vstack([self.box, self.known_box])
        with np.errstate(all="ignore"):
            low, high = evaluate(program, whole[:, :1], whole[:, 1:], [*range(second.numel())])
        size = np.maximum(np.abs(low), np.abs(high)).reshape(second.shape[1], second.shape[0])
        size = np.where(np.isnan(size), np.inf, size)
        return {pair: size[: self.n_v, k] for k, pair in enumerate(which)}

    @property
    def invertible(self) -> list[tuple[int, int]]:
        """Pairs (fault, row) where the row tells the fault: its slope has one sign."""
        return [
            (j, i)
            for j in range(self.n_f)
            for i in range(self.n)
            if self.usable[i]
            and not self.slopes[i, self.n + j, 0] <= 0 <= self.slopes[i, self.n + j, 1]
        ]

    @property
    def turning(self) -> list[tuple[int, int]]:
        """Pairs (fault, row) whose slope passes or touches zero in the box, and is bounded."""
        return [
            (j, i)
            for j in range(self.n_f)
            for i in range(self.n)
            if self.usable[i]
            and (i, self.n + j) in self.entries
            and (j, i) not in self.invertible
            and np.abs(self.slopes[i, self.n + j]).max() < 0.5 * FAR
        ]

    def variables(self, before: Before) -> list[Lifted]:
        """Return (x, f, rest, u, theta) as lifted intervals."""
        n, n_f = self.n, self.n_f
        ends = [(before.states.lower[i], before.states.upper[i]) for i in range(n)]
        ends += [(before.faults.lower[j], before.faults.upper[j]) for j in range(n_f)]
        found = [Lifted(*pair, *box) for pair, box in zip(ends, self.box.tolist(), strict=False)]
        ranges = self.box[n + n_f :].tolist()
        lower, upper = (ca.vertsplit(end) for end in (before.rest.lower, before.rest.upper))
        for k, (low, high) in enumerate(ranges):
            swept = Lifted(lower[k], upper[k], low, high) if lower else Lifted.number(low, high)
            found.append(swept)
        return found + [
            Lifted.point(before.known[k], low, high)
            for k, (low, high) in enumerate(self.known_box.tolist())
        ]

    def image(
        self,
        row: int,
        before: Before,
        rounding: Rounding,
        fixed: Mapping[int, Lifted] | None = None,
    ) -> Lifted:
        """Enclose a row over the boxes; `fixed` puts other intervals in place of variables."""
        whole = self.variables(before)
        for j, value in (fixed or {}).items():
            whole[j] = value
        ends = self._corners(row, whole)
        node = [self.program.outputs[row]]
        lower = lift(self.program, node, ends[0], rounding)[0]
        upper = lift(self.program, node, ends[1], rounding)[0]
        found = Lifted(
            lower.lower, upper.upper, min(lower.low, upper.low), max(lower.high, upper.high)
        )
        centred = self._centred(row, whole, ends, rounding)
        if centred is None:
            return found
        # a bound that is not a number cuts nothing
        low = ca.if_else(centred.lower > found.lower, centred.lower, found.lower)
        high = ca.if_else(centred.upper < found.upper, centred.upper, found.upper)
        return Lifted(low, high, found.low, found.high)

    def _corners(self, row: int, whole: list[Lifted]) -> tuple[list[Lifted], list[Lifted]]:
        """Return the variables where the row is smallest and largest, as far as signs are known."""
        least, most = list(whole), list(whole)
        for j in range(self.n_v):
            low, high = self.slopes[row, j]
            value = whole[j]
            if low < 0.0 < high or low == high == 0.0:
                continue
            bottom = Lifted.point(value.lower, value.low, value.high)
            top = Lifted.point(value.upper, value.low, value.high)
            least[j], most[j] = (bottom, top) if low >= 0.0 else (top, bottom)
        return least, most

    def _centred(
        self,
        row: int,
        whole: list[Lifted],
        ends: tuple[list[Lifted], list[Lifted]],
        rounding: Rounding,
    ) -> Lifted | None:
        """Mean value form in the variables of open sign; None where there is none or no bound."""
        open_ones = [
            j
            for j in range(self.n_v)
            if self.slopes[row, j, 0] < 0.0 < self.slopes[row, j, 1]
            and not ca.is_equal(whole[j].lower, whole[j].upper, 2)
        ]
        if not open_ones:
            return None
        nodes = [self.program.outputs[self.entries[row, j]] for j in open_ones]
        slopes = lift(self.program, nodes, whole, rounding)
        least, most = list(ends[0]), list(ends[1])
        reach = Lifted.number(0.0)
        for j, slope in zip(open_ones, slopes, strict=True):
            value = whole[j]
            middle = 0.5 * value.lower + 0.5 * value.upper
            least[j] = most[j] = Lifted.point(middle, value.low, value.high)
            radius = rounding.up(ca.fmax(value.upper - middle, middle - value.lower))
            limit = float(np.abs(self.slopes[row, j]).max())
            size = slope.magnitude
            if limit < rounding.limits.largest:
                size = ca.fmin(size, rounding.around(limit, limit)[1])
            part = combine(
                "multiply",
                Lifted.point(size, 0.0, min(limit, FAR)),
                Lifted.point(radius, 0.0, FAR),
                rounding=rounding,
            )
            reach = combine("add", reach, part, rounding=rounding)
        node = [self.program.outputs[row]]
        lower = lift(self.program, node, least, rounding)[0]
        upper = lift(self.program, node, most, rounding)[0]
        spread = Lifted.point(reach.upper, 0.0, FAR)
        return Lifted(
            combine("subtract", lower, spread, rounding=rounding).lower,
            combine("add", upper, spread, rounding=rounding).upper,
        )

    def invert(
        self, row: int, fault: int, before: Before, now: Lifted, rounding: Rounding
    ) -> Lifted:
        """Enclose the fault that took the row to where it is now: mean value in the fault alone."""
        j = self.n + fault
        zero = {j: Lifted.number(0.0)}
        rest = self.image(row, before, rounding, zero)
        low, high = self.slopes[row, j].tolist()
        slope = Lifted.number(low, high)
        if low != high:
            whole = self.variables(before)
            value = whole[j]
            whole[j] = Lifted(
                ca.fmin(value.lower, 0.0), ca.fmax(value.upper, 0.0), value.low, value.high
            )
            node = self.program.outputs[self.entries[row, j]]
            local = lift(self.program, [node], whole, rounding)[0]
            slope = clamped(replace(local, low=low, high=high), rounding)
        moved = combine("subtract", now, rest, rounding=rounding)
        return combine("divide", moved, slope, rounding=rounding)


def symbols(plant: Plant) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX, FloatArray]:
    """Return (x, f, rest), (u, theta), the rows, the outputs and the ranges of rest."""
    sizes = {kind: len(plant.names(kind)) for kind in ("x", "u", "d", "f", "w", "p", "rho")}
    s = {kind: ca.SX.sym(kind, size) for kind, size in sizes.items()}
    measured = [k for k, signal in enumerate(plant.rho) if signal.measured]
    hidden = [k for k, signal in enumerate(plant.rho) if not signal.measured]
    rows, outputs = plant.function()(*(s[kind] for kind in ("x", "u", "d", "f", "w", "p", "rho")))
    rho = ca.vertsplit(s["rho"])
    rest = ca.vertcat(s["d"], s["w"], s["p"], *(rho[k] for k in hidden))
    ranges = np.vstack([plant.box(kind).reshape(-1, 2) for kind in ("d", "w", "p")])
    ranges = np.vstack([ranges, plant.box("rho").reshape(-1, 2)[hidden]])
    known = ca.vertcat(s["u"], *(rho[k] for k in measured))
    return ca.vertcat(s["x"], s["f"], rest), known, ca.densify(rows), ca.densify(outputs), ranges


def curved_states(plant: Plant, noise: bool = False) -> BoolArray:
    """Return on which states a derivative by a state or a fault depends, (n,).

    noise: whether derivatives by disturbances and parameters count too
    """
    v, _, rows, outputs, _ = symbols(plant)
    n, n_f = len(plant.x), len(plant.f)
    slopes = ca.jacobian(ca.vertcat(rows, outputs), v)[:, : None if noise else n + n_f]
    found = ca.which_depends(ca.vec(slopes), v[:n], 1, False)
    return np.array(found, dtype=bool).reshape(-1)


def covered_inputs(plant: Plant) -> BoolArray:
    """Return which inputs have to stay in their range: those that enter in no constant way."""
    v, known, rows, outputs, _ = symbols(plant)
    n_u = len(plant.u)
    slopes = ca.jacobian(ca.vertcat(rows, outputs), known[:n_u])
    everything = ca.vertcat(v, known)
    return np.array(
        [bool(ca.depends_on(ca.SX(slopes[:, k]), everything)) for k in range(n_u)], dtype=bool
    )


def _known_box(plant: Plant, rows: ca.SX, v: ca.SX, known: ca.SX) -> FloatArray:
    """Return the ranges of (u, theta); inputs that enter with constant factors need none."""
    measured = [k for k, signal in enumerate(plant.rho) if signal.measured]
    u = np.where(covered_inputs(plant)[:, None], plant.box("u").reshape(-1, 2), [-np.inf, np.inf])
    return np.vstack([u.reshape(-1, 2), plant.box("rho").reshape(-1, 2)[measured]])
