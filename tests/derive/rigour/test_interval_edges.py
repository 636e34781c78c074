"""Interval operations at their edges: zeros, underflow, what is not known."""

from fractions import Fraction

import numpy as np
import pytest

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
