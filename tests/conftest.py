"""The quadruple tank and its designs, made once for all tests of a worker."""

import json
import math
import time
from pathlib import Path

import pytest

import obsynth as ob
from methods import PEAK_GAINS

BEGUN = pytest.StashKey[float]()


def pytest_addoption(parser):
    parser.addoption("--minutes", type=float, default=math.inf, help="begin no test after so many")


def pytest_configure(config):
    config.stash[BEGUN] = time.monotonic()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Leave out, and say so, what a slow machine has no time for."""
    minutes = item.config.getoption("--minutes")
    if time.monotonic() - item.config.stash[BEGUN] > 60.0 * minutes:
        pytest.skip(f"not begun within {minutes:g} minutes")


@pytest.fixture(scope="session")
def reference():
    """Reference numbers of the bounded-error paper's example, all digits."""
    path = Path(__file__).parent / "reference" / "bounded_error_uio.json"
    return json.loads(path.read_text())


@pytest.fixture(scope="session")
def tank():
    return ob.plants.quadruple_tank().discretise("euler", Ts=1.0)


@pytest.fixture(scope="session")
def tank_split(tank):
    return ob.split(tank)


@pytest.fixture(scope="session")
def tank_bounds(tank_split):
    return ob.jacobian_bounds(tank_split)


@pytest.fixture(scope="session")
def base(tank_split, tank_bounds):
    """BASE: corrected, 16 vertices, gamma = .005, min trace(P^-1)."""
    return ob.BoundedErrorUIO(gamma=0.005).design(tank_split, tank_bounds)


@pytest.fixture(scope="session")
def given_peak(tank_split, tank_bounds):
    """Peak bounds of the given gains."""
    return ob.BoundedErrorUIO(bounds="peak").analyse(tank_split, PEAK_GAINS, tank_bounds)


@pytest.fixture(scope="session")
def peak(tank_split, tank_bounds):
    """Peak bounds with a gain designed for them."""
    return ob.BoundedErrorUIO(bounds="peak").design(tank_split, tank_bounds)
