"""Contraction over the equations in both directions, of two instants at a time.

With v = (x, f, rest) of the instant before and v' of this one: docs/step.md, The contractor, 6.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca

from obsynth.designs.core.backward import contract
from obsynth.designs.core.boxes import Ends
from obsynth.designs.core.contractor import SWEEPS, Contractor
from obsynth.designs.core.equations import Before
from obsynth.designs.core.outwards import Lifted
from obsynth.symbolic.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class Pair:
    """Boxes of the instant before and of this one; empty: 1 where the readings contradict them."""

    before: Before
    now: Before
    empty: ca.SX


class Sweeps:
    """What the equations say in both directions, by rows, ranges and rates of a contractor."""

    def __init__(self, contractor: Contractor) -> None:
        self.contractor = contractor
        self.equations = contractor.equations
        self.rounding = contractor.rounding
        self.n, self.n_f = self.equations.n, self.equations.n_f

    @cached_property
    def declared(self) -> FloatArray:
        """Ranges of the rest, (n_rest, 2)."""
        return self.equations.box[self.n + self.n_f :]

    @cached_property
    def constant(self) -> list[int]:
        """Places of the parameters in the rest that do not change."""
        plant = self.contractor.plant
        start = len(plant.d) + len(plant.w)
        return [start + k for k, s in enumerate(plant.p) if s.constant]

    @cached_property
    def carried(self) -> list[int]:
        """Places in the rest of what is remembered."""
        first = self.n + self.n_f
        in_rows = {j for _, j in self.equations.entries}
        both = {j - first for j in in_rows & self.equations.shown if j >= first}
        return sorted(both | set(self.constant))

    def rest(self, lower: ca.SX, upper: ca.SX) -> Ends:
        """Return the rest of the instant before: what was remembered, ranges of all else."""
        found = Ends.of(self.declared, self.contractor.precision)
        low, high = ca.SX(found.lower), ca.SX(found.upper)
        for k, j in enumerate(self.carried):
            low[j], high[j] = lower[k], upper[k]
        return Ends(low, high)

    def kept(self, rest: Ends) -> Ends:
        """Return what is remembered of the rest."""
        lower, upper = ([end[j] for j in self.carried] for end in (rest.lower, rest.upper))
        return Ends(ca.vertcat(ca.SX(0, 1), *lower), ca.vertcat(ca.SX(0, 1), *upper))

    def run(
        self, before: Before, now: Before, have: ca.SX, y: ca.SX, used: Sequence[ca.SX]
    ) -> Pair:
        """Cut the boxes of two instants with equations and readings; have: 1 if there were two."""
        now = replace(now, rest=self._still(before, now))
        empty = ca.SX(0)
        for _ in range(SWEEPS):
            now, wrong = self._shown(now, y, used)
            back, against = self._moved(before, now)
            before = back.where(have, before)
            empty = ca.logic_or(empty, ca.logic_or(wrong, ca.logic_and(have, against)))
            image = now.states
            if "image" in self.contractor.cuts:
                image = image.meet(self.contractor.image(before)).where(have, image)
            faults = now.faults.meet(self.contractor.drift(before.faults)).where(have, now.faults)
            now = Before(image, faults, now.known, self._still(before, now))
        return Pair(before, now, empty)

    def _still(self, before: Before, now: Before) -> Ends:
        """Return the rest of this instant, parameters cut with what is remembered of them."""
        low, high = ca.SX(now.rest.lower), ca.SX(now.rest.upper)
        met = now.rest.meet(before.rest)
        for j in self.constant:
            low[j], high[j] = met.lower[j], met.upper[j]
        return Ends(low, high)

    def _shown(self, now: Before, y: ca.SX, used: Sequence[ca.SX]) -> tuple[Before, ca.SX]:
        """Cut with the readings."""
        program = self.equations.outputs
        told, far = {}, self.rounding.limits.far
        for i, node in enumerate(program.outputs):
            if node not in program.constants:
                low, high = ca.if_else(used[i], y[i], -far), ca.if_else(used[i], y[i], far)
                told[node] = Lifted(low, high)
        variables = self.equations.variables(now)
        found, empty = contract(program, told, variables, self.rounding)
        return self._read(found, now), empty

    def _moved(self, before: Before, now: Before) -> tuple[Before, ca.SX]:
        """Cut the instant before with where the states are now, and its faults with theirs."""
        program = self.equations.program
        told = {}
        for i in range(self.n):
            node = program.outputs[i]
            if self.equations.small[i] and node not in program.constants:
                told[node] = Lifted(now.states.lower[i], now.states.upper[i])
        variables = self.equations.variables(before)
        found, empty = contract(program, told, variables, self.rounding)
        cut = self._read(found, before)
        return replace(cut, faults=cut.faults.meet(self.contractor.drift(now.faults))), empty

    def _read(self, variables: Sequence[Lifted], given: Before) -> Before:
        """Take variables apart into states, faults and rest."""
        lower = ca.vertcat(*(v.lower for v in variables))
        upper = ca.vertcat(*(v.upper for v in variables))
        n, n_f, n_v = self.n, self.n_f, self.equations.n_v
        parts = [Ends(lower[a:b], upper[a:b]) for a, b in ((0, n), (n, n + n_f), (n + n_f, n_v))]
        return Before(parts[0], parts[1], given.known, parts[2])
