"""Nothing is given up that could not be found again."""

import numpy as np

import obsynth as ob
from methods import METHODS
from obsynth.designs.core.guard import MOST_CALLS


def test_a_level_that_cannot_begin_anew_is_kept():
    """Mutant: 20 time constants whatever the ranges; the level is lost after 2 N calls then."""
    entry = METHODS["qpv_observer"]
    observer = entry.method.design(entry.plant())
    assert observer.record["options"]["horizon"] == MOST_CALLS
    assert "2000000000 calls" in " ".join(observer.guarantee.claims)
    memory, theta = observer.memory0([5.0], x_range=[(4.95, 5.05)], f_range=[(-0.05, 0.05)]), [0.5]
    for _ in range(2500):
        told = [np.array(v).ravel() for v in observer.step(memory, [7.5], [5.0], theta)]
        memory = told[0]
    assert told[-1] == 0
    assert np.all(told[6] - told[5] < 0.2)


def test_a_chosen_horizon_is_kept():
    entry = METHODS["qpv_observer"]
    chosen = ob.QPVObserver(**{**vars(entry.method), "horizon": 50})
    assert chosen.design(entry.plant()).record["options"]["horizon"] == 50
