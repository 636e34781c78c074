"""The proof of identities, and what it says when there is none."""

import pytest
import sympy as sp

from obsynth.derive.algebra import zero_test
from obsynth.derive.algebra.zero_test import NUMERIC, FormProof, is_zero, prove_zero, varies

x, y = sp.symbols("x y", real=True)


@pytest.mark.parametrize(
    ("expression", "method"),
    [
        (x - x, "syntactic"),
        ((x + 1) ** 2 - x**2 - 2 * x - 1, "expand"),
        (x * sp.sinc(x) - sp.sin(x), "expand"),
        (1 / (x * y) - 1 / y / x, "syntactic"),
        (1 / (1 + x) - 1 + x / (1 + x), "cancel"),
        (sp.sin(x) ** 2 + sp.cos(x) ** 2 - 1, "cancel"),
        (sp.cos(12 * x) - 1 + 12 * x * sp.sin(6 * x) * sp.sinc(6 * x), "cancel"),
        (sp.tanh(x - y) * (1 - sp.tanh(x) * sp.tanh(y)) - sp.tanh(x) + sp.tanh(y), "simplify"),
        (sp.log(x * y) - sp.log(x) - sp.log(y), "expand"),
        (sp.asin(x / 9) - sp.atan(x / sp.sqrt(81 - x**2)), NUMERIC),
    ],
)
def test_identities_are_proved(expression, method):
    assert prove_zero(expression, {x: (0.5, 2.0), y: (0.5, 2.0)}) == method


@pytest.mark.parametrize(
    "expression",
    [
        x - y,
        sp.Integer(1),
        sp.sqrt(x**2) - x,
        sp.cos(x) - 1 + x**2 / 2,
        sp.Rational(1, 10**40) * x,
        sp.sin(x) - sp.sin(x + sp.Rational(1, 10**40)),
    ],
)
def test_what_is_not_zero_is_not_proved(expression):
    assert prove_zero(expression, {x: (-1.0, 1.0), y: (-1.0, 1.0)}) == ""


def test_signs_come_from_the_box():
    difference = sp.sqrt(x**2 * y) - x * sp.sqrt(y)
    assert prove_zero(difference, {x: (1.0, 2.0), y: (1.0, 2.0)}) in ("expand", "simplify")
    assert prove_zero(difference, {x: (-2.0, -1.0), y: (1.0, 2.0)}) == ""


def test_numbers_are_said_to_be_numbers(monkeypatch):
    monkeypatch.setattr(zero_test, "_LARGEST_CANCEL", 0)
    monkeypatch.setattr(zero_test, "_LARGEST_EXPONENTIAL", 0)
    monkeypatch.setattr(zero_test, "LARGEST_SIMPLIFY", 0)
    assert prove_zero(sp.sin(x) ** 2 + sp.cos(x) ** 2 - 1, {}) == NUMERIC
    proof = FormProof(("x", "y1"), ("expand", NUMERIC))
    assert not proof.holds
    assert proof.numeric_rows == ("y1",)
    assert "numerically zero at 60 digits in the rows of y1" in str(proof)


def test_points_outside_a_domain_say_nothing():
    # no real value anywhere in the box: nothing was compared, so nothing is proved
    assert prove_zero(sp.log(-1 - x**2) - sp.log(-2 - x**2), {x: (0.0, 1.0)}) == ""
    assert prove_zero(sp.Max(x, y) - sp.Max(y, x + sp.Rational(1, 10**30)), {}) == ""


def test_parts_are_proved_one_by_one_and_the_hardest_names_the_whole(monkeypatch):
    parts = (
        sp.sin(x) ** 2
        + sp.cos(x) ** 2
        - 1
        + 1 / (1 + y)
        - 1
        + y / (1 + y)
        + sp.asin(x / 9)
        - sp.atan(x / sp.sqrt(81 - x**2))
    )
    box = {x: (0.5, 2.0), y: (0.5, 2.0)}
    assert prove_zero(parts, box) == NUMERIC
    monkeypatch.setattr(zero_test, "LARGEST_SIMPLIFY", 0)
    without = parts - sp.asin(x / 9) + sp.atan(x / sp.sqrt(81 - x**2))
    assert prove_zero(without, box) == "cancel"
    assert prove_zero(without + sp.Rational(1, 10**30) * sp.cos(y), box) == ""


def test_many_denominators_are_not_multiplied_out():
    many = sp.Add(*[1 / (1 + x + k * y) for k in range(2, 12)])
    other = sp.Add(*[(x + k * y) / (1 + x + k * y) - 1 for k in range(2, 12)])
    assert prove_zero(sp.sin(x) * many + sp.sin(x) * other, {}) in ("cancel", "simplify", NUMERIC)


@pytest.mark.parametrize(
    ("expression", "how"),
    [
        (x - x, "syntactic"),
        ((x + 1) * (x - 1) - x**2 + 1, "expand"),
        (1 / (x + 1) + 1 / (x - 1) - 2 * x / (x**2 - 1), "cancel"),
        (sp.sin(x) ** 2 + sp.cos(x) ** 2 - 1, "simplify"),
        (sp.sqrt(3 + 2 * sp.sqrt(2)) - 1 - sp.sqrt(2) - sp.Rational(1, 10**9), ""),
        (x - y, ""),
    ],
)
def test_symbolic_zero_tests(expression, how):
    assert is_zero(expression) == how


@pytest.mark.parametrize(
    ("expression", "moves"),
    [
        (y + sp.sin(x) ** 2 + sp.cos(x) ** 2, False),
        (y + x / (1 + x) + 1 / (1 + x), False),
        (y + sp.sin(x) ** 2 + sp.cos(x) ** 2 + x / 10**30, True),
        (sp.Function("g")(x), False),  # nothing is known of it
        (sp.sqrt(x - 5), True),
    ],
)
def test_numbers_show_what_varies(expression, moves):
    """Mutants: only what is equal at one point is looked at; what cannot be computed varies."""
    assert varies(expression, {x}) is moves
