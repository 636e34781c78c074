"""Random expressions against samples in large numbers; 300 bits decide where doubles cannot."""

from dataclasses import replace

import casadi as ca
import flint
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from obsynth.derive.intervals.ranges import bound_ranges

X = ca.SX.sym("x", 3)
JUDGED = 40

UNARY = {
    "sin": ca.sin,
    "cos": ca.cos,
    "tan": lambda a: ca.tan(a / 2),
    "exp": lambda a: ca.exp(-a),
    "tanh": ca.tanh,
    "atan": ca.atan,
    "square": lambda a: a * a,
    "cube": lambda a: a**3,
    "root": ca.sqrt,
    "root of more": lambda a: ca.sqrt(a * a + 0.1),
    "fraction": lambda a: a**1.5,
    "third": lambda a: ca.fabs(a) ** (1 / 3),
    "logarithm": ca.log,
    "logarithm of more": lambda a: ca.log(1.5 + ca.sin(a)),
    "inverse": lambda a: 1 / (a - 0.3),
    "bell": lambda a: 1 / (1 + 25 * a * a),
    "quotient": lambda a: ca.sin(a) / a,
    "abs": ca.fabs,
    "sign": ca.sign,
    "floor": ca.floor,
}
BINARY = {
    "add": lambda a, b: a + b,
    "subtract": lambda a, b: a - b,
    "multiply": lambda a, b: a * b,
    "divide": lambda a, b: a / (b * b + 0.2),
    "max": ca.fmax,
    "min": ca.fmin,
    "choice": lambda a, b: ca.if_else(a < b, a + b, 2 * a),
    "angle": lambda a, b: ca.atan2(a, b + 1.5),
}


@st.composite
def expressions(draw, depth=4):
    if depth == 0 or draw(st.integers(0, 7)) == 0:
        return draw(st.sampled_from([X[0], X[1], X[2], X[0] - X[1], 0.7 * X[2] + 0.1]))
    if draw(st.booleans()):
        return UNARY[draw(st.sampled_from(sorted(UNARY)))](draw(expressions(depth=depth - 1)))
    name = draw(st.sampled_from(sorted(BINARY)))
    return BINARY[name](draw(expressions(depth=depth - 1)), draw(expressions(depth=depth - 1)))


@st.composite
def boxes(draw):
    ends = []
    for _ in range(3):
        low = draw(st.sampled_from([-2.0, -1.0, -0.1, 0.0, 0.25, 1.0]))
        ends.append((low, low + draw(st.sampled_from([0.0, 0.1, 1.0, 3.0]))))
    return np.array(ends)


def outside(exactly, function, found, box, count):
    """Samples beyond the bounds; the closest calls are decided by balls of 300 bits."""
    rng = np.random.default_rng(0)
    bad = []
    for start in range(0, count, 200_000):
        share = rng.random((3, min(200_000, count - start)))
        share = np.where(rng.random(share.shape) < 0.1, np.round(share), share)
        points = np.clip(box[:, :1] + share * (box[:, 1:] - box[:, :1]), box[:, :1], box[:, 1:])
        values = np.array(function(points)).ravel()
        with np.errstate(invalid="ignore"):
            beyond = np.maximum(values - found.upper[0], found.lower[0] - values)
        beyond[~np.isfinite(beyond)] = -np.inf
        doubtful = [points[:, k] for k in np.argsort(-beyond)[:JUDGED] if beyond[k] > 0.0]
        bad += [point for point in doubtful if is_outside(exactly, function, found, point)]
    return bad


def is_outside(exactly, function, found, point):
    try:
        (ball,) = exactly(function, point)
    except ArithmeticError:
        return False
    low, high = flint.arb(found.lower[0]), flint.arb(found.upper[0])
    return bool(ball.is_finite() and (ball < low or ball > high))


def not_attained(exactly, function, found):
    """Ends whose attained value is not attained at its point."""
    bad = []
    for value, point, sign in (
        (found.attained_lower[0], found.points_lower[0], 1),
        (found.attained_upper[0], found.points_upper[0], -1),
    ):
        try:
            (ball,) = exactly(function, point)
        except ArithmeticError:
            continue
        if np.isfinite(value) and ball.is_finite() and sign * ball > sign * flint.arb(value):
            bad.append((value, point))
    return bad


def check(exactly, expression, box, count):
    found = bound_ranges(expression, X, box, rtol=1e-4, effort="fast")
    function = ca.Function("f", [X], [ca.densify(expression)])
    assert not outside(exactly, function, found, box, count)
    assert not not_attained(exactly, function, found)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(expression=expressions(), box=boxes())
def test_samples_of_random_expressions_stay_inside(exactly, expression, box):
    check(exactly, expression, box, 20_000)


@pytest.mark.long
@settings(max_examples=200, deadline=None, derandomize=True)
@given(expression=expressions(depth=5), box=boxes())
def test_a_million_samples_of_each_of_200_expressions_stay_inside(exactly, expression, box):
    check(exactly, expression, box, 1_000_000)


@pytest.mark.parametrize("side", ["lower", "upper"])
def test_bounds_that_are_a_little_too_narrow_are_caught(exactly, side):
    expression = ca.sin(3 * X[0] + X[1]) * ca.exp(-X[2]) / (1.2 + X[0])
    box = np.array([(-1.0, 2.0), (0.0, 1.0), (0.0, 2.0)])
    found = bound_ranges(expression, X, box, rtol=1e-6)
    function = ca.Function("f", [X], [expression])
    assert not outside(exactly, function, found, box, 50_000)
    assert not not_attained(exactly, function, found)
    width = found.upper - found.lower
    moved = {"lower": found.lower + 1e-2 * width, "upper": found.upper - 1e-2 * width}[side]
    assert outside(exactly, function, replace(found, **{side: moved}), box, 50_000)
    sign = -1 if side == "lower" else 1
    name = f"attained_{side}"
    wrong = replace(found, **{name: getattr(found, name) + sign * 1e-9 * width})
    assert not_attained(exactly, function, wrong)
