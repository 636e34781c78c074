"""Scenarios: the paper's two, and what is refused."""

import dataclasses

import numpy as np
import pytest

from obsynth.symbolic import Plant, PlantError, Scenario
from obsynth.symbolic.plants import quadruple_tank
from obsynth.symbolic.scenarios.quadruple_tank import quadruple_tank as scenario


def fault_one(k):
    """f1 of the paper, Section 6, read off case by case."""
    if k <= 1000:
        return 0.0
    if k <= 1100:
        return -0.05 * k + 50
    if k <= 3000:
        return -5.0
    if k <= 3200:
        return 0.05 * k - 155
    return 5.0


@pytest.mark.parametrize(("name", "second"), [("FS1", 0.0), ("FS2", -1.0)])
def test_scenarios_are_the_papers(name, second):
    given = scenario(name)
    arrays = given.arrays(quadruple_tank().discretise("euler", 1.0), seed=0)
    assert given.steps == 5000
    np.testing.assert_array_equal(given.x0, [130, 170, 30, 40])
    np.testing.assert_array_equal(given.guess, [125, 165, 25, 35])
    one = np.array([fault_one(k) for k in range(5001)])
    np.testing.assert_allclose(arrays["f"][:, 0], one, atol=1e-13)
    np.testing.assert_allclose(arrays["f"][:, 1], second * one, atol=1e-13)
    for k in (0, 1, 77, 5000):
        np.testing.assert_allclose(arrays["u"][k], [10 + np.sin(k / 50), 10 + np.cos(k / 80)])
    np.testing.assert_array_equal(arrays["d"], np.full((5001, 1), 0.1))
    np.testing.assert_array_equal(given.x_range, np.stack([given.guess - 10, given.guess + 10], 1))
    np.testing.assert_array_equal(given.f_range, np.zeros((2, 2)))


def test_faults_respect_their_rate():
    for name in ("FS1", "FS2"):
        steps = np.abs(np.diff(scenario(name).faults, axis=0))
        assert steps.max() <= 0.05 + 1e-12
        assert steps.max() > 0.05 - 1e-12, "the ramps use the whole of the rate"


def test_noise_is_the_reference_noise():
    arrays = scenario("FS1").arrays(quadruple_tank(), seed=3)
    expected = np.random.default_rng(3).uniform(-0.1, 0.1, (5001, 3))
    np.testing.assert_array_equal(arrays["w"], expected)
    other = scenario("FS1").arrays(quadruple_tank(), seed=4)["w"]
    assert not np.array_equal(arrays["w"], other)


def small(**changes):
    values = {"name": "s", "steps": 2, "x0": [1.0], "guess": [0.0], "inputs": np.ones((3, 1))}
    return Scenario(**values | changes)


def plant(bound=1.0):
    result = Plant("p")
    result.states("x")
    result.inputs("u")
    result.unknown_inputs("d")
    result.faults("f")
    result.disturbances("w1:3", bound=bound)
    result.scheduling("r s", range=(0, 4), nominal=[1, None])
    result.dynamics(["-x + u + w1 + d + f"])
    result.outputs(["x + w2"])
    return result


def test_what_is_left_out():
    arrays = small().arrays(plant(), seed=1)
    assert {key: value.shape for key, value in arrays.items()} == {
        "u": (3, 1),
        "d": (3, 1),
        "f": (3, 1),
        "w": (3, 2),
        "rho": (3, 2),
    }
    assert not arrays["d"].any()
    assert not arrays["f"].any()
    np.testing.assert_array_equal(arrays["rho"], [[1, 2]] * 3)


def test_functions_of_the_step():
    given = small(inputs=lambda k: k**2, disturbances=lambda rng, k: rng.normal(size=2) * 0 + k)
    arrays = given.arrays(plant(bound=None))
    np.testing.assert_array_equal(arrays["u"].ravel(), [0, 1, 4])
    np.testing.assert_array_equal(arrays["w"], [[0, 0], [1, 1], [2, 2]])


def test_every_signal_may_be_a_function_of_the_step():
    given = small(
        inputs=lambda k: k,
        faults=lambda k: [2 * k],
        unknown_inputs=lambda k: [[3 * k]],
        scheduling=lambda k: [k, k + 1],
        disturbances=lambda k: (k, -k),
    )
    arrays = given.arrays(plant(bound=None))
    np.testing.assert_array_equal(arrays["f"].ravel(), [0, 2, 4])
    np.testing.assert_array_equal(arrays["d"].ravel(), [0, 3, 6])
    np.testing.assert_array_equal(arrays["rho"], [[0, 1], [1, 2], [2, 3]])
    np.testing.assert_array_equal(arrays["w"], [[0, 0], [1, -1], [2, -2]])
    assert sorted(given.functions) == ["d", "f", "rho", "u", "w"]
    assert given.functions["rho"](0.5) == [0.5, 1.5]


def test_neither_a_feedback_nor_a_sampler_is_a_function_of_the_step():
    given = small(inputs=lambda k, y: -y, disturbances=lambda rng, k: rng.normal(size=2))
    assert given.functions == {}
    assert small(disturbances=np.zeros((3, 2))).functions == {}
    assert list(small(disturbances=lambda k: [k, k]).functions) == ["w"]


def test_feedback_has_no_samples():
    given = small(inputs=lambda k, y: -y)
    assert given.feedback
    assert given.arrays(plant())["u"] is None
    assert small(inputs=lambda k, y=0: -y, feedback=True).arrays(plant())["u"] is None
    assert not small(inputs=lambda k, gain=2: gain * k).feedback


def test_scenarios_are_frozen():
    given = small()
    with pytest.raises(dataclasses.FrozenInstanceError):
        given.steps = 3
    with pytest.raises(ValueError, match="read-only"):
        given.x0[0] = 2.0
    data = np.ones((3, 1))
    given = small(inputs=data)
    data[:] = 5.0
    np.testing.assert_array_equal(given.arrays(plant())["u"], np.ones((3, 1)))


REFUSALS = {
    "steps zero": ({"steps": 0}, "no positive integer"),
    "steps real": ({"steps": 2.0}, "no positive integer"),
    "x0 shape": ({"x0": 1.0}, r"x0 has shape \(\)"),
    "x0 nan": ({"x0": [np.nan]}, "x0 holds non-finite data"),
    "guess shape": ({"guess": [1.0, 2.0]}, r"guess has shape \(2,\)"),
    "one sample short": ({"inputs": np.ones((2, 1))}, r"inputs has shape \(2, 1\), not \(3, any\)"),
    "inputs inf": ({"inputs": np.full((3, 1), np.inf)}, "inputs holds non-finite data"),
    "inputs text": ({"inputs": "sin"}, "inputs is not an array of numbers"),
    "faults flat": ({"faults": np.zeros(3)}, "faults has shape"),
    "x_range inverted": ({"x_range": [[1, 0]]}, "lower above upper"),
    "x_range shape": ({"x_range": [[0, 1], [0, 1]]}, "x_range has shape"),
    "feedback of samples": ({"feedback": True}, "a function of"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_refusals(case):
    changes, message = REFUSALS[case]
    with pytest.raises(PlantError, match=message):
        small(**changes)


MISFITS = {
    "states": ({"x0": [1, 2], "guess": [0, 0]}, "2 initial states"),
    "inputs": ({"inputs": np.ones((3, 2))}, r"inputs has shape \(3, 2\)"),
    "faults": ({"faults": np.ones((3, 2))}, r"faults has shape"),
    "function of faults": ({"faults": lambda k: [k, k]}, r"faults has shape"),
    "function": ({"inputs": lambda k: [k, k]}, r"inputs has shape"),
    "non-finite function": ({"inputs": lambda k: 1 / max(k, 1) if k else np.nan}, "non-finite"),
    "f_range": ({"f_range": np.zeros((2, 2))}, "f_range"),
}


@pytest.mark.parametrize("case", MISFITS)
def test_a_scenario_of_another_plant_is_refused(case):
    changes, message = MISFITS[case]
    with pytest.raises(PlantError, match=message):
        small(**changes).arrays(plant())


def test_unbounded_disturbances_need_samples():
    with pytest.raises(PlantError, match="unbounded disturbances"):
        small().arrays(plant(bound=None))


def test_unknown_scenarios_list_the_names():
    with pytest.raises(PlantError, match="FS1, FS2"):
        scenario("FS3")
