"""What runs: a bank of zonotopes between the boxes that the sweeps leave.

All hold z = (x, faults that are followed): docs/methods/set_membership_observer.md, Step.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from obsynth.designs.core.backward import Sweeps
from obsynth.designs.core.boxes import LIMITS, Ends, every, select
from obsynth.designs.core.contractor import Contractor
from obsynth.designs.core.core import Core, Known, Parts, Seen
from obsynth.designs.core.equations import Before
from obsynth.designs.core.given import Start
from obsynth.designs.core.guard import Watch
from obsynth.designs.general import step as general
from obsynth.designs.general.record import GeneralDesign
from obsynth.designs.set_membership.enclosure import Enclosures, middle_of
from obsynth.designs.set_membership.record import SetMembershipDesign
from obsynth.designs.set_membership.zonotope import (
    Real,
    Strips,
    Zonotope,
    corrected,
    cut,
    reduced,
)
from obsynth.symbolic.arrays import FloatArray

FRESH = -1
"""Among the zonotopes of an instant, the one that comes from the box of the instant before."""
LEAST_CALLS = 40
"""For which a copy of the sets is kept at least."""


def memory_sizes(design: SetMembershipDesign) -> dict[str, int]:
    """Return the parts of the memory: middle and generators of every zonotope, and the clock."""
    N, K = len(design.V), design.columns
    parts: dict[str, int] = {}
    for j in range(1 + design.zonotopes):
        parts |= {f"c{j}": N, f"G{j}": N * K}
    inner = {} if design.peak is None else {**general.memory_sizes(design.peak), "anew": 1}
    return {**parts, "clock": 1, **inner}


def shared(design: SetMembershipDesign) -> tuple[str, ...]:
    """Return the part that estimates are made of, the prediction of the peak bounds."""
    return () if design.peak is None else ("prediction",)


def first_memory(design: SetMembershipDesign, start: Start) -> dict[str, ArrayLike]:
    """Begin from the first sets, the prediction at the guess."""
    nothing = {name: np.zeros(size) for name, size in memory_sizes(design).items()}
    return nothing | ({} if design.peak is None else {**general.first_memory(design.peak, start)})


def settling(
    design: SetMembershipDesign, box: FloatArray, calls: int | None = None
) -> tuple[int, FloatArray] | None:
    """Return how many calls the sets take to settle, and the peak bounds then; None without any."""
    if design.peak is None:
        return None if np.isfinite(box).all() else (0, np.full(box.shape, np.inf))
    own = max(LEAST_CALLS, design.restart + design.settles) if calls is None else calls
    found = general.settling(design.peak, box, calls)
    assert found is not None
    if calls is None and found[0] < own and np.isfinite(found[1]).any():
        found = general.settling(design.peak, box, own)
        assert found is not None
    return found[0], late(design, found[1])


def peak_widths(design: SetMembershipDesign, peak: GeneralDesign) -> FloatArray:
    """Return the steady half widths that the peak bounds guarantee, (n + n_f,)."""
    return late(design, general.steady(peak))


def rates_of(design: SetMembershipDesign) -> FloatArray:
    """Return what every fault moves at most in a call, (n_f,)."""
    return Bank(design).enclosures.sweeps.contractor.rates


def late(design: SetMembershipDesign, widths: FloatArray) -> FloatArray:
    """Add the rates of faults to half widths where they are told one call late."""
    found = widths.copy()
    n = len(design.plant.x)
    if fault_delay(design):
        found[n:] += rates_of(design)
    return found


def fault_delay(design: SetMembershipDesign) -> int:
    """Return 1 where a fault has no rate that says more than its range."""
    return int(len(design.followed) < len(design.plant.f))


@dataclass(frozen=True, eq=False)
class Bank:
    """The zonotopes of a design in code, and its peak bounds."""

    design: SetMembershipDesign

    @cached_property
    def inner(self) -> Core | None:
        """The observer with peak bounds."""
        return None if self.design.peak is None else general.build_core(self.design.peak)

    @cached_property
    def enclosures(self) -> Enclosures:
        """Affine enclosures of the equations."""
        plant, watch = self.design.plant, Watch.of(self.design.options)
        assert plant.Ts is not None
        sweeps = Sweeps(Contractor(plant, plant.Ts, watch.cuts, watch.precision))
        return Enclosures(sweeps, self.design.places)

    @property
    def far(self) -> float:
        """The end of what has no bound."""
        return LIMITS[self.design.precision].far

    def open(self, n: int) -> Ends:
        """Return a box that holds everything."""
        return Ends.unbounded(n, self.design.precision)

    @cached_property
    def real(self) -> Real:
        """What rounding takes of sums over the columns of a zonotope."""
        return Real(self.design.precision, self.wide + len(self.design.plant.output_names))

    @property
    def names(self) -> list[int]:
        """Numbers of the zonotopes; the first is the one that is corrected."""
        return [*range(1 + self.design.zonotopes)]

    @property
    def N(self) -> int:
        """Coordinates of a zonotope."""
        return self.enclosures.size

    @property
    def wide(self) -> int:
        """Columns of a zonotope before its readings."""
        return self.design.columns + self.N + len(self.enclosures.alone)

    def box(self, x: Ends, f: Ends) -> Ends:
        """Return the box of z."""
        places = self.enclosures.followed.tolist()
        lower, upper = ([end[j] for j in places] for end in (f.lower, f.upper))
        return Ends(ca.vertcat(x.lower, *lower), ca.vertcat(x.upper, *upper))

    def inside(self, now: Before, X: Ends) -> Before:
        """Return the boxes of an instant with that of z in place of states and followed faults."""
        n = self.enclosures.sweeps.n
        low, high = ca.SX(now.faults.lower), ca.SX(now.faults.upper)
        for k, j in enumerate(self.enclosures.followed.tolist()):
            low[j], high[j] = X.lower[n + k], X.upper[n + k]
        states = Ends(X.lower[:n], X.upper[:n])
        return Before(states, Ends(low, high), now.known, now.rest)

    def parts(self, found: Mapping[int, Zonotope], clock: ca.SX) -> dict[str, ca.SX]:
        """Return zonotopes as parts of a memory."""
        parts: dict[str, ca.SX] = {}
        for j, z in found.items():
            parts |= {f"c{j}": z.centre, f"G{j}": ca.vec(ca.densify(z.generators))}
        return parts | {"clock": clock}

    def read(self, memory: Parts) -> dict[int, Zonotope]:
        """Return the zonotopes of a memory."""
        none, N = ca.SX(self.N, 1), self.N
        found = {}
        for j in self.names:
            generators = ca.reshape(memory[f"G{j}"], N, memory[f"G{j}"].numel() // N)
            found[j] = Zonotope(memory[f"c{j}"], generators, none, self.real)
        return found

    def begin(self, x: Ends, f: Ends, kept: Parts) -> Parts:
        """Begin every zonotope from a box."""
        z = Zonotope.of(self.box(x, f), self.wide, self.real)
        found = self.parts(dict.fromkeys(self.names, z), ca.SX(0))
        if self.inner is None:
            return found
        return {**found, **self.inner.begin(x, f, kept), "anew": ca.SX(0)}

    def place(self, x: Ends, f: Ends, kept: Parts) -> Parts:
        """Place the prediction of the peak bounds in boxes."""
        place = None if self.inner is None else self.inner.place
        return kept if place is None else place(x, f, kept)

    def peak(self, seen: Seen) -> tuple[Ends, dict[str, ca.SX]]:
        """Return the box of the peak bounds and their memory; after a gap they begin anew."""
        assert self.inner is not None
        assert seen.around is not None
        now, memory = seen.around.now, dict(seen.memory)
        begun = self.inner.begin(now.states, now.faults, memory)
        for name, value in begun.items():
            memory[name] = select(memory["anew"] > 0.5, value, memory[name])
        known = self.inner.run(replace(seen, memory=memory))
        assert known.x is not None
        f = (
            Ends.unbounded(now.faults.lower.numel(), self.design.precision)
            if known.f is None
            else known.f
        )
        held = self.box(known.x, f)
        nothing = self.open(self.N)
        told = seen.all_used
        width = held.upper - held.lower
        near = every(width[i] < 0.5 * self.far for i in range(self.N))
        sound = ca.logic_and(ca.logic_and(told, known.sound), near)
        return held.where(told, nothing), {**known.moved, "anew": ca.logic_not(sound)}

    def advance(self, seen: Seen) -> Parts:
        """Move every zonotope by the equations, enclosed over what is known of the call before."""
        assert seen.around is not None
        rows = self.enclosures.rows(seen.around.before)
        found = {j: rows.applied(z) for j, z in self.read(seen.memory).items()}
        parts = self.parts(found, seen.memory["clock"] + 1.0)
        own = [name for name in seen.memory if name not in parts]
        return {**parts, **{name: seen.memory[name] for name in own}}

    def fresh(self, seen: Seen) -> Zonotope:
        """Return the image of the box that is left of the instant before."""
        assert seen.around is not None
        before = seen.around.before
        z = Zonotope.of(self.box(before.states, before.faults), self.N, self.real)
        return self.enclosures.rows(before).applied(z)

    def run(self, seen: Seen) -> Known:
        """Cut, correct and reduce every zonotope."""
        assert seen.around is not None
        design, now = self.design, seen.around.now
        found, used = self.read(seen.memory), ca.vertcat(*seen.used)
        X = self.box(now.states, now.faults)
        inner: dict[str, ca.SX] = {}
        if self.inner is not None:
            held, inner = self.peak(seen)
            X = X.meet(held)
        for z in found.values():
            X = X.meet(z.hull)
        here = self.inside(now, X)
        shown = self.enclosures.outputs(here)
        strips, after = {}, {}
        clock = seen.memory["clock"]
        for j, z in {**found, FRESH: self.fresh(seen)}.items():
            strips[j] = Strips.read(z, shown.H, seen.y - shown.offset, shown.sigma, used)
            if j:
                told = cut(z, strips[j], used)
                # sets that begin at this instant have none of the one before
                new = clock > 0.5 if j == FRESH else ca.SX(1)
                X = X.meet(told.where(new, X))
        after[0] = corrected(found[0], ca.sparsify(ca.SX(ca.DM(design.L))), strips[0], used)
        X = X.meet(after[0].hull)
        empty = X.empty()
        for j, strip in strips.items():
            wrong = strip.against
            empty = ca.logic_or(empty, ca.logic_and(wrong, clock > 0.5) if j == FRESH else wrong)
        keep = design.columns - self.N
        kept = {0: reduced(after[0], keep, design.frame)}
        for j in self.names[1:]:
            again = ca.fabs(clock - float(design.turns[j - 1])) < 0.5
            fresh = Zonotope.of(X, design.columns, self.real)
            old = reduced(found[j], keep, design.frame)
            kept[j] = Zonotope(
                select(again, fresh.centre, old.centre),
                ca.reshape(
                    select(again, ca.vec(ca.densify(fresh.generators)), ca.vec(old.generators)),
                    self.N,
                    design.columns,
                ),
                old.slack,
                self.real,
            )
        over = clock > design.restart - 0.5
        memory = {**self.parts(kept, ca.if_else(over, 0.0, clock)), **inner}
        x, f, fhat = self._told(seen, strips, X, used)
        n = self.enclosures.sweeps.n
        return Known(after[0].centre[:n], fhat, x, f, memory, empty=empty)

    def _told(
        self,
        seen: Seen,
        strips: Mapping[int, Strips],
        X: Ends,
        used: ca.SX,
    ) -> tuple[Ends, Ends, ca.SX]:
        """Return sets of states and faults, and estimates; faults not followed one call late."""
        assert seen.around is not None
        sweeps, enclosures = self.enclosures.sweeps, self.enclosures
        n, n_f = sweeps.n, sweeps.n_f
        x = Ends(X.lower[:n], X.upper[:n])
        f = self.open(n_f)
        low, high, fhat = ca.SX(f.lower), ca.SX(f.upper), ca.SX(n_f, 1)
        late = float(fault_delay(self.design))
        for k, j in enumerate(enclosures.followed.tolist()):
            rate = late * float(sweeps.contractor.rates[j])
            low[j] = sweeps.rounding.down(X.lower[n + k] - rate)
            high[j] = sweeps.rounding.up(X.upper[n + k] + rate)
            fhat[j] = 0.5 * (X.lower[n + k] + X.upper[n + k])
        fresh = seen.memory["clock"] > 0.5
        for k, j in enumerate(enclosures.free):
            faults = seen.around.before.faults
            middle, radius = middle_of(faults.lower[j], faults.upper[j], self.real)
            told = Ends(faults.lower[j], faults.upper[j])
            for strip in strips.values():
                row = ca.SX(1, strip.seen.shape[1])
                row[0, k] = radius
                own = Zonotope(middle, row, ca.SX(1, 1), self.real)
                told = told.meet(cut(own, strip, used))
            low[j] = ca.if_else(fresh, told.lower, -self.far)
            high[j] = ca.if_else(fresh, told.upper, self.far)
            fhat[j] = middle
        return x, Ends(low, high), fhat


def build_core(design: SetMembershipDesign) -> Core:
    """Build the bank."""
    bank = Bank(design)
    place, domain = (None, None) if bank.inner is None else (bank.place, bank.inner.domain)
    signs = ("bound", "clock")
    return Core(bank.run, bank.begin, place, domain, True, advance=bank.advance, nonnegative=signs)
