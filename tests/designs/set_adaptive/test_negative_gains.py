"""Faults whose gains are negative, or of both signs: leaks, what goes from one state to another.

Mutants: fmax and fmin of `pulls` exchanged (any of the four), its others at the wrong end, an end
of `image` exchanged; in the bank the ends of a falling response not exchanged, its sign not held
against the slope, `bank_intervals` of a falling response not mirrored.
"""

from dataclasses import replace

import numpy as np
import pytest
from adaptive_runs import outside

import obsynth as ob
from obsynth.designs.filter_bank.claims import claims
from obsynth.designs.filter_bank.method import FilterBank
from obsynth.designs.filter_bank.step import bank_intervals
from obsynth.designs.set_adaptive.method import SetAdaptiveObserver

SIZE = 0.2
NEAR = [(0.6, 0.8), (1.2, 1.4)]
ADAPTIVE = SetAdaptiveObserver(Gamma=20.0, gain_cap=0.5, Ts=0.02)
BANK = FilterBank(filters=(0.3, 1.0), Ts=0.05)


def tanks(*columns):
    """Two tanks; every fault enters both rows with factors of its own."""
    plant = ob.Plant("tanks with leaks")
    a, b = plant.states("a b", range=(0, 4))
    (u,) = plant.inputs("u", range=(0, 1))
    faults = plant.process_faults(f"f1:{len(columns) + 1}", range=(-SIZE, SIZE))
    v = plant.disturbances("v1:3", bound=0.002)
    enter = [sum(c[i] * f for c, f in zip(columns, faults, strict=True)) for i in (0, 1)]
    plant.dynamics([u - a * (1 + a / 10) + b / 5 + enter[0], a - b / 2 + enter[1]])
    plant.outputs([a + v[0], b + v[1]])
    return plant


@pytest.mark.parametrize("columns", [((-1, 1), (0, -0.5)), ((-1, 0.5), (0.5, 1)), ((0.3, -1),)])
def test_what_leaks_and_what_goes_over_is_enclosed(columns):
    """Every disturbance and input held at an end, jumping or anything; faults at their ends."""
    plant = tanks(*columns)
    observer = ADAPTIVE.design(plant)
    assert observer.certificate.check().valid
    wrong, seen, widths = outside(observer, plant, range(16), 300, NEAR)
    assert wrong == 0
    assert seen > 3000
    assert widths[2] < 0.5 * SIZE


@pytest.mark.parametrize("moving", [False, True])
def test_the_bank_encloses_what_leaks(moving):
    plant = tanks((-1, 0), (0, -0.5))
    bank = BANK.design(plant)
    assert bank.certificate.check().valid
    wrong, seen, widths = outside(bank, plant, range(16), 250, NEAR, moving=moving)
    assert wrong == 0
    assert seen > 3000
    assert widths[2:].max() < 0.3 * SIZE


@pytest.mark.parametrize("method", [ADAPTIVE, BANK])
def test_a_fault_of_the_other_sign_has_the_mirrored_interval(method):
    """A leak is a negative inflow: the same readings give the same sets, to the last bit."""
    pair = [method.design(tanks(*columns)) for columns in (((1, 0), (0, 2)), ((-1, 0), (0, -2)))]
    memories = [one.memory0([0.7, 1.3], x_range=NEAR) for one in pair]
    rng = np.random.default_rng(3)
    for _ in range(40):
        u, y = rng.uniform(0.6, 0.8, 1), np.array([0.7, 1.3]) + rng.uniform(-0.002, 0.002, 2)
        results = [one.step(memory, u, y) for one, memory in zip(pair, memories, strict=True)]
        first, second = ([np.array(part).ravel() for part in result] for result in results)
        memories = [result[0] for result in results]
        assert first[3].tolist() == second[3].tolist()
        assert (first[5].tolist(), first[6].tolist()) == (
            (-second[6]).tolist(),
            (-second[5]).tolist(),
        )
    if method is BANK:
        found = [
            bank_intervals(one, np.array(m).ravel(), y)
            for one, m in zip(pair, memories, strict=True)
        ]
        assert np.array_equal(found[0], (-found[1][1], -found[1][0]))
        assert (found[0][0] < found[0][1]).all()
        assert (found[1][0] < found[1][1]).all()


def test_the_sign_of_a_response_is_that_of_the_slope():
    design = BANK.design(tanks((-1, 0), (0, 2))).certificate.design
    assert design.gain.tolist() == [-1.0, 2.0]
    for factor in ([-1, 1], [1, -1], [0, 1]):
        spoilt = replace(design, gain=design.gain * factor)
        assert [c.name for c in claims(spoilt) if not c.holds] == ["filters"]
