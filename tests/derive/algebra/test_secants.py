"""Secants in closed form, against the difference quotient at 60 digits."""

import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from obsynth.derive.algebra import secants
from obsynth.derive.algebra.secants import at_zero, quotients, secant
from obsynth.derive.algebra.zero_test import prove_zero
from obsynth.symbolic.functions import phi1, tanhc

x, y, z = sp.symbols("x y z", real=True)
BOX = {x: (1.0, 3.0), y: (1.0, 3.0), z: (0.1, 2.0)}
R = sp.Rational

FUNCTIONS = [
    sp.sin(2 * z + x),
    sp.cos(12 * z) * R(3, 5) / (z**2 + 10),
    sp.sqrt(x + z),
    (x + z) ** R(2, 3),
    (x + z) ** R(-3, 2),
    (x + z) ** R(37, 100),
    sp.exp(-5 / (x + z)),
    sp.log(x + z),
    sp.tan(z / 5 + x / 9),
    sp.atan(z * y + x),
    sp.atan(z),
    sp.asin(z / 9 + x / 20),
    sp.asin(z / 9),
    sp.acos(z / 9),
    sp.acosh(z + x + 3),
    sp.asinh(z - x),
    sp.asinh(z),
    sp.atanh(z / 9),
    sp.atanh(z / 9 + x / 30),
    sp.sinh(z),
    sp.sinh(z + x),
    sp.cosh(z),
    sp.cosh(z + x),
    sp.tanh(z),
    sp.tanh(z + x),
    sp.Abs(z + x),
    z * sp.Abs(z),
    sp.sign(z) * z**2,
    sp.sign(y * z) * sp.sqrt(sp.Abs(y * z)) * sp.cos(z),
    (x + z) ** 5,
    1 / (x + z) ** 3,
    z * y / (1 + z + z**2),
    sp.Max(z + x, y),
    sp.sin(z) ** 2 * sp.cos(z + 1),
    (x + z) * (y + z) * sp.exp(z),
]


SLOW = (sp.acosh(z + x + 3), sp.atanh(z / 9 + x / 30))


@pytest.mark.parametrize(
    "function",
    [pytest.param(f, marks=pytest.mark.long if f in SLOW else ()) for f in FUNCTIONS],
    ids=str,
)
def test_a_secant_times_its_variable_is_the_difference(function):
    slope = secant(function, z)
    assert slope is not None
    start = at_zero(function, z)
    assert start is not None
    assert prove_zero(function - start - slope * z, BOX)


@pytest.mark.parametrize("function", [f for f in FUNCTIONS if not f.has(sp.sign)], ids=str)
def test_a_closed_form_has_no_quotient_that_is_undefined_at_zero(function):
    slope = secant(function, z)
    value = slope.xreplace({x: R(13, 10), y: R(17, 10)}).subs(z, 0)
    derivative = sp.diff(function, z).xreplace({x: R(13, 10), y: R(17, 10)})
    limit = derivative.subs(z, R(1, 10**30)).evalf(40)
    assert abs(value.evalf(40) - limit) < 1e-20 * max(1, abs(limit))


@pytest.mark.parametrize(
    "function", [1 / z, sp.erf(z + x), sp.sign(z), sp.floor(z), sp.log(z), x ** (1 / z), z**z]
)
def test_what_has_no_closed_form_is_not_guessed(function):
    assert secant(function, z) is None


def test_a_zero_factor_is_divided_whatever_the_others_do():
    assert secant(z * sp.log(z), z) == sp.log(z)
    assert secant(z**2 * sp.sign(z), z) == sp.Abs(z)


def test_quotients_undo_the_named_functions():
    written = quotients(sp.sinc(x) + phi1(x) + tanhc(x) + sp.sign(x))
    assert written == sp.sin(x) / x + (sp.exp(x) - 1) / x + sp.tanh(x) / x + x / sp.Abs(x)


def test_a_wrong_rule_is_seen(monkeypatch):
    monkeypatch.setitem(secants._RULES, sp.sin, lambda a, b: sp.cos((a + b) / 3) * sp.sinc(a - b))
    slope = secant(sp.sin(z + x), z)
    assert prove_zero(sp.sin(x + z) - sp.sin(x) - slope * z, BOX) == ""


_ATOMS = st.sampled_from([z, x, y, R(3, 2), z + x, 2 * z - y / 4])
_UNARY = st.sampled_from([sp.sin, sp.cos, sp.atan, sp.tanh, sp.exp, lambda e: sp.sqrt(20 + e)])
_BINARY = st.sampled_from([lambda a, b: a + b, lambda a, b: a * b, lambda a, b: a / (40 + b)])


@pytest.mark.long
@settings(max_examples=40, derandomize=True, deadline=None)
@given(
    st.recursive(
        _ATOMS,
        lambda inner: st.one_of(
            st.builds(lambda f, a: f(a / 8), _UNARY, inner),
            st.builds(lambda f, a, b: f(a, b), _BINARY, inner, inner),
        ),
        max_leaves=5,
    )
)
def test_random_functions_have_secants(function):
    function = sp.sympify(function)
    slope = secant(function, z)
    start = at_zero(function, z)
    if slope is None or start is None:
        return
    assert prove_zero(function - start - slope * z, BOX)
