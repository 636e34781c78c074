"""Signs of slopes where flows sign(g) |g|^a count as one increasing function of g."""

import pytest
import sympy as sp

import obsynth as ob
from obsynth.derive.errors import StructureError
from obsynth.derive.jacobian.slope_signs import Monotone, exact_slope, with_ranges


def times_a_flow(low, high):
    """x' = y flow(z) - x: the slope in y is the flow, whose range is that of its ends."""
    plant = ob.Plant("flow")
    x, y, z = plant.states("x y z", range=[(0, 1), (0, 1), (low, high)])
    plant.dynamics([y * sp.sign(z) * sp.sqrt(sp.Abs(z)) - x, -y, -z])
    plant.outputs([x])
    return plant


@pytest.mark.parametrize(("ends", "sign"), [((1, 4), 1), ((-4, -1), -1)])
def test_the_sign_of_a_flow_is_that_of_its_ends(ends, sign):
    found = Monotone(times_a_flow(*ends))
    assert found.signs(0, found.plant.x).tolist() == [-1, sign, 1]


def test_a_flow_that_turns_has_no_sign():
    """Mutants: one of its ends taken twice."""
    for ends in ((-1, 4), (-4, 1)):
        found = Monotone(times_a_flow(*ends))
        with pytest.raises(StructureError, match="not proved to be monotone in y") as refused:
            found.signs(0, found.plant.x)
        assert refused.value.symbol == "y" and refused.value.row == "x"


def test_slopes_that_take_both_signs_in_sum_are_refused():
    """x' = flow(z) - 2 z rises by z through the flow and falls beside it."""
    plant = ob.Plant("both")
    x, z = plant.states("x z", range=[(0, 1), (1, 4)])
    plant.dynamics([sp.sign(z) * sp.sqrt(sp.Abs(z)) - 2 * z, -z])
    plant.outputs([x])
    with pytest.raises(StructureError, match="not proved to be monotone in z"):
        Monotone(plant).signs(0, plant.x)


def test_other_ranges_belong_to_signals_of_the_kind_alone():
    """Mutant: the ranges given in another order."""
    plant = times_a_flow(1, 4)
    moved = with_ranges(plant, [(0, 1), (2, 3), (4, 5)])
    assert [(s.lower, s.upper) for s in moved.x] == [(0, 1), (2, 3), (4, 5)]
    assert moved.rhs == plant.rhs and plant.x[2].lower == 1


def test_slopes_have_the_rationals_that_doubles_are():
    x = sp.Symbol("x", real=True)
    assert exact_slope(0.1 * x * sp.Abs(x), x) == sp.Rational(0.1) * (sp.Abs(x) + x * sp.sign(x))


def test_a_slope_is_bounded_as_typed_not_as_written_out():
    """Air between two zones, whose slopes are told through a - b; -flow - 5 b falls and rises."""

    def zones(loss):
        plant = ob.Plant("two zones")
        a, b = plant.states("a b", range=(15, 28))
        flow = (a - b) * sp.sqrt(1 + (a - b) ** 2)
        plant.dynamics([-flow - a, -flow - loss * b])
        plant.outputs([a])
        return Monotone(plant), plant.x

    found, x = zones(30)
    assert [found.signs(row, x).tolist() for row in (0, 1)] == [[-1, 1], [-1, -1]]
    turning, x = zones(5)
    with pytest.raises(StructureError, match="equation of b is not proved to be monotone in b"):
        turning.signs(1, x)
