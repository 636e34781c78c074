"""Plants as they are typed, each with values that are worked out by hand."""

import json

import numpy as np
import pytest
import sympy as sp

import obsynth as ob

POINTS = {
    # 12 190 (1 - .4 (240/420 - 1)^2) .3 = 633.75; 156.8 rolling, .4992 v^2 = 199.68 drag
    "cruise_control": (
        [20],
        [0.3],
        [0, 0],
        [0],
        [],
        [(0.3 * 2280 * (1 - 0.4 * 9 / 49) - 356.48) / 1600],
        [20],
    ),
    # upright at rest with F2 = m g and a step of 1 N to the side: 1/4 m/s^2, r / J = 100/19
    "pvtol": ([0] * 6, [1, 39.2], [0] * 6, [0, 0], [], [0, 0, 0, 0.25, 0, 100 / 19], [0] * 6),
    # F = 1 on the upright pole: omega' = -(1/1.1) / (.5 (4/3 - .1/1.1)) = -60/41, v' = 40/41
    "cart_pole": ([0] * 4, [1], [0] * 4, [0], [], [0, 40 / 41, 0, -60 / 41], [0] * 4),
    "flexible_joint": (
        [0.1, 1, 0, 0],
        [0],
        [0, 0],
        [0.5],
        [],
        [1, -4.86 - 1.25 + 10.8, 0, 1.95],
        [0.1, 1],
    ),
    # at rest there is no friction: V / L, and the load alone slows it
    "dc_motor": ([0, 0], [2], [0, 0], [1], [0.03], [6, -3], [0, 0]),
    # ocv(.5) = 3.4 + .55 - .225 + .075 = 3.8
    "battery": (
        [0.5, 0.03],
        [3],
        [0.001],
        [1],
        [],
        [-4 / 7200, -0.03 / 36 + 4 / 2400],
        [3.8 - 0.03 - 0.08 + 0.001],
    ),
    "kinematic_bicycle": (
        [1, 2, 0, 5.4],
        [1, np.pi / 4],
        [0.1, 0, 0, 0],
        [0.5],
        [],
        [5.4, 0, 2, 1.5],
        [1.1, 2, 0, 5.4],
    ),
    # (80 - 70)/5 - .06 30, (70 - 60)/5 - .06 30, (30 - 40)/5 + 1.8, (15 - 30)/5 + 1.8
    "heat_exchanger": (
        [70, 60, 40, 30],
        [1, 1],
        [0, 0.05],
        [2],
        [],
        [0.2, 0.2, -0.2, -1.2],
        [60, 42.05],
    ),
    "surface_pmsm": (
        [1, 2, 10],
        [3, 7],
        [0, 0, 0.5],
        [1],
        [0.1],
        [1350 + 80, 3700 - 2000 - 40, 1200 - 10 - 100],
        [1, 2, 10.5],
    ),
    "forced_oscillator": ([2, 1], [0.5], [0, 0.02], [0.25], [], [1, -3 - 2 + 0.75], [2, 1.02]),
    "tanks_in_a_row": (
        [16, 9, 4],
        [1],
        [0, 0, 0.05],
        [0.2],
        [],
        [1.2 - 1.4, 0.35, 0.35],
        [16, 9, 4.05],
    ),
}


def values(plant, x, u, w, f, d):
    told = plant.function()(x, u, d, f, w, [], [])
    return [np.array(part).ravel() for part in told[:2]]


@pytest.mark.parametrize("name", POINTS)
def test_values_by_hand_before_and_after_a_file(name):
    """Mutants: a sign, an index, a constant of the equations."""
    *given, rhs, output = POINTS[name]
    plant = getattr(ob.plants, name)()
    again = ob.Plant.from_dict(json.loads(json.dumps(plant.to_dict())))
    for one in (plant, again):
        moved, shown = values(one, *given)
        np.testing.assert_allclose(moved, rhs, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(shown, output, rtol=1e-12, atol=1e-12)


def test_the_reactor_with_rates_of_its_own():
    """At 273.15 K above zero by Arrhenius, written apart."""
    x, u = np.array([0.8, 0.5, 134.0, 130.0]), [15.0, -2000.0]
    moved, shown = values(ob.plants.klatt_engell_reactor(), x, u, [0.01, 0, 0], [100.0], [])
    k1 = 1.287e12 * np.exp(-9758.3 / 407.15)
    k3 = 9.043e9 * np.exp(-8560.0 / 407.15)
    heat = (4.2 * k1 * 0.8 - 11.0 * k1 * 0.5 - 41.85 * k3 * 0.64) / (0.9342 * 3.01)
    across = 4032 * 0.215 * 4.0
    expected = [
        15 * 4.3 - 0.8 * k1 - 0.64 * k3,
        -7.5 + 0.3 * k1,
        -heat + 15 * -4.0 - across / (0.9342 * 3.01 * 10.01),
        (-1900 + across) / 10,
    ]
    np.testing.assert_allclose(moved, expected, rtol=1e-11)
    np.testing.assert_allclose(shown, [0.51, 134, 130])


@pytest.mark.parametrize("n", [1, 2, 5])
def test_any_number_of_tanks(n):
    plant = ob.plants.tanks_in_a_row(n)
    assert len(plant.x) == len(plant.output_names) == n
    rest = np.full(n, (1 / 0.35) ** 2)
    np.testing.assert_allclose(values(plant, rest, [1], np.zeros(n), [0], [])[0], 0, atol=1e-12)
    assert plant.rhs[n - 1].has(sp.sqrt(plant.x[n - 1].symbol))


def test_a_gentle_scenario_leaves_unbounded_disturbances_at_zero():
    """Mutants: bounded ones at zero too; another order of what is drawn."""
    plant = ob.plants.hinf_example()
    drawn = ob.scenarios.gentle(plant, steps=9).arrays(plant)["w"]
    assert not np.isfinite(plant.box("w")).any() and not drawn.any()
    plant = ob.plants.battery()
    box = plant.box("w")
    expected = np.random.default_rng(0).uniform(box[:, 0], box[:, 1], (10, len(box)))
    scenario = ob.scenarios.gentle(plant, steps=9)
    assert np.array_equal(scenario.arrays(plant, 0)["w"], expected)


@pytest.mark.parametrize("name", [*POINTS, "klatt_engell_reactor"])
def test_a_gentle_scenario_begins_and_moves_within_ranges_and_rates(name):
    """Mutants: the rate left out; a wave about the middle of a range that has a nominal value."""
    continuous = getattr(ob.plants, name)()
    plant = continuous.discretise("euler", Ts=0.01)
    scenario = ob.scenarios.gentle(plant, steps=40, seed=3)
    given = scenario.arrays(plant)
    for kind in ("u", "f"):
        box = plant.box(kind).reshape(-1, 2)
        assert np.all(box[:, 0] <= given[kind]) and np.all(given[kind] <= box[:, 1])
    rate = np.array([s.rate for s in plant.f], dtype=float)
    moved = np.abs(np.diff(given["f"], axis=0)).max(axis=0)
    assert np.all(moved <= rate) and np.all(moved > 0)
    box = plant.box("x")
    assert np.all(box[:, 0] <= scenario.x0) and np.all(scenario.x0 <= box[:, 1])
    nominal = np.array([float(s.nominal) for s in plant.x])
    assert np.array_equal(scenario.guess, nominal)
    again = ob.scenarios.gentle(plant, steps=40, seed=3)
    assert np.array_equal(scenario.x0, again.x0)
    assert not np.array_equal(scenario.x0, ob.scenarios.gentle(plant, steps=40, seed=4).x0)
