"""Jumps of the dynamics are refused by name, kinks are bounded by both slopes."""

import numpy as np
import pytest
import sympy as sp

from obsynth.derive import StructureError, UnboundedError, jacobian_bounds
from obsynth.symbolic import Plant

half = sp.Rational(1, 2)


def plant_with(row, limits=(-1, 1)):
    plant = Plant("test")
    x, y = plant.states("x y", range=limits)
    plant.dynamics([row(x, y), -y])
    plant.outputs([x])
    return plant


CONTINUOUS = {
    "kink": lambda x, y: sp.Abs(x) * y,
    "sign times itself": lambda x, y: x * sp.sign(x) * y,
    "saturation": lambda x, y: sp.Min(sp.Max(x + y, -half), half),
    "two branches": lambda x, y: sp.Piecewise((x**2, x < y), (x * y, True)),
    "dead zone": lambda x, y: sp.Piecewise((x, x < 0), (0, x <= half), (x - half, True)),
    "step inside one cell": lambda x, y: sp.floor(x / 3 + half) + y,
    "angle in the right half plane": lambda x, y: sp.atan2(y, x + 2),
    "surface outside the box": lambda x, y: sp.sign(x + 3) * y,
}
JUMPS = {
    "sign": lambda x, y: sp.sign(x) + y,
    "step": lambda x, y: sp.Heaviside(x - y),
    "branches that differ": lambda x, y: sp.Piecewise((x, x < half), (x + y + 3, True)),
    "a later branch differs": lambda x, y: sp.Piecewise((x, x < 0), (0, y < 0), (y, True)),
    "a gap": lambda x, y: sp.Piecewise((x, x < half), (0, x <= half), (x - half, True)),
    "floor": lambda x, y: sp.floor(x),
    "angle over the cut": lambda x, y: sp.atan2(y, x),
}


@pytest.mark.parametrize("name", sorted(CONTINUOUS))
def test_continuous_dynamics_pass(name):
    plant = plant_with(CONTINUOUS[name])
    found = jacobian_bounds(plant, effort="fast")
    function = plant.function()
    rng = np.random.default_rng(0)
    for a, b in rng.uniform(-1, 1, (200, 2, 2)):
        change = np.array(function(b, [], [], [], [], [], [])[0]).ravel()
        change -= np.array(function(a, [], [], [], [], [], [])[0]).ravel()
        # with M between its bounds, M (b - a) lies between these sums
        low = np.minimum(found.min * (b - a), found.max * (b - a)).sum(axis=1)
        high = np.maximum(found.min * (b - a), found.max * (b - a)).sum(axis=1)
        assert (change >= low - 1e-12).all()
        assert (change <= high + 1e-12).all()


@pytest.mark.parametrize("name", sorted(JUMPS))
def test_jumps_are_refused(name):
    with pytest.raises(StructureError, match="the row of x may jump where") as caught:
        jacobian_bounds(plant_with(JUMPS[name]))
    assert caught.value.row == "x"


def test_a_jump_is_no_jump_outside_of_its_surface():
    found = jacobian_bounds(plant_with(JUMPS["sign"], limits=(half / 2, 1)))
    np.testing.assert_array_equal(found.min, [[0.0, 1.0], [0.0, -1.0]])


def test_square_root_flow_between_tanks():
    """sign(z) sqrt|z| is continuous, its slope at z = 0 is not bounded."""

    def flow(x, y):
        return -sp.sign(x - y) * sp.sqrt(sp.Abs(x - y))

    with pytest.raises(UnboundedError, match="division by an interval that contains zero"):
        jacobian_bounds(plant_with(flow))
    apart = jacobian_bounds(plant_with(flow, limits=[(0.5, 1.0), (0.0, 0.25)]))
    assert apart.min[0, 0] == pytest.approx(-1.0, rel=1e-14)
    assert apart.max[0, 0] == pytest.approx(-0.5, rel=1e-14)
    assert str(apart.dependences[0]).startswith("m12 = -m11")
