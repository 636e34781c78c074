"""The search for gains: its fast sums are the proved bounds, and its gradient theirs."""

import numpy as np
import pytest

from methods import motor
from obsynth.designs.general.gain import GainSearch, find_gain, riccati_starts, scaled
from obsynth.designs.general.method import bound_peak
from obsynth.designs.general.model import read


@pytest.fixture(scope="module")
def design():
    return read(motor()).design


@pytest.fixture(scope="module")
def search(design):
    data = scaled(design)
    return GainSearch(data, np.linspace(1.0, 2.0, len(data.x)))


def near(search, seed):
    """A gain near the first start, with no entry that is zero."""
    Z = next(riccati_starts(search.data))
    return Z + 2e-4 * np.random.default_rng(seed).standard_normal(Z.shape)


@pytest.mark.parametrize("seed", range(3))
def test_its_value_is_the_bound(design, search, seed):
    """Mutants: any response left out of the sums; other units."""
    data = search.data
    Z = near(search, seed)
    found = search.value(Z)
    b = bound_peak(design.changed(Z=data.deployed(Z, design.L0.shape[1]))).bound.b
    assert found.b * np.tile(data.x, 2) == pytest.approx(b, rel=1e-5)
    assert found.mean == pytest.approx(search.weights @ found.b, rel=1e-12)


def test_its_gradient_is_that_of_the_value(search):
    """Mutants: any term of it with another sign."""
    Z = near(search, 7)
    gradient, step = search.value_and_gradient(Z)[1].reshape(Z.shape), 1e-8
    for entry in np.ndindex(Z.shape):
        moved = np.zeros_like(Z)
        moved[entry] = step
        slope = (search.value(Z + moved).mean - search.value(Z - moved).mean) / (2 * step)
        assert gradient[entry] == pytest.approx(slope, rel=1e-4)


def test_no_neighbour_of_what_is_found_is_better_and_the_same_is_found_again(design):
    weights = 1.0 / scaled(design).x
    Z = find_gain(design, weights)
    assert np.array_equal(Z, find_gain(design, weights))
    search = GainSearch(scaled(design), np.full(design.size, 1.0 / design.size))
    best, rng = search.value(search.data.gain(Z)).mean, np.random.default_rng(1)
    for _ in range(20):
        moved = Z * (1 + 0.01 * rng.standard_normal(Z.shape))
        assert search.value(search.data.gain(moved)).mean > best * (1 - 1e-4)
