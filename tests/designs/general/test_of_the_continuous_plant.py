"""Remainders of a step count as disturbances: the continuous plant stays inside."""

import functools

import numpy as np
import pytest
import sympy as sp

import obsynth as ob

# Order of the step; half width / half range of the fault by an independent search, to 5 %; samples
# before the plant leaves its box. For the cart pole 0.111 is for a fault that moves straight within
# a step; here it moves as its rate allows.
PLANTS = {
    "forced_oscillator": (3, 0.41, 150),
    "flexible_joint": (3, 0.41, 150),
    "cart_pole": (2, 0.115, 60),
}


@functools.cache
def designed(name, remainder=True):
    order = PLANTS[name][0]
    plant = getattr(ob.plants, name)()
    Ts = sp.Rational(1, 100)
    if remainder:
        model = plant.discretise("taylor", Ts=Ts, order=order, remainder=True)
    else:
        model = plant.discretise("euler", Ts=Ts)
    return ob.BoundedErrorUIO(bounds="peak").design(model)


NAMES = [pytest.param(n, marks=pytest.mark.long) for n in PLANTS if n != "forced_oscillator"]


@pytest.mark.parametrize("name", ["forced_oscillator", *NAMES])
def test_the_continuous_plant_stays_inside(name):
    observer = designed(name)
    half = 0.5 * np.diff(observer.model.box("f"), axis=1)[0, 0]
    assert observer.performance["core_half_widths"][-1] / half <= 1.05 * PLANTS[name][1]
    for seed in range(2):
        scenario = ob.scenarios.gentle(observer.model, steps=PLANTS[name][2], seed=seed)
        run = ob.simulate(observer.model, observer, scenario, seed=seed, substeps=10)
        assert all(share == 1.0 for share in run.coverage.values())
    assert any("continuous plant" in text for text in observer.guarantee.claims)


@pytest.mark.long
def test_without_the_remainder_it_leaves():
    observer = designed("flexible_joint", remainder=False)
    scenario = ob.scenarios.gentle(observer.model, steps=300, seed=1, share=0.3)
    run = ob.simulate(observer.model, observer, scenario, seed=1, substeps=10)
    assert min(run.coverage.values()) < 0.97
