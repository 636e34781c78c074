"""Common factors of numerator and denominator: cancelled where they hurt, and only if proved."""

import numpy as np
import pytest
import sympy as sp

from obsynth.derive import UnboundedError, jacobian_bounds
from obsynth.derive.algebra.factorise import cancel_common_factors
from obsynth.symbolic import Plant

x, y = sp.symbols("x y", real=True)


def plant_with(text, ranges=((-1, 1), (-1, 1.25))):
    plant = Plant("plant")
    a, b = plant.states("x y", range=list(ranges))
    plant.dynamics([sp.sympify(text, locals={"x": a, "y": b}), -b])
    plant.outputs([a])
    return plant


@pytest.mark.parametrize(
    ("text", "low", "high"),
    [
        ("(x**2 - y**2)/(x - y)", [1, 1], [1, 1]),
        ("(x**3 - y**3)/(x - y)", [-3, -3], [3.25, 3.5]),
        ("(x**2 - y**2)/(x + y)", [1, -1], [1, -1]),
        ("y*(x - y)/(x**2 + x*y - 2*y**2 + 8*(x - y))", None, None),
    ],
)
def test_removable_surfaces_have_slopes(text, low, high):
    found = jacobian_bounds(plant_with(text))
    assert np.isfinite(found.min).all() and np.isfinite(found.max).all()
    if low is not None:
        np.testing.assert_allclose(found.min[0], low, rtol=1e-9)
        np.testing.assert_allclose(found.max[0], high, rtol=1e-9)


@pytest.mark.parametrize(
    "text", ["(x**2 + y**2)/(x - y)", "(x**2 - 1)/(x - 1)**2", "(x - y)/(x**2 - y**2)"]
)
def test_poles_stay(text):
    with pytest.raises(UnboundedError):
        jacobian_bounds(plant_with(text))


def test_forms_are_kept_where_the_denominator_has_no_zero():
    typed = (x**2 - y**2) / (x - y)
    assert cancel_common_factors(typed, lambda part: False) is None
    assert cancel_common_factors(typed, lambda part: True) == x + y


def test_a_wrong_quotient_is_not_used(monkeypatch):
    monkeypatch.setattr(sp, "cancel", lambda e: x - y)
    assert cancel_common_factors((x**2 - y**2) / (x - y), lambda part: True) is None
