"""The search for gamma: as good as a fine grid where sizes bend, jump or end, in few solves."""

import numpy as np
import pytest
import sympy as sp

import obsynth as ob
from obsynth.designs.general.method import GeneralUIO
from obsynth.designs.general.synthesis import search_gamma


def smooth(gamma):
    return 1.0 / gamma**0.5 + 3.0 * gamma


def steep(gamma):
    """It ends where no ellipsoid is invariant, just after its minimum."""
    return gamma**-0.5 / (0.03 - gamma) ** 0.05 if gamma < 0.03 else None


def ends(gamma):
    return gamma**-0.5 if gamma < 0.0069 else None


def jumps(gamma):
    """Below, an open loop decays; above, a gain has to be paid for."""
    return gamma**-0.4 if gamma < 0.0256 else 60.0 * gamma**0.7


def bends(gamma):
    return max(0.2 * gamma**-0.7, 4.0 * gamma)


@pytest.mark.parametrize("size", [smooth, steep, ends, jumps, bends])
@pytest.mark.parametrize("start", [0.004, 0.018, 0.021, 0.2])
def test_no_gamma_of_a_fine_grid_is_better_by_more_than_two_per_cent(size, start):
    """Mutants: the end of the walk; the side with less room; all of the room where sizes end."""
    tried = []

    def solve(gamma):
        tried.append(gamma)
        found = size(gamma)
        return None if found is None else (found, gamma)

    gamma = search_gamma(solve, start)
    grid = [size(g) for g in np.geomspace(1e-4, 0.97, 4000)]
    assert size(gamma) <= 1.02 * min(value for value in grid if value is not None)
    assert len(tried) <= (10 if size is ends else 12) and len(set(tried)) == len(tried)


@pytest.mark.parametrize(
    ("name", "Ts", "gammas"),
    [
        ("battery", 1, (0.0036, 0.0039, 0.0042)),
        pytest.param("heat_exchanger", "1/5", (0.0235, 0.0243, 0.025), marks=pytest.mark.long),
        pytest.param("three_tanks", 1, (0.025, 0.026, 0.027), marks=pytest.mark.long),
    ],
)
def test_no_given_gamma_has_a_narrower_ellipsoid(name, Ts, gammas):
    """These end or jump near their best. Mutant: the end of the walk, 10 % too wide."""
    plant = getattr(ob.plants, name)().discretise("euler", Ts=sp.Rational(Ts))
    method = GeneralUIO(bounds="ellipsoid")
    read = method.read(plant)
    weights = method._weights(read)

    def size(gamma):
        other = GeneralUIO(bounds="ellipsoid", gamma=gamma)
        bound = other.solve(read).bound
        return weights @ np.sqrt(np.diag(np.linalg.inv(bound.P)))

    assert size(None) <= 1.02 * min(map(size, gammas))
