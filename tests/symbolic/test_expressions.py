"""Random expressions: text and back, SymPy to CasADi, CasADi to SymPy."""

from operator import sub, truediv

import casadi as ca
import numpy as np
import pytest
import sympy as sp
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from obsynth.symbolic.convert import to_sx
from obsynth.symbolic.equations import canonical, read_rows
from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.from_casadi import from_tape
from obsynth.symbolic.functions import BY_NAME, phi1, tanhc
from obsynth.symbolic.sxmodel import ParityError, check_parity, sample_box
from obsynth.symbolic.text import read_text
from obsynth.symbolic.written import write_text

NAMES = {name: sp.Symbol(name, real=True) for name in ("x", "y", "z")}
X, Y, Z = NAMES.values()
EXPONENTS = [sp.Integer(k) for k in (-3, -2, -1, 2, 3)] + [
    sp.Rational(p, q) for p, q in ((1, 2), (-1, 2), (3, 2), (1, 3), (-2, 3))
]
UNARY = [sp.exp, sp.log, sp.sin, sp.cos, sp.tan, sp.asin, sp.acos, sp.atan, sp.sinh, sp.cosh]
UNARY += [sp.tanh, sp.asinh, sp.acosh, sp.atanh, sp.Abs, sp.sign, sp.floor, sp.ceiling, sp.erf]
UNARY += [sp.Heaviside, sp.sinc, sp.sqrt, phi1, tanhc]
RELATIONS = [sp.Lt, sp.Le, sp.Gt, sp.Ge]

LEAVES = st.one_of(
    st.sampled_from([X, Y, Z, sp.pi]),
    st.integers(-7, 7).map(sp.Integer),
    st.fractions(-3, 3, max_denominator=9).map(lambda q: sp.Rational(q.numerator, q.denominator)),
    st.floats(-1e3, 1e3, allow_subnormal=False).map(sp.Float),
)


def trees(parts):
    """Trees of (constructor, *parts): SymPy evaluates them, and may refuse, later."""
    relations = st.tuples(st.sampled_from(RELATIONS), parts, parts)
    joined = st.tuples(st.sampled_from([sp.And, sp.Or]), relations, relations)
    return st.one_of(
        st.tuples(st.sampled_from([sp.Add, sp.Mul]), parts, parts),
        st.tuples(st.sampled_from([sp.Add, sp.Mul, sp.Max, sp.Min]), parts, parts, parts),
        st.tuples(st.sampled_from([sub, truediv, sp.atan2]), parts, parts),
        st.tuples(st.just(sp.Pow), parts, st.sampled_from(EXPONENTS)),
        st.tuples(st.sampled_from(UNARY), parts),
        st.tuples(st.just(piecewise), parts, parts, st.one_of(relations, joined)),
    )


def piecewise(a, b, condition):
    return sp.Piecewise((a, condition), (b, True))


def build(tree):
    return tree[0](*map(build, tree[1:])) if isinstance(tree, tuple) else tree


def agree(expression, symbols, values, points):
    try:
        check_parity([expression], symbols, values, points, ["row"])
    except ParityError as error:
        # In C the maximum of a number and of nothing is the number.
        if not np.isnan(error.sympy_value):
            raise


@st.composite
def expressions(draw):
    tree = draw(st.recursive(LEAVES, trees, max_leaves=7))
    try:
        (row,) = read_rows([build(tree)], NAMES, "row")
    except (PlantError, TypeError, ValueError, ArithmeticError):
        # No real function: SymPy does not compare complex numbers, divides not by zero.
        row = None
    assume(row is not None)
    return row


@settings(
    max_examples=200,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)
@given(expressions())
def test_every_form_is_the_same_function(expression):
    assert canonical(expression) == expression

    text = write_text(expression)
    assert read_text(text, NAMES) == expression, text

    column = ca.SX.sym("v", 3)
    symbols = dict(zip(NAMES.values(), ca.vertsplit(column), strict=True))
    (sx,) = to_sx([expression], symbols, ["row"])
    function = ca.Function("f", [column], [sx])
    points = sample_box(np.array([[0.1, 2.0], [-2.0, 2.0], [0.5, 3.0]]), count=8)

    def values(point):
        return np.array(function(point))

    agree(expression, list(symbols), values, points)
    (back,) = read_rows(from_tape(function, [list(symbols)], ["row"]), NAMES, "row")
    agree(back, list(symbols), values, points)


@pytest.mark.parametrize("name", sorted(BY_NAME))
def test_every_function_in_every_form(name):
    function = BY_NAME[name]
    arguments = [X, Y][: max(function.least, 2 if function.most is None else 1)]
    expression = function.sympy(*arguments)
    assert read_text(write_text(expression), NAMES) == expression
    box = np.array([[1.1, 3.0] if name == "acosh" else [0.01, 0.99], [-1.0, 1.0]])
    column = ca.SX.sym("v", 2)
    (sx,) = to_sx([expression], {X: column[0], Y: column[1]}, ["row"])
    casadi = ca.Function("f", [column], [sx])
    points = sample_box(box)

    def values(point, mutant=0.0):
        return np.array(casadi(point)) * (1.0 + mutant) + mutant

    check_parity([expression], [X, Y], values, points, ["row"])
    with pytest.raises(ParityError) as caught:
        check_parity([expression], [X, Y], lambda v: values(v, 1e-9), points, ["row 7"])
    assert caught.value.row == "row 7"
    assert "x = " in str(caught.value)


@pytest.mark.parametrize(("name", "slope"), [("sinc", 0.0), ("phi1", 0.5), ("tanhc", 0.0)])
def test_removable_singularities_have_their_derivative_at_zero(name, slope):
    z = ca.SX.sym("z")
    value = BY_NAME[name].casadi(z)
    derivative = ca.Function("d", [z], [value, ca.jacobian(value, z)])
    at_zero, slope_at_zero = derivative(0.0)
    assert float(at_zero) == 1.0
    assert float(slope_at_zero) == pytest.approx(slope, abs=1e-15)
    inside, outside = derivative(0.125 - 1e-12), derivative(0.125 + 1e-12)
    assert float(inside[0]) == pytest.approx(float(outside[0]), rel=1e-11)
    assert float(inside[1]) == pytest.approx(float(outside[1]), rel=1e-10)


@pytest.mark.parametrize("function", [phi1, tanhc])
def test_own_functions_differentiate_in_sympy(function):
    step = sp.Rational(1, 10**8)
    for at in (sp.Rational(1, 3), sp.Integer(-2)):
        slope = function(X).diff(X).subs(X, at).evalf(30)
        secant = ((function(at + step) - function(at - step)) / (2 * step)).evalf(30)
        assert abs(slope - secant) < 1e-14


@pytest.mark.parametrize(
    "row",
    [
        X * sp.exp(-((100 * X) ** 2)),
        (1 + sp.exp(-((1000 * X) ** 2)) / 2) * sp.tanh(100 * X),
        1 / (1 + sp.exp(-1000 * X)),
        sp.Integer(10) ** 20 * sp.exp(-((30 * X) ** 2)),
        sp.sqrt(sp.exp(-1000 * X**2)),
    ],
    ids=["Gaussian", "Stribeck", "logistic", "amplified", "root"],
)
def test_underflow_is_no_difference_and_hides_none(row):
    """Where a double underflows the two forms agree; above that they have to, to 1e-12.

    Mutants: no allowance; an allowance that is not multiplied with what follows; one of 1e-12.
    """
    (form,) = to_sx([row], {X: ca.SX.sym("x")}, ["row"])
    function = ca.Function("f", ca.symvar(form), [form])
    points = np.linspace(-1, 1, 401)[:, None]
    check_parity([row], [X], lambda v: np.array(function(v)), points, ["row"])
    wrong = [(0.07, lambda v: (1 + 1e-9) * function(v))]
    if float(function(-0.9)) == 0.0 and row.func is not sp.exp:
        wrong.append((-0.9, lambda v: function(v) + 1e-250))
    for at, other in wrong:
        with pytest.raises(ParityError):
            check_parity([row], [X], lambda v, f=other: np.array(f(v)), np.array([[at]]), ["row"])
