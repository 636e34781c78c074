"""The assembled step: readings, two copies of the sets, what is returned and what is remembered."""

from dataclasses import replace

import casadi as ca
import numpy as np

from obsynth.designs.core.backward import Pair
from obsynth.designs.core.boxes import Ends, column, every, select, some
from obsynth.designs.core.core import Core, Known, Parts, Seen
from obsynth.designs.core.equations import Before, covered_inputs
from obsynth.designs.core.guard import YOUNG, Guard
from obsynth.designs.core.stepping import (
    all_finite,
    could_be_written,
    finite_or,
    inside,
    make_step,
    status_word,
)
from obsynth.symbolic.arrays import FloatArray


class _Copy:
    """What one of the two copies of sets and bounds holds at an instant."""

    def __init__(
        self,
        X: Ends,
        now: Ends,
        late: Ends,
        shown: Ends,
        known: Known,
        again: ca.SX,
        told: ca.SX,
        pair: Pair,
        written: ca.SX,
    ) -> None:
        self.X, self.now, self.late, self.shown, self.known = X, now, late, shown, known
        self.again, self.told, self.rest = again, told, pair.now.rest
        self.empty = ca.logic_or(ca.logic_and(told, known.empty), pair.empty)
        self.empty = ca.logic_or(self.empty, ca.logic_not(written))
        for box in (X, now, late, shown):
            self.empty = ca.logic_or(self.empty, box.empty())


class Step:
    """The symbols of one step and what is made of them."""

    def __init__(self, guard: Guard, core: Core) -> None:
        plant = guard.plant
        self.guard, self.core, self.plant = guard, core, plant
        self.contractor = guard.contractor
        x_box, f_box = plant.box("x"), plant.box("f").reshape(-1, 2)
        own = self.contractor.domain if core.domain is None else core.domain
        self.domain = np.column_stack(
            [
                np.maximum(self.contractor.domain[:, 0], own[:, 0]),
                np.minimum(self.contractor.domain[:, 1], own[:, 1]),
            ]
        )
        self.precision, self.limits = guard.precision, self.contractor.rounding.limits
        self.reset = self._box(x_box), self._box(f_box)
        self.ranges = self._box(self.domain), self.reset[1]
        if "ranges" not in self.contractor.cuts:
            self.ranges = self._open(len(x_box)), self._open(len(f_box))
        self.layout = guard.layout()
        self.memory = ca.SX.sym("memory", self.layout["initialised"].stop)
        self.u, self.y = ca.SX.sym("u", len(plant.u)), ca.SX.sym("y", len(plant.output_names))
        self.theta = ca.SX.sym("theta", sum(s.measured for s in plant.rho))
        empty = ca.SX(0, 1)
        self.part = {name: self.memory[place] for name, place in self.layout.items()}
        for name in (*guard.sizes, "f_lower", "f_upper", "rest_lower", "rest_upper", "before"):
            for key in (name, name + YOUNG):
                self.part.setdefault(key, empty)
        finite = self.limits.finite
        self.finite = ca.logic_and(all_finite(self.u, finite), all_finite(self.theta, finite))
        self.u_used, self.theta_used, self.covered = self._signals()
        self.used, self.left_out, self.impossible = self._readings()

    def _box(self, box: FloatArray) -> Ends:
        return Ends.of(box, self.precision)

    def _open(self, n: int) -> Ends:
        return Ends.unbounded(n, self.precision)

    def _signals(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Make inputs and scheduling finite, and tell whether they are covered: in their ranges.

        Inputs that enter with constant factors need no range: their size does not matter.
        """
        plant = self.plant
        measured = [s for s in plant.rho if s.measured]
        nominal = [0.0 if s.nominal is None else float(s.nominal) for s in plant.u]
        middle = [0.5 * (s.lower + s.upper) if s.bounded else 0.0 for s in measured]
        finite = self.limits.finite
        u, theta = finite_or(self.u, nominal, finite), finite_or(self.theta, middle, finite)
        matters = covered_inputs(plant).tolist()
        held = [(u[i], s) for i, s in enumerate(plant.u) if matters[i]]
        pairs = [(theta[i], s) for i, s in enumerate(measured)] + held
        boxes = np.array([(s.lower, s.upper) for _, s in pairs]).reshape(-1, 2)
        values = column(value for value, _ in pairs)
        covered = inside(values, values, boxes, self.precision)
        return u, theta, covered

    def _readings(self) -> tuple[list[ca.SX], ca.SX, ca.SX]:
        """Tell which readings are used, whether one is not, and whether one is impossible."""
        declared, shown = self.plant.output_ranges, self.contractor.shown(self.domain)
        used, left_out, impossible = [], ca.SX(0), ca.SX(0)
        for i in range(self.y.numel()):
            finite = ca.fabs(self.y[i]) <= self.limits.finite
            own = bool(np.isfinite(declared[i]).any())
            low, high = declared[i] if own else shown[i]
            fits = ca.logic_and(self.y[i] >= low, self.y[i] <= high)
            used.append(ca.logic_and(finite, fits))
            left_out = ca.logic_or(left_out, ca.logic_not(used[-1]))
            if not own:
                impossible = ca.logic_or(impossible, ca.logic_and(finite, ca.logic_not(fits)))
        return used, left_out, impossible

    def _kept(self, copies: tuple[ca.SX, ca.SX], boxes: tuple[Ends, Ends]) -> dict[str, ca.SX]:
        """Return the estimates, placed anew where both copies begin and they are of no use."""
        kept = {name: self.part[name] for name in self.guard.shared}
        if self.core.place is None:
            return kept
        X, F = self._declared(boxes[0]), self._faults(boxes[1])
        placed = self.core.place(X, F, kept)
        both = ca.logic_and(*copies)
        return {name: select(both, placed[name], kept[name]) for name in kept}

    def _sets(self, end: str, have: ca.SX) -> Pair:
        """Return the sets of this instant and the one before, before the core is asked."""
        contractor, part = self.contractor, self.part
        F = Ends(part["f_lower" + end], part["f_upper" + end])
        stored = self.reset[0]
        if self.guard.discrete:
            stored = Ends(part["x_lower" + end], part["x_upper" + end])
        before = Before(stored, F, part["before"])
        X = self.ranges[0]
        if self.guard.discrete and "image" in contractor.cuts:
            X = X.meet(contractor.image(before))
        X = X.where(have, self._box(self.domain).meet(stored))
        X = contractor.measure(X, self.y, self.used)
        now = contractor.drift(F).meet(self.ranges[1]).where(have, F)
        known = ca.vertcat(self.u_used, self.theta_used)
        sweeps = self.guard.sweeps
        if sweeps is None:
            return Pair(before, Before(X, now, known), ca.SX(0))
        rest = sweeps.rest(part["rest_lower" + end], part["rest_upper" + end])
        here = Before(X, now, known, self._box(sweeps.declared))
        return sweeps.run(replace(before, rest=rest), here, have, self.y_clean, self.used)

    def _declared(self, X: Ends) -> Ends:
        """Return a set with declared ranges in place of ends that nothing bounds."""
        rows, huge, (declared, _) = range(X.lower.numel()), self.limits.huge, self.reset
        lower = [ca.if_else(X.lower[i] > -huge, X.lower[i], declared.lower[i]) for i in rows]
        upper = [ca.if_else(X.upper[i] < huge, X.upper[i], declared.upper[i]) for i in rows]
        return Ends(ca.vertcat(*lower), ca.vertcat(*upper))

    def _shown(self, ends: ca.SX, sign: float) -> ca.SX:
        """Write infinity for ends that are none."""
        far = 0.5 * self.limits.far
        rows = range(ends.numel())
        return column(ca.if_else(sign * ends[i] > far, sign * ca.inf, ends[i]) for i in rows)

    def _faults(self, F: Ends) -> Ends:
        """Return faults within their ranges, which a core begins from even if they are no cut."""
        return F if "ranges" in self.contractor.cuts else F.meet(self.reset[1])

    def _copy(self, end: str, have: ca.SX, pair: Pair, kept: Parts) -> _Copy:
        """Run the core of one copy on its sets."""
        core, contractor, delay = self.core, self.contractor, self.guard.delay
        X, now, before = pair.now.states, pair.now.faults, pair.before
        names = [name for name in self.guard.sizes if name not in self.guard.shared]
        own = {name: self.part[name + end] for name in names}
        begins = self.part["begin" + end] > 0.5
        X = self._declared(X).where(begins, X)
        begun = core.begin(X, self._faults(now), kept)
        signals = self.u_used, self.theta_used, self.y_clean, self.used, pair
        if core.advance is not None:
            own = {**core.advance(Seen({**kept, **own}, *signals))}
        own = {name: select(begins, begun[name], own[name]) for name in names}
        boxes = {name: self.part[name + end] for name in self.guard.boxes}
        written = could_be_written({**kept, **own, **boxes}, core.nonnegative, self.guard.precision)
        seen = Seen({**kept, **own}, *signals)
        known = core.run(seen)
        told = ca.SX(1) if core.bridges else seen.all_used
        huge = ca.SX(0)
        if known.x is not None:
            widths = ca.vertsplit(known.x.upper - known.x.lower)
            huge = some(ca.logic_not(width < self.limits.huge) for width in widths)
            X = X.meet(known.x).where(told, X)
        late = before.faults
        if self.guard.discrete:
            late = contractor.invert(before, X).where(have, late)
        if known.f is not None and delay:
            late = late.meet(known.f).where(told, late)
        now = now.meet(contractor.drift(late)).where(have, now)
        shown = late if delay else now
        if known.f is not None and not delay:
            shown = now.meet(known.f).where(told, now)
            now = now if core.mean_fault else shown
        again = ca.logic_or(ca.logic_not(ca.logic_and(told, known.sound)), huge)
        return _Copy(X, now, late, shown, known, again, told, pair, written)

    @property
    def y_clean(self) -> ca.SX:
        """The readings, zero where they are not used."""
        return ca.vertcat(*(ca.if_else(bit, self.y[i], 0.0) for i, bit in enumerate(self.used)))

    def _turns(self, age: ca.SX) -> ca.SX:
        """Return 1 where the younger copy begins, at one of the ages of any row of them."""
        N = float(self.guard.horizon)
        return ca.logic_and(age >= N - 0.5, age < N + 0.5)

    @property
    def _counts(self) -> ca.SX:
        """1 where a step can have written the counters and what is known of the call before."""
        limits = {"age": 2.0 * self.guard.horizon - 0.5, "since": self.guard.watch.recovery + 0.5}
        counts = [(self.part[name], limit) for name, limit in limits.items()]
        held = every(ca.logic_and(count >= 0.0, count <= limit) for count, limit in counts)
        return ca.logic_and(held, all_finite(self.part["before"], self.limits.finite))

    def build(self) -> ca.Function:
        """Assemble the function."""
        age = self.part["age"]
        have = age > 0.5
        both = have, ca.logic_and(have, ca.logic_not(self._turns(age)))
        sets = [self._sets(end, one) for end, one in zip(("", YOUNG), both, strict=True)]
        begins = self.part["begin"] > 0.5, self.part["begin" + YOUNG] > 0.5
        kept = self._kept(begins, (sets[0].now.states, sets[0].now.faults))
        old, young = (
            self._copy(end, one, found, kept)
            for end, one, found in zip(("", YOUNG), both, sets, strict=True)
        )
        X = old.X.meet(young.X)
        # means over the memories of two copies need not have anything in common
        shown = old.shown if self.core.mean_fault else old.shown.meet(young.shown)
        empty = ca.logic_or(
            ca.logic_or(old.empty, young.empty), ca.logic_or(X.empty(), shown.empty())
        )
        one = self.part["initialised"]
        initialised = ca.logic_and(one > 0.5, one < 1.5)
        contradicted = ca.logic_or(empty, ca.logic_or(self.impossible, ca.logic_not(self._counts)))
        void = ca.logic_and(initialised, contradicted)
        F = shown.where(have, self.reset[1]) if self.guard.delay else shown
        X, F = self._returned(X, 0, void, initialised), self._returned(F, 1, void, initialised)
        moved = self._moved(old, young, void)
        memory = ca.vertcat(*(moved[name] for name in self.layout))
        inputs = {"memory": self.memory, "u": self.u, "y": self.y}
        if self.theta.numel():
            inputs["theta"] = self.theta
        # without a reading that its core needs an estimate is no more than the middle of a set
        xhat = select(old.told, old.known.xhat, X.middle(self.precision))
        fhat = select(old.told, old.known.fhat, F.middle(self.precision))
        outputs = {
            "memory_next": select(initialised, memory, self.memory),
            # estimates of a core without sets are promised for states and faults of any size
            "xhat": old.known.xhat if old.known.x is None else X.nearest(xhat),
            "fhat": old.known.fhat if old.known.f is None else F.nearest(fhat),
            "x_lower": self._shown(X.lower, -1.0),
            "x_upper": self._shown(X.upper, 1.0),
            "f_lower": self._shown(F.lower, -1.0),
            "f_upper": self._shown(F.upper, 1.0),
            "status": self._status(initialised, void, have, F, old.known),
        }
        return make_step(self.plant, inputs, outputs)

    def _returned(self, box: Ends, kind: int, void: ca.SX, initialised: ca.SX) -> Ends:
        """Return a set, the declared ranges where it is void, everything before the first call."""
        everything = self._open(box.lower.numel())
        return self.reset[kind].where(void, box).where(initialised, everything)

    def _moved(self, old: _Copy, young: _Copy, void: ca.SX) -> dict[str, ca.SX]:
        """Return the parts of the next memory."""
        N, age = float(self.guard.horizon), self.part["age"] + 1.0
        going = ca.logic_and(ca.logic_not(void), ca.logic_and(self.finite, self.covered))
        over = age >= 2.0 * N - 0.5
        turn = ca.logic_or(over, self._turns(age))
        moved: dict[str, ca.SX] = {}
        for name in self.guard.sizes:
            mine, other = old.known.moved[name], young.known.moved[name]
            moved[name] = mine if name in self.guard.shared else select(over, other, mine)
            moved[name + YOUNG] = other
        carried = {"f": (old.now, young.now, self.reset[1])}
        if self.guard.discrete:
            carried["x"] = (old.X, young.X, self.reset[0])
        if (sweeps := self.guard.sweeps) is not None:
            rests = sweeps.kept(old.rest), sweeps.kept(young.rest)
            carried["rest"] = (*rests, sweeps.kept(self._box(sweeps.declared)))
        for name, (first, second, reset) in carried.items():
            fresh = second.where(ca.logic_and(going, ca.logic_not(turn)), reset)
            kept = second.where(over, first).where(going, reset)
            for end, box in (("", kept), (YOUNG, fresh)):
                moved[f"{name}_lower{end}"], moved[f"{name}_upper{end}"] = box.lower, box.upper
        stopped = ca.logic_not(going)
        moved["begin"] = ca.logic_or(stopped, ca.if_else(over, young.again, old.again))
        moved["begin" + YOUNG] = ca.logic_or(stopped, ca.logic_or(turn, young.again))
        moved["before"] = ca.vertcat(self.u_used, self.theta_used)
        moved["age"] = ca.if_else(going, ca.if_else(over, N, age), 0.0)
        recovery = float(self.guard.watch.recovery)
        since = ca.fmin(self.part["since"] + 1.0, recovery)
        moved["since"] = ca.if_else(void, 0.0, since)
        moved["initialised"] = ca.SX(1)
        return moved

    def _status(self, initialised: ca.SX, void: ca.SX, have: ca.SX, F: Ends, known: Known) -> ca.SX:
        """Return the status word."""
        unknown = ca.logic_not(known.valid)
        if self.guard.delay:
            unknown = ca.logic_or(unknown, ca.logic_not(have))
        for j in range(F.lower.numel() if known.f is not None else 0):
            unknown = ca.logic_or(unknown, F.lower[j] < -0.5 * self.limits.far)
            unknown = ca.logic_or(unknown, F.upper[j] > 0.5 * self.limits.far)
        outside = known.outside
        if known.x is None:
            # nothing else bounds these estimates, and what is beyond counts as no number
            outside = ca.logic_or(outside, ca.logic_not(all_finite(known.xhat, self.limits.finite)))
            unknown = ca.logic_or(unknown, ca.logic_not(all_finite(known.fhat, self.limits.finite)))
        recovering = self.part["since"] < self.guard.watch.recovery - 0.5
        out = ca.logic_or(ca.logic_not(self.covered), ca.logic_and(outside, ca.logic_not(void)))
        return status_word(
            {
                "not_initialised": ca.logic_not(initialised),
                "non_finite_input": ca.logic_not(self.finite),
                "outside_domain": out,
                "void": void,
                "fault_not_valid": unknown if F.lower.numel() else ca.SX(0),
                "measurement_left_out": self.left_out,
                "recovering": ca.logic_and(
                    initialised, ca.logic_and(ca.logic_not(void), recovering)
                ),
            }
        )
