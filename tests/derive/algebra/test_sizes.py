"""How long expressions are, and that nothing long is expanded, simplified or differentiated."""

import casadi as ca
import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from obsynth.derive import StructureError, jacobian_bounds, quasi_lpv, split
from obsynth.derive.algebra import sizes
from obsynth.derive.algebra.zero_test import is_zero, prove_zero
from obsynth.symbolic import Plant
from obsynth.symbolic.plants import exothermic_cstr

X, Y, Z = sp.symbols("x y z", real=True)
FEW = settings(max_examples=60, deadline=None, derandomize=True)


@st.composite
def polynomials(draw, depth=4):
    if depth == 0 or draw(st.integers(0, 4)) == 0:
        return draw(st.sampled_from([X, Y, Z, sp.Integer(2), sp.Rational(1, 3), sp.sin(X), 1 / Y]))
    kind = draw(st.integers(0, 4))
    if kind == 4:
        return draw(polynomials(depth - 1)) ** draw(st.integers(2, 4))
    parts = [draw(polynomials(depth - 1)) for _ in range(2)]
    return sp.Add(*parts) if kind < 2 else sp.Mul(*parts)


def nested(depth, start=X):
    """An expression of few different parts that has 2^depth of them when it is written out."""
    for _ in range(depth):
        start = sp.sin(start) + sp.cos(start) / 2
    return start


@FEW
@given(expression=polynomials())
def test_sizes_are_counted_and_terms_are_not_underestimated(expression):
    """Mutants: a part is counted once; a power has as many terms as its base."""
    assert sizes.size(expression) == sum(1 for _ in sp.preorder_traversal(expression))
    assert sizes.size(X**X) == 3
    if expression != 0:
        assert sizes.expanded_terms(expression) >= len(sp.Add.make_args(sp.expand(expression)))


@pytest.mark.parametrize("n", [1, 2, 7, 30])
def test_a_power_of_a_sum_has_binomially_many_terms(n):
    power = (X + Y + Z + sp.sin(X)) ** n if n > 1 else X + Y + Z + sp.sin(X)
    assert sizes.expanded_terms(power) == sp.binomial(n + 3, 3)


def test_like_terms_count_once():
    """Mutant: no account of the number of monomials; a product of 64 sums would have 2^64 terms."""
    product = sp.Mul(*(X + k for k in range(2, 66)))
    assert sizes.expanded_terms(product) == 65


def test_long_expressions_are_measured_at_once():
    long = nested(60)
    assert sizes.size(long) == 10**12
    assert sizes.symbols(long) == {X}
    assert "parts" in sizes.text(long)
    assert sizes.text(X + 1) == "x + 1"


@pytest.fixture
def watched(monkeypatch):
    """Fail where SymPy is handed what is too long for it."""
    limits = {"simplify": 1000, "expand": 40_000, "cancel": 40_000, "diff": 40_000}

    def watch(name):
        real = getattr(sp, name)

        def asked(expression, *rest, **keywords):
            assert sizes.size(expression) <= limits[name], f"{name} of something long"
            if name == "expand":
                assert sizes.expanded_terms(expression) <= limits[name], "a long sum"
            return real(expression, *rest, **keywords)

        monkeypatch.setattr(sp, name, asked)

    for name in limits:
        watch(name)


def test_no_proof_is_tried_that_does_not_end(watched):
    """Mutants: `is_zero` or `prove_zero` expand before they ask; `simplify` has no limit."""
    power = (X + Y + Z + 1) ** 300
    assert is_zero(power - (X + Y + Z + 2) ** 300) == ""
    assert is_zero(nested(60) - nested(60, Y)) == ""
    assert prove_zero(nested(60) - nested(60, Y), {}) == ""
    other = sp.Mul(power, X + 1) - X * power - power
    assert prove_zero(other, {X: (0.0, 1.0)}).startswith("numerically")
    asinh = sp.asinh(X * Y + X * Z) * sp.exp(sp.asinh(Y * Z + X) / 2) / (3 + sp.cosh(X - Y))
    assert is_zero(sum(asinh.subs(X, X + k) for k in range(20))) == ""


def test_a_coefficient_that_varies_is_refused_at_once(watched):
    """Mutant: `simplify` is asked whatever the length (a minute and more)."""
    with pytest.raises(StructureError, match=r"enters the row .* which depends on") as told:
        split(exothermic_cstr().discretise("rk4", sp.Rational(1, 100)))
    assert len(str(told.value)) < 1000


@pytest.mark.long
def test_forms_with_long_quotients_end(watched):
    """Mutant: `simplify` up to 600 operations (a quarter of a minute for the second row)."""
    plant = Plant("long quotients")
    plant.states("x1:4", range=(1, 3))
    plant.inputs("u", range=(0, 1))
    plant.dynamics(["-x1", "-x2", "asinh((u + x1)*(x2 + x3)) - x3"])
    plant.outputs(["x1"])
    assert quasi_lpv(plant).proof.methods[0] == "syntactic"


def long_plant(fault=False):
    plant = Plant("long")
    x, y = plant.states("x y", range=(0, sp.Rational(1, 50)))
    f = plant.faults("f")[0] if fault else 0
    plant.dynamics([nested(13, x) * y + f - x, -y])
    plant.outputs([x])
    return plant


def test_long_rows_are_bounded_without_their_exact_derivatives(watched):
    """Mutants: the limit of a row is not asked; the derivative is said to depend on nothing."""
    plant = long_plant()
    found = jacobian_bounds(plant, effort="fast")
    sx = plant.sx()
    slope = ca.Function("slope", [sx.x], [ca.jacobian(sx.rhs, sx.x)])
    for point in np.random.default_rng(0).uniform(0.0, 0.02, (200, 2)):
        value = np.array(slope(point))
        assert (found.min <= value).all()
        assert (value <= found.max).all()
    assert found.family.labels[0] == "m11(x, y)"
    parts = split(plant, ([0.01, 0.01], []), "jacobian")
    assert parts.proof.holds
    np.testing.assert_allclose(parts.A, np.array(slope([0.01, 0.01])), rtol=1e-12)


def test_a_long_row_with_a_fault_is_refused_with_its_length(watched):
    with pytest.raises(StructureError, match=r"row of x has \d+,\d{3} parts, too many .* fault f"):
        split(long_plant(fault=True), ([0, 0], []))


def test_a_refusal_shows_no_fraction_of_sixteen_digits():
    long = sp.Rational(-3832850746698295, 18014398509481984) * X + sp.Rational(1, 3) * Y
    assert sizes.text(long) == "-0.212766*x + y/3"
