"""The equations over boxes, enclosed by affine functions of what a zonotope carries.

docs/methods/set_membership_observer.md, Step, 2: beside z, what enters several rows and every free
fault is a generator of its own.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from obsynth.derive.intervals.program import Program
from obsynth.designs.core.backward import Sweeps
from obsynth.designs.core.contractor import Contractor
from obsynth.designs.core.equations import Before
from obsynth.designs.core.relaxation import Affine, relax
from obsynth.designs.set_membership.zonotope import DOUBLE, Real, Zonotope, moved
from obsynth.symbolic.arrays import IntArray


@dataclass(frozen=True, eq=False)
class Rows:
    """``z+ = J z + offset + columns xi + eta``, |xi| <= 1, |eta| <= spread; N rows."""

    J: ca.SX
    offset: ca.SX
    columns: Sequence[ca.SX]
    spread: ca.SX

    def applied(self, z: Zonotope) -> Zonotope:
        """Return the image of a zonotope."""
        return moved(z, self.J, self.offset, self.columns, self.spread)


@dataclass(frozen=True, eq=False)
class Shown:
    """``y = H z + offset + eta``, |eta| <= sigma; m rows."""

    H: ca.SX
    offset: ca.SX
    sigma: ca.SX


@dataclass(frozen=True, eq=False)
class Enclosures:
    """Affine enclosures of a plant's rows and outputs; followed: places of faults in z."""

    sweeps: Sweeps
    followed: IntArray

    @property
    def size(self) -> int:
        """N, of z."""
        return self.sweeps.n + len(self.followed)

    @property
    def real(self) -> Real:
        """What rounding takes of sums over all variables."""
        return Real(self.sweeps.rounding.precision, 2 * self.sweeps.equations.n_v)

    @cached_property
    def place(self) -> Mapping[int, int]:
        """Which variable of the equations is which coordinate of z."""
        n = self.sweeps.n
        return {i: i for i in range(n)} | {n + int(j): n + k for k, j in enumerate(self.followed)}

    @cached_property
    def free(self) -> list[int]:
        """Places of the faults that are not followed."""
        return [j for j in range(self.sweeps.n_f) if j not in self.followed]

    @cached_property
    def alone(self) -> list[int]:
        """Variables beside z with a generator of their own: free faults, then what enters more."""
        n, entries = self.sweeps.n, self.sweeps.equations.entries
        faults = [n + j for j in self.free]
        rows = {j: sum(v == j for _, v in entries) for j in range(n, self.sweeps.equations.n_v)}
        shared = [j for j, count in rows.items() if count > 1]
        return faults + [j for j in shared if j not in self.place and j not in faults]

    def rows(self, before: Before) -> Rows:
        """Enclose the next z over the boxes of an instant."""
        program, n, N = self.sweeps.equations.program, self.sweeps.n, self.size
        J, columns = ca.SX(N, N), {j: ca.SX(N, 1) for j in self.alone}
        offset, spread = [], []
        found = self._forms(program, program.outputs[:n], before)
        for i, (slopes, middle, reach, own) in enumerate(found):
            J[i, :] = slopes
            for j, value in own.items():
                columns[j][i] = value
            offset.append(middle)
            spread.append(reach)
        rates = self.sweeps.contractor.rates
        for k, j in enumerate(self.followed.tolist()):
            J[n + k, n + k] = 1.0
            offset.append(ca.SX(0))
            spread.append(ca.SX(float(rates[j])))
        return Rows(J, ca.vertcat(*offset), [*columns.values()], ca.vertcat(*spread))

    def outputs(self, now: Before) -> Shown:
        """Enclose the outputs over the boxes of an instant."""
        program = self.sweeps.equations.outputs
        H, offset, sigma = [], [], []
        for slopes, middle, reach, own in self._forms(program, program.outputs, now):
            H.append(slopes)
            offset.append(middle)
            sigma.append((reach + sum((ca.fabs(v) for v in own.values()), ca.SX(0))) * self.real.up)
        return Shown(ca.vertcat(*H), ca.vertcat(*offset), ca.vertcat(*sigma))

    def _forms(
        self, program: Program, nodes: Sequence[int], boxes: Before
    ) -> Iterator[tuple[ca.SX, ca.SX, ca.SX, dict[int, ca.SX]]]:
        """Yield the slopes of nodes by z, a row each, and what `_beside` says of them."""
        signal = self.sweeps.rounding.signal
        variables = [signal(v) for v in self.sweeps.equations.variables(boxes)]
        near = ((j, variables[j]) for j in self.beside)
        rest = {j: middle_of(v.lower, v.upper, self.real) for j, v in near}
        for form in relax(program, nodes, variables, self.sweeps.rounding):
            slopes = ca.SX(1, self.size)
            for j, k in self.place.items():
                if j in form.slopes:
                    slopes[k] = form.slopes[j]
            yield slopes, *self._beside(form, rest)

    @cached_property
    def beside(self) -> list[int]:
        """Variables that z does not carry."""
        return [j for j in range(self.sweeps.equations.n_v) if j not in self.place]

    def _beside(
        self, form: Affine, boxes: Mapping[int, tuple[ca.SX, ca.SX]]
    ) -> tuple[ca.SX, ca.SX, dict[int, ca.SX]]:
        """Return middle and reach of a form without z, and the generators that stand alone."""
        middle, reach, size = form.centre, form.error, ca.fabs(form.centre)
        own, terms = {}, 2
        for j, (centre, radius) in boxes.items():
            slope = form.slopes.get(j)
            if slope is None:
                continue
            terms += 1
            middle = middle + slope * centre
            size = size + ca.fabs(slope * centre) + ca.fabs(slope * radius)
            if j in self.alone:
                own[j] = slope * radius
            else:
                reach = reach + ca.fabs(slope * radius)
        real = self.real
        return middle, reach * real.up + (terms + 2) * real.step * size + real.tiny, own


def middle_of(lower: ca.SX, upper: ca.SX, real: Real = DOUBLE) -> tuple[ca.SX, ca.SX]:
    """Return a middle and a radius that hold an interval."""
    middle = 0.5 * lower + 0.5 * upper
    return middle, ca.fmax(upper - middle, middle - lower) * real.up


def told_by_rate(contractor: Contractor) -> IntArray:
    """Return the places of faults with a rate that says more than their range."""
    box = contractor.plant.box("f").reshape(-1, 2)
    rates = contractor.rates
    return np.flatnonzero(rates < box[:, 1] - box[:, 0])
