"""Entries that sampling gets wrong: peaks, aliases, poles, domains and kinks, each as it should."""

import contextlib

import numpy as np
import pytest
import sympy as sp

from obsynth.derive import (
    Status,
    StructureError,
    UnboundedError,
    jacobian_bounds,
    split,
)
from obsynth.symbolic import Plant
from obsynth.symbolic.errors import ObsynthError

R = sp.Rational


def plant_with(row, limits=(-1, 1), extra=None):
    plant = Plant("special")
    x, y = plant.states("x y", range=limits)
    plant.dynamics([row(x, y), -y if extra is None else extra(x, y)])
    plant.outputs([x])
    return plant


def slope(row, limits=(-1, 1), **options):
    """Bounds of the upper left entry."""
    found = jacobian_bounds(plant_with(row, limits), **options)
    assert found.status[0, 0] in (Status.EXACT, Status.CONVERGED)
    return float(found.min[0, 0]), float(found.max[0, 0])


def peak(x, _):
    # the derivative is exp(-((x - 3/10)/width)^2), of half width 1e-5 times that of the box
    width = R(2, 10**5)
    return width * sp.sqrt(sp.pi) / 2 * sp.erf((x - R(3, 10)) / width)


def test_narrow_peak():
    low, high = slope(peak)
    assert 0.0 <= low <= 1e-9
    assert 1.0 <= high <= 1.0 + 1e-6
    grid = np.linspace(-1, 1, 5001)
    missed = np.delete(np.exp(-(((grid - 0.3) / 2e-5) ** 2)), np.argmin(np.abs(grid - 0.3)))
    assert missed.max() < 1e-9


@pytest.mark.parametrize("cycles", [8, 64])
def test_aliasing_cosine(cycles):
    """A grid of step 1/cycles sees a constant slope of 1."""
    low, high = slope(lambda x, y: sp.sin(2 * sp.pi * cycles * x) / (2 * sp.pi * cycles))
    assert (low, high) == pytest.approx((-1.0, 1.0), abs=1e-6)
    grid = np.arange(-cycles, cycles + 1) / cycles
    assert np.cos(2 * np.pi * cycles * grid).min() > 1.0 - 1e-9


@pytest.mark.parametrize(
    ("row", "low", "high"),
    [
        (lambda x, y: x**4 / 4 - x**2 / 4, -0.5, 0.5),
        (lambda x, y: sp.exp(-(x**2)) * y, -np.sqrt(2 / np.e), np.sqrt(2 / np.e)),
        (lambda x, y: x**5 / 5 - x**3 / 3 + x * y**2, -0.25, 1.0),
        (lambda x, y: sp.sin(3 * x) * sp.cos(2 * y) / 3, np.cos(3), 1.0),
    ],
)
def test_entries_that_are_not_monotone(row, low, high):
    assert slope(row) == pytest.approx((low, high), abs=2e-6)


def test_pole_on_an_interior_diagonal():
    with pytest.raises(UnboundedError, match="division by an interval that contains zero") as told:
        jacobian_bounds(plant_with(lambda x, y: 1 / (x - y)))
    sub_box = told.value.sub_box
    assert max(high - low for low, high in sub_box.values()) < 1e-4
    (x_low, x_high), (y_low, y_high) = sub_box["x"], sub_box["y"]
    assert x_low <= y_high
    assert y_low <= x_high
    assert "df/dx[1,1]" in str(told.value)


@pytest.mark.long
@pytest.mark.parametrize("effort", ["fast", "normal"])
def test_an_infinite_end_is_refused_with_entry_and_box(effort):
    """Near v = 0 the slopes have no bound, whether or not the budget reaches a tiny box there."""
    plant = Plant("angle")
    a, b, v, c = plant.states("a b v c", range=[(-0.1, 0.1), (-0.6, 0.6), (0, 40), (-0.1, 0.1)])
    plant.dynamics([sp.atan(a + b / v - c) / v, -b, -v, -c])
    plant.outputs([a])
    with pytest.raises(UnboundedError, match="Keep the range of") as told:
        jacobian_bounds(plant, effort=effort)
    assert told.value.entries == ("df/dx[1,1]", "df/dx[1,2]", "df/dx[1,3]", "df/dx[1,4]")
    for box in told.value.sub_boxes.values():
        assert box["v"][0] == 0.0


@pytest.mark.parametrize("top", [300, 709, 709.78])
def test_slopes_whose_squares_are_no_doubles(top):
    """Mutant: samples of dependences that are not in units of their largest value."""
    plant = plant_with(lambda x, y: sp.exp(x), [(0, top), (-1, 1)], lambda x, y: sp.exp(x) / 2 - y)
    found = jacobian_bounds(plant, effort="fast")
    assert found.min[0, 0] <= 1.0
    assert sp.Float(float(found.max[0, 0]), 30) >= sp.exp(sp.Rational(top)).evalf(30)
    assert found.max[0, 0] == pytest.approx(np.exp(top), rel=1e-12)
    assert str(found.dependences[0]).startswith("m21 = 0.5 m11")


@pytest.mark.parametrize(
    ("row", "limits", "low", "high"),
    [
        (lambda x, y: 1 / (1 + sp.exp(-1000 * x)), (-10, 10), 0.0, 250.0),
        (lambda x, y: y / (1 + sp.exp(-x)), [(-1e5, 1e5), (-2, 1)], -0.5, 0.25),
        (lambda x, y: 1 / (3 + 2 * sp.exp(500 * x)), (-10, 10), -125 / 3, 0.0),
        (lambda x, y: sp.exp(x) / (7 + sp.exp(x)) - x, (-700, 700), -1.0, -0.75),
        (lambda x, y: 1 / (1 + sp.exp((x - y) / sp.Float(0.003))), (-9, 9), -250 / 3, 0.0),
    ],
)
def test_logistic_terms_saturate(row, limits, low, high):
    """Mutants: the lower end of an overflow is unknown; e/(c + k e) stays, or swaps c and k."""
    assert slope(row, limits) == pytest.approx((low, high), rel=1e-6, abs=1e-9)


@pytest.mark.parametrize(
    ("row", "low", "high"),
    [
        ("9e307*x**2/4", 0.0, 1.125e307),
        ("c*x + c*y", 1e308, 1e308),
        ("sin(c*x)/c", -1.0, 1.0),
        ("a*b*x + y", 1e308, 1e308),
    ],
)
def test_coefficients_near_the_largest_double(row, low, high):
    plant = Plant("large")
    plant.states("x y", range=(0, sp.Rational(1, 4)))
    plant.params("a b c", [1e154, 1e154, 1e308])
    plant.dynamics([row, "-y"])
    plant.outputs(["x"])
    found = jacobian_bounds(plant, effort="fast")
    assert (found.min[0, 0], found.max[0, 0]) == pytest.approx((low, high), rel=1e-12)


@pytest.mark.parametrize("row", ["1e308*x**2", "2*c*x", "a*c*x"])
def test_coefficients_beyond_the_largest_double_are_refused(row):
    """Mutant: values are put in before floats are rationals (OverflowError)."""
    plant = Plant("too large")
    plant.states("x", range=(0, sp.Rational(1, 4)))
    plant.params("a c", [1e154, 1e308])
    plant.dynamics([row])
    plant.outputs(["x"])
    with pytest.raises(ObsynthError, match=r"overflow|CasADi form inf"):
        jacobian_bounds(plant, effort="fast")
    # the split at one point may stay below, with coefficients that are numbers
    with contextlib.suppress(ObsynthError):
        assert np.isfinite(split(plant, linear="jacobian").A).all()


def test_no_pole_where_the_diagonal_is_left_out():
    low, high = slope(lambda x, y: 1 / (x - y), limits=[(1, 2), (-1, 0.5)])
    assert (low, high) == pytest.approx((-4.0, -1 / 9), rel=1e-6)


def test_jump_is_refused_by_its_surface():
    with pytest.raises(StructureError, match="may jump where x - y = 0"):
        jacobian_bounds(plant_with(lambda x, y: sp.Heaviside(x - y)))


# -- domains -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("row", "limits", "low", "high"),
    [
        (lambda x, y: x ** R(5, 2), (0, 1), 0.0, 2.5),
        (lambda x, y: x ** R(3, 2) * y, (0, 4), 0.0, 12.0),
        (lambda x, y: x ** R(-1, 3), (1, 8), -1 / 3, -1 / 48),
        (lambda x, y: (x + y + 2) ** R(7, 3), (-1, 1), 0.0, 7 / 3 * 4 ** (4 / 3)),
        (lambda x, y: sp.log(x) * x, (0.5, 2), np.log(0.5) + 1, np.log(2) + 1),
        (lambda x, y: sp.log(2 + x + y), (0, 1), 0.25, 0.5),
        (lambda x, y: (1 - x**2) ** R(3, 2), (-1, 1), -1.5, 1.5),
        (lambda x, y: sp.sqrt(1 - x**2), (-0.6, 0.8), -4 / 3, 0.75),
        (lambda x, y: sp.sqrt((1 - x) * (1 - y)), [(-1, 0), (-1, 0)], -1 / np.sqrt(2), -1 / 8**0.5),
        (lambda x, y: sp.asin(x), (-0.6, 0.6), 1.0, 1.25),
    ],
)
def test_powers_and_logarithms_inside_their_domain(row, limits, low, high):
    assert slope(row, limits) == pytest.approx((low, high), rel=2e-6, abs=1e-12)


@pytest.mark.parametrize(
    ("row", "limits", "operation"),
    [
        (lambda x, y: sp.sqrt(x), (0, 1), "a division"),
        (lambda x, y: sp.sqrt(x + y), (-1, 1), "a square root"),
        (lambda x, y: x ** R(5, 2), (-1, 1), "a square root"),
        (lambda x, y: x ** R(7, 3), (-1, 1), "a fractional or negative power"),
        (lambda x, y: sp.log(x), (0, 1), "a division"),
        (lambda x, y: y * sp.log(x) * x, (-1, 1), "a logarithm"),
        (lambda x, y: sp.asin(x), (-1, 1), "a division"),
    ],
)
def test_leaving_the_domain_is_named(row, limits, operation):
    with pytest.raises(UnboundedError) as told:
        jacobian_bounds(plant_with(row, limits))
    assert told.value.operation.startswith(operation)
    assert "x" in told.value.sub_box


# -- kinks: both slopes are inside, and no more than both -----------------------------------------


@pytest.mark.parametrize(
    ("row", "low", "high"),
    [
        (lambda x, y: sp.Abs(x), -1.0, 1.0),
        (lambda x, y: sp.Abs(x) * (2 + y), -3.0, 3.0),
        (lambda x, y: x * sp.Abs(x), 0.0, 2.0),
        (lambda x, y: x * x * sp.sign(x), 0.0, 2.0),
        (lambda x, y: sp.Max(x, y), 0.0, 1.0),
        (lambda x, y: sp.Min(3 * x, y), 0.0, 3.0),
        (lambda x, y: sp.Max(-R(1, 2), sp.Min(R(1, 2), 2 * x + y)), 0.0, 2.0),
        (lambda x, y: sp.Piecewise((x**2, x < 0), (3 * x, True)), -2.0, 3.0),
        (lambda x, y: sp.Piecewise((0, x < y), (x - y, True)), 0.0, 1.0),
        (lambda x, y: sp.Max(x, 0) ** 2, 0.0, 2.0),
    ],
)
def test_kinks_have_both_slopes(row, low, high):
    found = jacobian_bounds(plant_with(row))
    assert float(found.min[0, 0]) == pytest.approx(low, abs=1e-6)
    assert float(found.max[0, 0]) == pytest.approx(high, abs=1e-6)


@pytest.mark.parametrize(
    ("text", "low", "high"),
    [
        ("max(x, 2*x)", 1, 2),
        ("min(x, 3*x)", 1, 3),
        ("max(-x, -3*x)", -3, -1),
        ("-2*max(2*x, 4*x)", -8, -4),
        ("max(x/2, -x)", -1, 0.5),
        ("x + max(x, 2*x)", 2, 3),
        ("max(x, 2*x, 4*x)", 1, 4),
        ("(y + 3)*max(-x, 5*x)/4", -1, 5),
    ],
)
def test_weights_that_collapse_stay_weights(text, low, high):
    """A slope of 1, 2 or -1 leaves w, 2 w or -w of the product of a weight and a slope.

    Mutants: `_weights` that sees products alone, a sign lost in `_weighted`, `_without` that takes
    out nothing.
    """
    plant = Plant("weights")
    x, _ = plant.states("x y", range=(-1, 1))
    plant.dynamics([text, "-y"])
    plant.outputs([x])
    found = jacobian_bounds(plant, effort="fast")
    assert (found.min[0, 0], found.max[0, 0]) == pytest.approx((low, high), rel=1e-14)


def test_a_kink_outside_the_box_is_none():
    assert slope(lambda x, y: sp.Abs(x + 2) * 3, limits=(-1, 1)) == pytest.approx((3.0, 3.0))


def test_differences_lie_between_the_slopes():
    """With M between its bounds, every difference of the function is M times that of the states."""

    def row(x, y):
        return sp.Max(x * y, sp.Abs(x) - sp.Min(y, R(1, 3)))

    plant = plant_with(row)
    found = jacobian_bounds(plant, rtol=1e-3)
    function = plant.function()
    rng = np.random.default_rng(0)
    for a, b in rng.uniform(-1, 1, (300, 2, 2)):
        change = [float(function(p, [], [], [], [], [], [])[0][0]) for p in (a, b)]
        low = np.minimum(found.min[0] * (b - a), found.max[0] * (b - a)).sum()
        high = np.maximum(found.min[0] * (b - a), found.max[0] * (b - a)).sum()
        assert low - 1e-12 <= change[1] - change[0] <= high + 1e-12
