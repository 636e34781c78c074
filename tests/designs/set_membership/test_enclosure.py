"""Affine enclosures of rows and outputs hold the equations, exactly, generator by generator."""

from fractions import Fraction as Q

import casadi as ca
import numpy as np
import pytest
import sympy as sp

import obsynth as ob
from obsynth.designs.core.backward import Sweeps
from obsynth.designs.core.boxes import Ends
from obsynth.designs.core.contractor import EVERY_CUT, Contractor
from obsynth.designs.core.equations import Before
from obsynth.designs.set_membership.enclosure import Enclosures, middle_of, told_by_rate

R = sp.Rational


def rows(a, b, free, f, one, two, v, p):
    """Polynomials with numbers that are doubles; of symbols or rationals."""
    return a / 2 + free * b / 4 + two * p, b / 2 - f * a / 8 + one * p + two


def shown(a, b, free, f, one, two, v, p):
    return a * p + f / 4 + v + one * b, a + v + two + one / 2


def products() -> ob.Plant:
    """A free fault, one that is followed, noise of one row and of two, a parameter."""
    plant = ob.Plant("products")
    x = plant.states("a b", range=(-4, 4))
    free = plant.process_faults("free", range=(-3, 3))
    slow = plant.process_faults("slow", range=(-3, 3), rate=R(1, 8))
    w = plant.disturbances("one two v", bound=[R(1, 3), R(1, 8), R(1, 16)])
    symbols = *x, *free, *slow, *w, *plant.params("p", range=(R(3, 4), R(5, 4)))
    plant.dynamics([*rows(*symbols)], Ts=1)
    plant.outputs([*shown(*symbols)])
    return plant


def enclosed():
    """Enclosures, and a function (lower, upper) -> J, columns, offset, spread, H, offset, sigma."""
    plant = products()
    contractor = Contractor(plant, plant.Ts, EVERY_CUT)
    found = Enclosures(Sweeps(contractor), told_by_rate(contractor))
    n_v = found.sweeps.equations.n_v
    lower, upper = ca.SX.sym("l", n_v), ca.SX.sym("h", n_v)
    parts = [Ends(lower[c], upper[c]) for c in (slice(0, 2), slice(2, 4), slice(4, n_v))]
    here = Before(parts[0], parts[1], ca.SX(0, 1), parts[2])
    told, seen = found.rows(here), found.outputs(here)
    outputs = [told.J, ca.horzcat(*told.columns), told.offset, told.spread]
    outputs += [seen.H, seen.offset, seen.sigma]
    return found, ca.Function("f", [lower, upper], [ca.densify(part) for part in outputs])


FOUND, FUNCTION = enclosed()


def test_what_stands_beside_a_zonotope():
    """A generator for what is free or enters two rows, in this order: places of faults are read."""
    assert FOUND.size == 3 and FOUND.free == [0] and FOUND.alone == [2, 5, 7]


@pytest.mark.parametrize("size", [1.0, 1e-3, 1e-9, 1e-16])
def test_equations_lie_in_their_enclosures(size):
    """What is left of a value beside the affine part, for generators that are what they say.

    Mutants: the spread without the products' part, without what rounding takes, without the reach
    of noise in one row; generators halved; a rate left out.
    """
    exact, half = np.vectorize(Q, otypes=[object]), Q(1, 2)
    n_v, share = FOUND.sweeps.equations.n_v, Q(0)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        box = FOUND.sweeps.equations.box.T
        middle = rng.uniform(*box)
        ends = np.sort(np.clip(middle + size * rng.uniform(-1.0, 1.0, (2, n_v)), *box), axis=0)
        J, columns, offset, spread, H, start, sigma = map(exact, FUNCTION(*ends))
        low, high = map(exact, ends)
        own = FOUND.alone
        middles, radii = (
            exact(np.array(ca.DM(v)).ravel()) for v in middle_of(*map(ca.DM, ends[:, own]))
        )
        assert (middles - radii <= low[own]).all() and (middles + radii >= high[own]).all()
        slack = np.abs(ends[:, own]).max() * Q(1e-11)
        assert (2 * radii <= high[own] - low[own] + slack).all()
        for _ in range(40):
            v = np.where(rng.random(n_v) < 0.5, low, high)
            z, xi = v[[0, 1, 3]], (v[own] - middles) / np.where(radii > 0, radii, Q(1))
            moved = np.array([*rows(*v), v[3]])
            gap = np.abs(moved - J @ z - offset[:, 0] - columns @ xi)
            gap[2] += Q(1, 8)
            assert (gap <= spread[:, 0]).all()
            assert (np.abs(np.array(shown(*v)) - H @ z - start[:, 0]) <= sigma[:, 0]).all()
            share = max(share, *(gap / spread[:, 0])[:2])
    assert share > half * (size > 1e-9)
