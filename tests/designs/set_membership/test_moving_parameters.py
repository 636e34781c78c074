"""Parameters: held to what they were only if they stand still, and contradicted by readings."""

import numpy as np
import pytest
import sympy as sp

import obsynth as ob


@pytest.mark.parametrize("constant", [False, True])
def test_only_constant_parameters_are_remembered(constant):
    """Mutant: every parameter of the plant among `Sweeps.constant`."""
    R = sp.Rational
    plant = ob.Plant("valve")
    (x,) = plant.states("x", range=(-5, 5))
    (u,) = plant.inputs("u", range=(-2, 2), nominal=1)
    (b,) = plant.params("b", range=(R(1, 2), R(3, 2)), constant=constant)
    w, v = plant.disturbances("w v", bound=R(1, 100))
    plant.dynamics([x / 2 + b * u + w], Ts=1)
    plant.outputs([x + v])
    observer = ob.SetMembershipObserver(columns=8).analyse(plant, {"L": [[0.5]]})
    assert ("b constant" in str(observer.guarantee)) == constant
    assert ("b in [0.5, 1.5]" in str(observer.guarantee)) != constant
    memory, truth, seen = observer.memory0([0.0], x_range=[(-1, 1)]), 0.0, []
    for k in range(30):
        memory, _, _, low, high, _, _, status = observer.step(memory, [1.0], [truth])
        seen.append(int(status))
        # what is not held to its declaration is found out, what is remembered could not be
        assert constant or float(low) <= truth <= float(high)
        truth = 0.5 * truth + (1.5 if k // 7 % 2 else 0.5)
    assert bool(np.array(seen).any()) == constant


def test_a_reading_that_contradicts_a_parameter_alone_is_void():
    """Mutant: what readings say of anything but states and faults does not count as empty."""
    plant = ob.Plant("drifting gauge")
    (x,) = plant.states("x", range=(-1, 1))
    (p,) = plant.params("p", range=(1, 2))
    w, v, n = plant.disturbances("w v n", bound=[0.01, 0.01, 0.1])
    plant.dynamics([x / 2 + w], Ts=1)
    plant.outputs([x + v, p + n])
    observer = ob.SetMembershipObserver().design(plant)
    memory, words = observer.memory0([0.0]), []
    for y in ([0.0, 1.5], [0.0, 1.5], [0.0, 5.0], [0.0, 1.5]):
        memory, *_, status = observer.step(memory, [], y)
        words.append(int(status) & 8)
    assert words == [0, 0, 8, 0]
