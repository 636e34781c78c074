"""The example of the paper, and designs made once for all tests of a worker."""

import functools
import json
from pathlib import Path

import numpy as np
import pytest

import obsynth as ob

POLYTOPES = {
    "box_tight": ("box", 0.2),
    "box_insc": ("box", 6.0**-0.5),
    "cross_tight": ("cross", 0.2 * 6.0**0.5),
    "cross1": ("cross", 1.0),
}
APART = {"E_x": [2.0, 2.0, 3.0], "initial_error": [1.0, 0.5, 2.0, 0.0, 0.0, 0.0]}


@functools.cache
def _plant():
    return ob.plants.qpv_example()


def _method(name="box_tight", **changes):
    region = ob.Ellipsoid([0.2, 0.2, 0.2, 0.1, 0.1, 0.1], [10, 10, 10, 0, 0, 0])
    options = {"region": region, "performance_output": np.eye(6)[[5]]}
    if name in POLYTOPES:
        kind, kappa = POLYTOPES[name]
        options |= {"polytope": kind, "kappa": kappa, "eta": 0.2}
    else:
        options |= APART
        if name == "noise":
            options["alpha_q"] = 1.0
    return ob.QPVObserver(**{**options, **changes})


@functools.cache
def _designed(name):
    return _method(name).design(_plant())


@pytest.fixture(scope="session")
def plant():
    return _plant()


@pytest.fixture(scope="session")
def method():
    """``method(name, **changes)``: box_tight, box_insc, cross_tight, cross1, apart, noise."""
    return _method


@pytest.fixture(scope="session")
def designed():
    """``designed(name)``: the observers that several tests look at."""
    return _designed


@pytest.fixture(scope="session")
def paper():
    """Reference numbers of an independent implementation, all digits."""
    path = Path(__file__).parents[2] / "reference" / "qpv.json"
    return json.loads(path.read_text())


@functools.cache
def _shrinking():
    """Without disturbances, and with an error set that holds the whole region."""
    made = ob.Plant("no noise")
    (x,) = made.states("x", range=(4, 6), nominal=5)
    (u,) = made.inputs("u", range=(0, 20), nominal=5)
    (f,) = made.process_faults("f", range=(-0.1, 0.1))
    made.dynamics([-x + f * x + u])
    made.outputs([x])
    return ob.QPVObserver(
        region=ob.Ellipsoid([0.25, 0.01], [5.0, 0.0]),
        E_x=[1.5],
        initial_error=[1.0, 0.3],
        alpha=0.8,
        gain_cap=30.0,
        performance_output=[[0, 1]],
    ).design(made)


@pytest.fixture(scope="session")
def noiseless():
    return _shrinking()
