"""Quotients that are smooth where their divisor is zero: recognised exactly, bounded with proof."""

import casadi as ca
import flint
import mpmath
import numpy as np
import pytest
import sympy as sp

from obsynth.derive import UnboundedError, jacobian_bounds
from obsynth.derive.intervals import rules
from obsynth.derive.intervals.ranges import Status, bound_ranges
from obsynth.derive.intervals.rewriting import quotients, removable
from obsynth.derive.rigour import interval as arithmetic
from obsynth.symbolic import Plant
from obsynth.symbolic.functions import BY_NAME, phi1, tanhc

X = ca.SX.sym("x", 3)
C = ca.SX.sym("c")
THIRD = [(0.3, np.nextafter(0.3, 1))]
BOX = np.array([(-1.0, 2.0), (-1.0, 2.0), (0.5, 2.0)])
x, y, z = X[0], X[1], X[2]
S1 = np.sin(2.0) / 2.0

REMOVABLE = {
    "sine": (ca.sin(x) / x, S1, 1.0),
    "exponential of a difference": ((ca.exp(x - y) - 1) / (x - y), -np.expm1(-3) / 3, None),
    "upside down": (x / (ca.exp(x) - 1), 2 / np.expm1(2), 1 / (1 - np.exp(-1))),
    "tangent": (ca.tanh(x) / x, np.tanh(2) / 2, 1.0),
    "both": (x / ca.tanh(x), 1.0, 2 / np.tanh(2)),
    "two orders": ((1 - ca.cos(x)) / x**2, (1 - np.cos(2)) / 4, 0.5),
    "a derivative": (ca.cos(x) / x - ca.sin(x) / x**2, None, None),
    "zero elsewhere": (ca.log(z) / (z - 1), np.log(2), 2 * np.log(2)),
    "among other factors": (ca.exp(y) * ca.sin(x) * z / x, None, np.exp(2) * 2),
    "faster": (ca.sin(2 * x) / x, None, 2.0),
    "faster by a variable": (ca.sin(z * x) / x, None, 2.0),
    "two of them": (ca.sin(x) * ca.sin(y) / (x * y), S1**2, 1.0),
    "with a constant": (ca.sin(C * x) / x, None, None),
    "one in another": (ca.sin(ca.sin(x) / x - 1) / (ca.sin(x) / x - 1), None, 1.0),
    "of itself": (x * y / x, -1.0, 2.0),
    "named sinc": (BY_NAME["sinc"].casadi(x * y), None, 1.0),
    "named phi1": (BY_NAME["phi1"].casadi(x), -np.expm1(-1), np.expm1(2) / 2),
    "named tanhc": (BY_NAME["tanhc"].casadi(x + y), np.tanh(4) / 4, 1.0),
}
POLES = {
    "cosine": ca.cos(x) / x,
    "too high a power": ca.sin(x) / x**2,
    "sine of another": ca.sin(y) / x,
    "a kink": ca.fabs(x) / x,
    "nearly": (ca.exp(x) - 1 - 2.0**-40) / x,
    "a root": ca.sqrt(ca.fabs(x)) / x,
}


def violations(exactly, expression, found):
    """Points with a value beyond the bounds, and attained values that are not attained."""
    function = ca.Function("f", [X, C], [expression])
    rng = np.random.default_rng(0)
    points = BOX[:, 0] + rng.random((60, 3)) * (BOX[:, 1] - BOX[:, 0])
    points[:20, 0] *= 1e-9
    points[10:30, 1] = points[10:30, 0] * (1 + 1e-5)
    low, high = flint.arb(found.lower[0]), flint.arb(found.upper[0])
    bad = []
    for point in np.clip(points, BOX[:, 0], BOX[:, 1]):
        (ball,) = exactly(function, [*point, 0.3])
        if ball.is_finite() and (ball < low or ball > high):
            bad.append(point)
    for value, point, sign in (
        (found.attained_lower[0], found.points_lower[0], 1),
        (found.attained_upper[0], found.points_upper[0], -1),
    ):
        # at the singularity itself the next double has the same value to many digits
        moved = np.where(point == 0.0, 1e-200, point)
        (ball,) = exactly(function, [*moved, 0.3])
        if ball.is_finite() and sign * (ball - flint.arb(value)) > 1e-12:
            bad.append((value, point))
    return bad


@pytest.mark.parametrize("name", sorted(REMOVABLE))
def test_smooth_quotients_are_bounded(exactly, name):
    expression, low, high = REMOVABLE[name]
    found = bound_ranges(expression, X, BOX, C, THIRD, rtol=1e-6)
    assert found.status[0] in (Status.EXACT, Status.CONVERGED)
    width = found.upper[0] - found.lower[0]
    assert found.gap[0] <= 1.1e-6 * width
    assert not violations(exactly, expression, found)
    for expected, reached in ((low, found.lower[0]), (high, found.upper[0])):
        if expected is not None:
            assert reached == pytest.approx(expected, abs=1e-6 * width + 1e-14)


@pytest.mark.parametrize("name", sorted(POLES))
def test_poles_stay_poles(name):
    found = bound_ranges(POLES[name], X, BOX)
    assert found.status[0] is Status.UNBOUNDED
    assert found.failures[0].operation == "a division by an interval that contains zero"


def test_no_search_where_nothing_is_singular():
    assert removable.remove_singularities(ca.sin(x) / z, X, C, BOX, THIRD) is None
    away = np.array([(0.5, 2.0)] * 3)
    assert removable.remove_singularities(ca.sin(x) / x, X, C, away, THIRD) is None


def broken_weight(monkeypatch):
    real = quotients.Quotient.mean

    def mean(self, derivative):
        expression, weight = real(self, derivative)
        return expression, weight + 1

    monkeypatch.setattr(quotients.Quotient, "mean", mean)


def forgotten_way_to_zero(monkeypatch):
    monkeypatch.setitem(rules.RULES, "with_zero", lambda a: a)


def derivative_of_the_wrong_order(monkeypatch):
    real = quotients.Quotient.mean
    monkeypatch.setattr(quotients.Quotient, "mean", lambda self, k: real(self, k + 1))


def meeting_too_tight(monkeypatch):
    monkeypatch.setitem(rules.RULES, "meet", lambda a, b: (a[0] + 0.1, b[1] - 0.1))


@pytest.mark.parametrize(
    "mutant",
    [
        broken_weight,
        forgotten_way_to_zero,
        derivative_of_the_wrong_order,
        meeting_too_tight,
    ],
)
def test_wrong_quotients_are_caught(exactly, monkeypatch, mutant):
    mutant(monkeypatch)
    caught = []
    for name in ("sine", "two orders", "among other factors", "named phi1"):
        expression = REMOVABLE[name][0]
        found = bound_ranges(expression, X, BOX, C, THIRD, rtol=1e-6)
        caught += violations(exactly, expression, found)
    assert caught


def test_an_order_that_is_not_checked_is_caught(exactly, monkeypatch):
    monkeypatch.setattr(removable, "_order", lambda function, symbol: 1)
    found = bound_ranges(POLES["cosine"], X, BOX)
    assert violations(exactly, POLES["cosine"], found)


def test_meeting_intervals():
    some, nothing = (np.array([1.0]), np.array([3.0])), (np.array([np.nan]), np.array([np.nan]))
    other = (np.array([2.0]), np.array([5.0]))
    assert [float(v[0]) for v in arithmetic.meet(some, other)] == [2.0, 3.0]
    assert [float(v[0]) for v in arithmetic.meet(some, nothing)] == [1.0, 3.0]
    assert [float(v[0]) for v in arithmetic.with_zero(some)] == [0.0, 3.0]


# -- plants ------------------------------------------------------------------------------------

ROWS = {
    "as typed": lambda a, b, k, c: sp.sin(a) / a,
    "named": lambda a, b, k, c: sp.sinc(a * b) * b,
    "of a difference": lambda a, b, k, c: phi1(a - b) * a,
    "times a parameter": lambda a, b, k, c: k * tanhc(c * a),
    "exponential": lambda a, b, k, c: (sp.exp(c * a) - 1) / a + k * b,
    "upside down": lambda a, b, k, c: b * a / (sp.exp(a) - 1),
    "pole elsewhere": lambda a, b, k, c: sp.log(b + 3) / (b + 2),
}

QUOTIENTS = {
    sp.sinc: lambda t: sp.sin(t) / t,
    phi1: lambda t: (sp.exp(t) - 1) / t,
    tanhc: lambda t: sp.tanh(t) / t,
}


def plant_with(row):
    plant = Plant("quotient")
    a, b = plant.states("a b", range=(-1, 2), nominal=0.5)
    (k,) = plant.params("k", range=(1, 2))
    (c,) = plant.params("c", sp.Rational(1, 3))
    plant.dynamics([row(a, b, k, c), -b])
    plant.outputs([a])
    return plant


@pytest.mark.parametrize("name", sorted(ROWS))
def test_jacobians_through_removable_singularities(name):
    plant = plant_with(ROWS[name])
    found = jacobian_bounds(plant)
    assert all(status in (Status.EXACT, Status.CONVERGED) for status in found.status.ravel())
    a, b, k = (s.symbol for s in (*plant.x, *plant.p))
    rhs = plant.rhs.subs(plant.constant_values)
    for function, quotient in QUOTIENTS.items():
        rhs = rhs.replace(function, quotient)
    at = sp.lambdify([a, b, k], sp.Matrix(rhs).jacobian([a, b]), "mpmath")
    rng = np.random.default_rng(1)
    with mpmath.workdps(60):
        for share in rng.random((40, 3)):
            point = [mpmath.mpf(-1 + 3 * s) for s in share[:2]] + [mpmath.mpf(1 + share[2])]
            matrix = np.array(at(*point).tolist(), dtype=float)
            assert (matrix >= found.min - 1e-13).all()
            assert (matrix <= found.max + 1e-13).all()
    tight = (found.max - found.min) * 1.1e-6 + 1e-13
    assert (found.gap <= tight).all()


def test_a_pole_of_a_plant_is_still_named():
    with pytest.raises(UnboundedError, match="division by an interval that contains zero"):
        jacobian_bounds(plant_with(lambda a, b, k, c: sp.cos(a) / a))
