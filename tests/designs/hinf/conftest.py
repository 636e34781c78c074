"""Both variants of the paper's example, split and bounded once."""

import json
from pathlib import Path

import numpy as np
import pytest

import obsynth as ob

# (53), to the printed digits.
PAPER_K = np.array([[0.4885, 2.0619], [0.0, 0.0], [0.9724, 1.0753]])


@pytest.fixture(scope="session")
def hinf_reference():
    path = Path(__file__).parents[2] / "reference" / "hinf_uio.json"
    return json.loads(path.read_text())


def _derived(variant):
    plant = ob.plants.hinf_example(variant)
    parts = ob.split(plant, at=(np.zeros(3), np.zeros(1)), linear="terms")
    return parts, ob.jacobian_bounds(parts)


@pytest.fixture(scope="session")
def consistent():
    return _derived("consistent")


@pytest.fixture(scope="session")
def printed_g():
    return _derived("as_printed")


@pytest.fixture(scope="session")
def paper_gain():
    return {"K": PAPER_K}


@pytest.fixture(scope="session")
def paper_filter(consistent, paper_gain):
    """The paper's K with the sharpest upper bound of its gain."""
    return ob.HinfUIO(method="polytopic", slack=1e-6).analyse(consistent[0], paper_gain)
