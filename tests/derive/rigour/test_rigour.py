"""The laws of intervals and of rounding: what they promise contains the exact result.

Doubles are drawn over many orders of magnitude, zeros, equal ends and numbers near underflow
included, and judged by fractions. Without its outward step every law is broken.
"""

import math
from fractions import Fraction

import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from obsynth.derive import DerivationError
from obsynth.derive.rigour import (
    add_up,
    down,
    enclose_number,
    interval,
    lowered,
    middle_and_radius,
    outward,
    product_up,
    raised,
    rational,
    round_number,
    smallest_above,
    substitute,
    up,
)

PROPERTY = settings(derandomize=True, max_examples=60, deadline=None)
COUNT = 40
SHARES = (Fraction(0), Fraction(1, 3), Fraction(1))


def numbers(rng, count=COUNT):
    """Doubles of every kind: long, short, tiny, zero."""
    long = rng.normal(size=count) * 10.0 ** rng.uniform(-12, 12, count)
    short = rng.integers(-(2**10), 2**10, count) / 2.0**5
    tiny = rng.normal(size=count) * 2.0**-530
    return np.select([rng.random(count) < 0.4, rng.random(count) < 0.8], [long, short], tiny)


def intervals(rng, low=-np.inf):
    a, b = np.maximum(numbers(rng), low), np.maximum(numbers(rng), low)
    b = np.where(rng.random(COUNT) < 0.2, a, b)
    return np.minimum(a, b), np.maximum(a, b)


def members(a):
    """For every interval some members, both ends included."""
    return [
        [Fraction(lo) + share * (Fraction(hi) - Fraction(lo)) for share in SHARES]
        for lo, hi in zip(*(end.tolist() for end in a), strict=True)
    ]


# -- intervals -------------------------------------------------------------------------------------

ONE = {
    "negate": lambda x: -x,
    "twice": lambda x: 2 * x,
    "absolute": abs,
    "square": lambda x: x**2,
    "cube": lambda x: x**3,
    "fourth": lambda x: x**4,
    "with_zero": lambda x: x,
}
POWERS = {"square": 2, "cube": 3, "fourth": 4}
TWO = {
    "add": lambda x, y: x + y,
    "subtract": lambda x, y: x - y,
    "multiply": lambda x, y: x * y,
    "divide": lambda x, y: x / y if y else None,
    "minimum": min,
    "maximum": max,
}


def escaped(name, seed):
    """How many exact results for members leave the interval."""
    rng = np.random.default_rng(seed)
    a, b = intervals(rng), intervals(rng)
    with np.errstate(all="ignore"):
        if name in POWERS:
            lo, hi = interval.power_int(a, POWERS[name])
        else:
            lo, hi = getattr(interval, name)(*((a, b) if name in TWO else (a,)))
    found = 0
    for k, (of_a, of_b) in enumerate(zip(members(a), members(b), strict=True)):
        if np.isnan(lo[k]) or np.isnan(hi[k]):
            continue
        exact = (
            [TWO[name](x, y) for x in of_a for y in of_b] if name in TWO else map(ONE[name], of_a)
        )
        found += sum(not below(lo[k], e) or not below(e, hi[k]) for e in exact if e is not None)
    return found


def below(a, b):
    """Whether a <= b, one of them a double, possibly infinite."""
    if isinstance(a, float) and np.isinf(a):
        return a < 0
    if isinstance(b, float) and np.isinf(b):
        return b > 0
    return Fraction(a) <= Fraction(b)


@pytest.mark.parametrize("name", [*ONE, *TWO])
@PROPERTY
@given(seed=st.integers(0, 10**6))
def test_an_operation_contains_the_exact_result_for_all_members(name, seed):
    assert escaped(name, seed) == 0


@pytest.mark.parametrize("side", ["down", "up"])
@pytest.mark.parametrize("name", ["add", "subtract", "multiply", "divide", "square", "cube"])
def test_an_operation_that_is_not_rounded_outwards_is_caught(name, side, monkeypatch):
    monkeypatch.setattr(interval, side, lambda value: value)
    if name == "cube":
        monkeypatch.setattr(interval, "_EPS", 0.0)
    assert sum(escaped(name, seed) for seed in range(5))


def roots_escaped(seed):
    a = intervals(np.random.default_rng(seed), low=0.0)
    lo, hi = (end.tolist() for end in interval.sqrt(a))
    return sum(
        Fraction(lo[k]) ** 2 > x if lo[k] > 0 else False
        for k, of_a in enumerate(members(a))
        for x in of_a
    ) + sum(Fraction(hi[k]) ** 2 < x for k, of_a in enumerate(members(a)) for x in of_a)


@PROPERTY
@given(seed=st.integers(0, 10**6))
def test_roots_are_enclosed(seed):
    assert roots_escaped(seed) == 0


@pytest.mark.parametrize("side", ["down", "up"])
def test_roots_that_are_not_rounded_outwards_are_caught(side, monkeypatch):
    monkeypatch.setattr(interval, side, lambda value: value)
    assert roots_escaped(0) > 0


def test_what_only_selects_is_exact():
    rng = np.random.default_rng(0)
    a, b = intervals(rng), intervals(rng)
    lo, hi = interval.hull(a, b)
    assert (lo == np.minimum(a[0], b[0])).all()
    assert (hi == np.maximum(a[1], b[1])).all()
    nothing = np.full(COUNT, np.nan), np.full(COUNT, np.nan)
    for found in (interval.meet(a, nothing), interval.meet(nothing, a), interval.meet(a, a)):
        assert (found[0] == a[0]).all()
        assert (found[1] == a[1]).all()
    lo, hi = interval.nonnegative(a)
    assert np.isnan(lo[a[0] < 0]).all()
    assert (lo[a[0] >= 0] == a[0][a[0] >= 0]).all()


# -- rounding --------------------------------------------------------------------------------------


def one_sided(seed):
    """Verdicts on sums and products that are rounded to one side."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 12))
    a, b = (np.abs(numbers(rng, 4 * n)).reshape(4, n) for _ in range(2))
    left = [[Fraction(v) for v in row] for row in a.tolist()]
    right = [[Fraction(v) for v in row] for row in b.tolist()]
    product = a @ b.T
    exact = [[sum(x * y for x, y in zip(r, s, strict=True)) for s in right] for r in left]
    total = [[x + y for x, y in zip(r, s, strict=True)] for r, s in zip(left, right, strict=True)]

    def everywhere(found, wanted, sign):
        return all(
            sign * (Fraction(f) - w) >= 0
            for row, of in zip(found.tolist(), wanted, strict=True)
            for f, w in zip(row, of, strict=True)
        )

    return {
        "product_up": everywhere(product_up(a, b.T), exact, 1),
        "add_up": everywhere(add_up(a, b), total, 1),
        "raised": everywhere(raised(product, n), exact, 1),
        "lowered": everywhere(lowered(product, n), exact, -1),
    }


@PROPERTY
@given(seed=st.integers(0, 10**6))
def test_sums_and_products_lie_on_their_side(seed):
    assert all(one_sided(seed).values())


def test_without_the_factor_or_the_underflow_they_do_not(monkeypatch):
    monkeypatch.setattr(interval, "gamma_bound", lambda n: 0.0)
    monkeypatch.setattr(interval, "TINY", 0.0)
    verdicts = [one_sided(seed) for seed in range(10)]
    assert all(not all(v[name] for v in verdicts) for name in verdicts[0])


def test_underflow_is_raised_over():
    tiny = np.full((1, 1), 2.0**-600)
    assert Fraction(float(product_up(tiny, tiny)[0, 0])) > Fraction(2) ** -1200
    assert lowered(tiny @ tiny, 1)[0, 0] == 0.0


@PROPERTY
@given(value=st.fractions(-(10**6), 10**6), scale=st.integers(-330, 300))
def test_the_smallest_double_above(value, scale):
    value *= Fraction(10) ** scale
    found = smallest_above(value)
    assert Fraction(float(down(np.array(found)))) < value <= Fraction(found)


def uncovered(seed):
    rng = np.random.default_rng(seed)
    low, high = intervals(rng)
    middle, radius = (v.tolist() for v in middle_and_radius(low, high))
    return sum(
        max(Fraction(h) - Fraction(m), Fraction(m) - Fraction(lo)) > Fraction(r)
        for lo, h, m, r in zip(low.tolist(), high.tolist(), middle, radius, strict=True)
    )


@PROPERTY
@given(seed=st.integers(0, 10**6))
def test_middle_and_radius_hold_the_interval(seed):
    assert uncovered(seed) == 0
    low, _ = intervals(np.random.default_rng(seed))
    assert (middle_and_radius(low, low)[1] == 0.0).all()


def test_a_radius_that_is_not_rounded_up_is_caught(monkeypatch):
    monkeypatch.setattr(interval, "up", lambda value: value)
    assert sum(uncovered(seed) for seed in range(5))


def test_an_unbounded_interval_has_an_infinite_radius():
    middle, radius = middle_and_radius(np.array([-np.inf, 0.0]), np.array([1.0, np.inf]))
    assert middle.tolist() == [0.0, 0.0]
    assert radius.tolist() == [np.inf, np.inf]


@PROPERTY
@given(seed=st.integers(0, 10**6))
def test_boxes_of_a_precision_hold_the_given_one(seed):
    rng = np.random.default_rng(seed)
    box = np.sort(rng.normal(size=(6, 2)) * 10.0 ** rng.uniform(-6, 6, (6, 1)), axis=1)
    assert (outward(box, "double") == box).all()
    single = outward(box, "single")
    assert (single.astype(np.float32) == single).all()
    assert (single[:, 0] <= box[:, 0]).all()
    assert (single[:, 1] >= box[:, 1]).all()
    assert (outward(single, "single") == single).all()


def test_one_step_is_one_double():
    at = numbers(np.random.default_rng(0))
    assert (down(up(at)) == at).all()
    assert (down(at) < at).all()


# -- numbers of SymPy ------------------------------------------------------------------------------

IRRATIONAL = st.builds(
    lambda p, q, f: f(sp.Rational(p, q)),
    st.integers(1, 10**4),
    st.integers(20, 10**6),
    st.sampled_from([sp.sqrt, sp.exp, lambda v: -sp.pi * v, lambda v: v, lambda v: -v / 3]),
)


def number_is_bounded(number):
    value, error = round_number(number)
    lo, hi = enclose_number(number)
    return bool(
        sp.Abs(number - rational(value)) <= rational(error)
        and rational(lo) <= number <= rational(hi)
    )


@PROPERTY
@given(number=IRRATIONAL)
def test_rounding_of_exact_numbers_is_bounded(number):
    assert number_is_bounded(number)


@pytest.mark.parametrize(
    "number",
    [sp.Rational(1, 3), sp.sqrt(2), sp.pi / 7, -sp.exp(1), sp.Rational(10**40, 3), sp.Integer(0)],
)
def test_the_bound_of_the_rounding_is_half_a_unit(number):
    assert number_is_bounded(number)
    value, error = round_number(number)
    assert error <= 2.3e-16 * max(abs(value), 1e-300) or number == 0
    lo, hi = enclose_number(number)
    assert (lo == hi) == (number.is_Rational and rational(float(number)) == number)


ZERO = sp.sqrt(5 + 2 * sp.sqrt(6)) - sp.sqrt(2) - sp.sqrt(3)


@pytest.mark.parametrize(
    "zero",
    [ZERO, -3 * ZERO, ZERO**2, sp.sqrt(1 + ZERO) - 1, sp.exp(ZERO) - 1 + ZERO],
    ids=["difference", "multiple", "square", "root", "exponential"],
)
def test_an_exact_zero_that_sympy_does_not_see_is_enclosed(zero):
    """And a number next to it is.

    Mutants: `_decimal` by evalf alone (-9e-190 without 0); the radius left out of the error.
    """
    for number, near in ((zero, 0.0), (zero + sp.Rational(1, 10**200), 1e-200), (zero + 1, 1.0)):
        lo, hi = enclose_number(number)
        assert lo <= near <= hi
        assert hi - lo <= 1e-100 + 1e-15 * near
        value, error = round_number(number)
        assert abs(value - near) <= error + 1e-300


@pytest.mark.parametrize("function", sorted(interval._ANALYTIC))
def test_functions_of_numbers_agree_with_sympy(function):
    """Balls of Arb against SymPy's own evaluation. Mutant: any name that means something else."""
    at = sp.Rational(7, 3) if function == "acosh" else sp.Rational(3, 7)
    number = getattr(sp, function)(at)
    middle, radius = interval._decimal(number)
    assert abs(middle.evalf(60) - number.evalf(60)) <= sp.Float("1e-58")
    assert 0 < radius < 1e-100


def test_a_rounding_whose_error_is_not_told_is_caught(monkeypatch):
    from obsynth.derive.rigour import interval as module

    monkeypatch.setattr(module, "smallest_above", lambda value: 0.0)
    assert not number_is_bounded(sp.Rational(1, 3))


def test_no_number_is_refused():
    with pytest.raises(DerivationError, match="not a finite real number"):
        round_number(sp.zoo)
    with pytest.raises(DerivationError, match="not a finite real number"):
        round_number(sp.Symbol("x"))
    for large in (sp.exp(710), -(sp.Integer(10) ** 400)):
        with pytest.raises(DerivationError, match="too large"):
            round_number(large)


def test_doubles_in_expressions_become_the_rationals_they_are():
    x, c = sp.symbols("x c")
    found = substitute(0.1 * x + c, {c: sp.Rational(1, 3)})
    assert found == rational(0.1) * x + sp.Rational(1, 3)
    assert rational(0.1) != sp.Rational(1, 10)


def test_products_of_doubles_are_not_rounded_on_the_way():
    """Mutant: values are put in before floats are rationals, so that SymPy rounds their product."""
    x, a, b = sp.symbols("x a b")
    values = {a: sp.Float(0.1), b: sp.Float(0.3)}
    assert substitute(a * b * x, values) == rational(0.1) * rational(0.3) * x
    largest = {a: sp.Float(1e308), b: sp.Float(1e308)}
    assert substitute(2 * a * b * x, largest) == 2 * rational(1e308) ** 2 * x
    with pytest.raises(DerivationError, match="too large for a double"):
        round_number(substitute(2 * a, largest))
    with pytest.raises(DerivationError, match="inf is no rational number"):
        rational(math.inf)
