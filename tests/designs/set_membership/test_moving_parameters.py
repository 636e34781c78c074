"""A parameter that is declared to move is not held to what it was."""

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
