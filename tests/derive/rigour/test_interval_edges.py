"""Interval operations at their edges: zeros, underflow, what is not known."""

import math
from fractions import Fraction
from itertools import product

import casadi as ca
import numpy as np
import pytest

from obsynth.derive.intervals.program import Program, evaluate
from obsynth.derive.intervals.rules import RULES, uncertain
from obsynth.derive.rigour import interval as arithmetic


def interval(lo, hi):
    return np.array([lo], dtype=float), np.array([hi], dtype=float)


def ends(result):
    return float(result[0][0]), float(result[1][0])


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ((1, 2), (0, 4), (0.25, np.inf)),
        ((-2, -1), (0, 4), (-np.inf, -0.25)),
        ((1, 2), (-4, 0), (-np.inf, -0.25)),
        ((-2, -1), (-4, 0), (0.25, np.inf)),
        ((1, 2), (-1, 4), (np.nan, np.nan)),
        ((-1, 2), (0, 4), (np.nan, np.nan)),
        ((1, 2), (0, 0), (np.nan, np.nan)),
        ((0, 0), (1, 2), (0.0, 0.0)),
    ],
)
def test_division_by_intervals_that_touch_zero(a, b, expected):
    with np.errstate(all="ignore"):
        found = ends(arithmetic.divide(interval(*a), interval(*b)))
    np.testing.assert_allclose(found, expected, rtol=1e-15)


def test_exact_zeros_stay_exact():
    zero, some = interval(0, 0), interval(0.1, 0.3)
    assert ends(arithmetic.multiply(zero, some)) == (0.0, 0.0)
    assert ends(arithmetic.multiply(interval(0, 2), some))[0] == 0.0
    assert ends(arithmetic.add(interval(-1, 1), interval(1, 1)))[0] == 0.0
    assert ends(arithmetic.power_int(interval(-1, 2), 2))[0] == 0.0
    assert ends(arithmetic.sqrt(zero)) == (0.0, 0.0)


@pytest.mark.parametrize("rule", ["add", "subtract", "square"])
def test_rounding_only_where_there_is_some(rule):
    rng = np.random.default_rng(0)
    short = rng.integers(-(2**20), 2**20, 400) / 2.0**12
    long = rng.normal(size=400) * 2.0 ** rng.integers(-40, 40, 400)
    a, b = np.concatenate([short, long]), np.concatenate([short[::-1], long[::-1]])
    operation = {
        "add": lambda x, y: x + y,
        "subtract": lambda x, y: x - y,
        "square": lambda x, _: x * x,
    }[rule]
    points = ((a, a),) if rule == "square" else ((a, a), (b, b))
    extra = (2,) if rule == "square" else ()
    name = "power_int" if rule == "square" else rule
    lo, hi = getattr(arithmetic, name)(*points, *extra)
    for x, y, low, high in zip(a, b, lo, hi, strict=True):
        exact = operation(Fraction(x), Fraction(y))
        assert Fraction(low) <= exact <= Fraction(high)
        assert high <= np.nextafter(np.nextafter(low, np.inf), np.inf)
    assert (lo[:400] == hi[:400]).all()


@pytest.mark.parametrize(("sign", "side"), [(-1.0, 0), (1.0, 1)])
def test_sums_rounded_the_wrong_way_are_caught(monkeypatch, sign, side):
    real = arithmetic._sum

    def wrong(a, b):
        total, rest = real(a, b)
        return total, np.abs(rest) * -sign

    monkeypatch.setattr(arithmetic, "_sum", wrong)
    a, b = np.random.default_rng(0).normal(size=(2, 100))
    found = arithmetic.add((a, a), (b, b))[side]
    exact = [Fraction(x) + Fraction(y) for x, y in zip(a, b, strict=True)]
    beyond = [sign * (e - Fraction(v)) > 0 for e, v in zip(exact, found, strict=True)]
    assert any(beyond)


def test_underflow_is_no_exact_zero():
    tiny = interval(1e-200, 1e-200)
    lo, hi = ends(arithmetic.multiply(tiny, arithmetic.negate(tiny)))
    assert lo < 0.0 <= hi
    lo, hi = ends(arithmetic.multiply(tiny, tiny))
    assert lo == 0.0 < hi


def test_unknown_operands_stay_unknown():
    nothing = interval(np.nan, np.nan)
    for rule in (arithmetic.add, arithmetic.multiply, arithmetic.subtract, arithmetic.minimum):
        assert np.isnan(ends(rule(nothing, interval(1, 2)))).all()
    for rule in (arithmetic.absolute, arithmetic.sqrt, arithmetic.negate):
        assert np.isnan(ends(rule(nothing))).all()


SMALL = [(lo, hi) for lo in range(-2, 3) for hi in range(lo, 3)]
TRUTHS = [(0, 0), (0, 1), (1, 1)]
LAWS = {
    "less": lambda a, b: float(a < b),
    "less_equal": lambda a, b: float(a <= b),
    "equal": lambda a, b: float(a == b),
    "conjunction": lambda a, b: float(bool(a and b)),
    "disjunction": lambda a, b: float(bool(a or b)),
    "remainder": lambda a, b: math.fmod(a, b) if b else None,
    "copysign": lambda a, b: abs(a) * (1 if b > 0 else -1) if b else None,
    "sign": lambda a: float(a > 0) - float(a < 0),
    "floor": math.floor,
    "ceiling": math.ceil,
    "logical_not": lambda a: float(not a),
    "if_else_zero": lambda c, a: a if c else 0.0,
    "select": lambda c, a, b: a if c else b,
}


@pytest.mark.parametrize("name", LAWS)
def test_choices_hold_every_member_and_are_sharp_where_they_are_decided(name):
    """All small intervals, all their integers. Mutants: an end, a side or a condition changed."""
    rule, law = RULES[name], LAWS[name]
    count = law.__code__.co_argcount if hasattr(law, "__code__") else 1
    kinds = [TRUTHS if name in ("conjunction", "disjunction", "logical_not") else SMALL] * count
    if name in ("if_else_zero", "select"):
        kinds[0] = TRUTHS
    for boxes in product(*kinds):
        lo, hi = ends(rule(*(interval(*box) for box in boxes)))
        members = product(*(range(box[0], box[1] + 1) for box in boxes))
        values = [v for v in (law(*member) for member in members) if v is not None]
        if name == "remainder" and boxes[1][0] <= 0 <= boxes[1][1]:
            assert np.isnan(lo) and np.isnan(hi)
            continue
        assert lo <= min(values, default=lo) <= max(values, default=hi) <= hi
        if name not in ("remainder", "copysign"):
            assert (lo, hi) == (min(values), max(values)), boxes


@pytest.mark.parametrize("name", ["asin", "acos", "atanh", "log", "log1p", "acosh"])
def test_functions_are_known_inside_their_domain_and_nowhere_else(name):
    """Mutants: a border of the domain on the wrong side."""
    rule, (low, high) = (
        RULES[name],
        {"log": (0, 9), "log1p": (-1, 9), "acosh": (1, 9)}.get(name, (-1, 1)),
    )
    within, beyond = low + 0.25 * (high - low), low + 0.75 * (high - low)
    with np.errstate(all="ignore"):
        assert np.isfinite(ends(rule(interval(within, beyond)))).all()
        assert np.isnan(ends(rule(interval(low - 0.5, within)))).all()
        if high < 9:
            assert np.isnan(ends(rule(interval(within, high + 0.5)))).all()


@pytest.mark.parametrize("name", ["remainder", "copysign"])
def test_a_jump_inside_is_told_and_none_where_there_is_none(name):
    """fmod(a, b) is a where |a| < |b|; copysign(a, b) jumps where b does. Mutants: an end moved."""
    for a, b in product(SMALL, SMALL):
        operands = [interval(*a), interval(*b)]
        with np.errstate(all="ignore"):
            rough = bool(uncertain(name, RULES[name](*operands), operands)[0])
        if name == "copysign":
            assert rough == (b[0] <= 0 <= b[1])
        else:
            least = 0 if b[0] <= 0 <= b[1] else min(map(abs, b))
            assert rough == (max(map(abs, a)) >= least)


@pytest.mark.parametrize("end", [0, 1])
def test_what_one_end_does_not_know_is_not_known(monkeypatch, end):
    """A rule that knows one end only. Mutant: one end asked."""

    def rule(a):
        known = list(a)
        known[end] = np.full_like(a[end], np.nan)
        return known[0], known[1]

    monkeypatch.setitem(RULES, "sinh", rule)
    x = ca.SX.sym("x")
    program = Program.from_casadi(ca.Function("f", [x], [ca.sinh(x)]))
    lower, upper = evaluate(program, np.array([[1.0]]), np.array([[2.0]]))
    assert (lower[0, 0], upper[0, 0]) == (-np.inf, np.inf)


def test_a_cube_that_overflows_has_a_lower_end():
    x = ca.SX.sym("x")
    program = Program.from_casadi(ca.Function("cube", [x], [x**3]))
    lower, upper = evaluate(program, np.array([[1e150]]), np.array([[1e150]]))
    assert 1.79e308 < lower[0, 0] < upper[0, 0] == np.inf


def beyond(rng):
    """An end, and exact numbers inside near it: past the largest double where it is infinite."""
    sign = Fraction(int(rng.choice([-1, 1])))
    kind = rng.integers(4)
    if kind == 0:
        return float(sign) * np.inf, [sign * Fraction(2) ** int(k) for k in (0, 1023, 1024, 2100)]
    value = float(sign) * float(rng.choice([0.0, 1.0, rng.random() * 2.0 ** rng.integers(-900, 3)]))
    value = float(np.clip(value, -1.5, 1.5)) * 2.0**1023 if kind == 1 else value
    return value, [Fraction(value)]


@pytest.mark.parametrize("name", ["add", "subtract", "multiply", "divide", "twice", "power_int"])
def test_an_infinite_end_is_no_number_but_what_lies_beyond_all_of_them(name):
    """Mutants: 2 * 1e308 at least inf; nan for 0 * inf; inf / inf counted as 1."""
    rng = np.random.default_rng(5)
    exactly = {
        "add": lambda x, y: x + y,
        "subtract": lambda x, y: x - y,
        "multiply": lambda x, y: x * y,
        "divide": lambda x, y: x / y,
        "twice": lambda x, _: 2 * x,
        "power_int": lambda x, _: x**3,
    }[name]
    operands = {"twice": 1, "power_int": 1}.get(name, 2)
    known = 0
    for _ in range(800):
        points, boxes = [], []
        for _ in range(2):
            (one, near), (other, far) = beyond(rng), beyond(rng)
            if abs(one) == np.inf and one == other:
                other, far = 0.0, [Fraction(0)]
            lo, hi = sorted((one, other))
            inside = [p for p in near + far if lo <= p <= hi]
            points.append(inside + [Fraction(0)] * (lo <= 0.0 <= hi))
            boxes.append(interval(lo, hi))
        with np.errstate(all="ignore"):
            arguments = [*boxes[:operands], *([3] if name == "power_int" else [])]
            lo, hi = ends(getattr(arithmetic, name)(*arguments))
        if np.isnan(lo) or np.isnan(hi):
            assert name == "divide", "only a quotient may be unknown"
            assert boxes[1][0][0] <= 0.0 <= boxes[1][1][0]
            continue
        known += 1
        assert lo < np.inf
        assert hi > -np.inf
        for x in points[0]:
            for y in points[1]:
                if name != "divide" or y:
                    assert lo <= exactly(x, y) <= hi
    assert known > 200


@pytest.mark.parametrize("name", ["exp", "expm1", "sinh", "cosh"])
def test_functions_that_overflow_exceed_nearly_all_doubles(name):
    """Mutant: the lower end of what overflows is not known."""
    with np.errstate(all="ignore"):
        lo, hi = ends(RULES[name](interval(800, 9000)))
        inverse = ends(arithmetic.divide(interval(1, 1), RULES[name](interval(0.5, 9000))))
    assert np.finfo(float).max * (1 - 1e-14) < lo < np.inf
    assert hi == np.inf
    assert inverse == pytest.approx((0.0, 1.0 / float(getattr(np, name)(0.5))), rel=1e-14)


def test_a_pole_between_two_neighbouring_doubles_is_never_missed():
    """Mutant: without its margin the search for poles rounds past some of them."""
    from mpmath import mp

    from obsynth.derive.intervals.functions import tangent

    with mp.workdps(60):
        for k in (0, 1, -19, 22, 30, -164, 654321, *range(-250, 250, 7)):
            pole = (k + mp.mpf(1) / 2) * mp.pi
            near = float(pole)
            low = near if mp.mpf(near) < pole else float(np.nextafter(near, -np.inf))
            assert mp.mpf(low) < pole < mp.mpf(float(np.nextafter(low, np.inf)))
            assert np.isnan(ends(tangent(interval(low, np.nextafter(low, np.inf))))).all(), k
