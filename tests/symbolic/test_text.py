"""The grammar: what is read, and where what is wrong stands."""

import time

import pytest
import sympy as sp

from obsynth.symbolic.text import TextError, read_text
from obsynth.symbolic.written import write_text

NAMES = {name: sp.Symbol(name, real=True) for name in ("h1", "v", "x", "E", "I", "lambda")}
H, V, X = NAMES["h1"], NAMES["v"], NAMES["x"]


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1/3", sp.Rational(1, 3)),
        ("0.1", sp.Float(0.1)),
        ("1e-3", sp.Float(1e-3)),
        (".5*x", 0.5 * X),
        ("-x**2", -(X**2)),
        ("(-x)**2", X**2),
        ("2**-1", sp.Rational(1, 2)),
        ("2**3**2", sp.Integer(512)),
        ("x - v - h1", X - V - H),
        ("x/v/2", X / (2 * V)),
        ("-(x + v)*h1", sp.Mul(-1, X + V, H)),
        ("2*x*(v + 1)", 2 * X * (V + 1)),
        ("sqrt(x)*pi", sp.sqrt(X) * sp.pi),
        ("abs(x) + ln(v) + max(x, v, 0)", sp.Abs(X) + sp.log(V) + sp.Max(X, V, 0)),
        ("Heaviside(x)", sp.Heaviside(X)),
        ("Heaviside(x, 0)", sp.Heaviside(X, 0)),
        (
            "piecewise((x, x < 1 and v >= 0), (2, True))",
            sp.Piecewise((X, (X < 1) & (V >= 0)), (2, True)),
        ),
        (
            "piecewise((x, not (x < 1 or v == 0)), (2, True))",
            sp.Piecewise((X, ~((X < 1) | sp.Eq(V, 0))), (2, True)),
        ),
        ("E + I", NAMES["E"] + NAMES["I"]),
        ("lambda*2", 2 * NAMES["lambda"]),
    ],
)
def test_reading(text, value):
    assert read_text(text, NAMES) == value


def test_floats_are_shortest_and_return_bit_for_bit():
    for value in (0.1, 1 / 3, 1e-300, 5e-324, 1.7976931348623157e308, 123456789.123456789, 2.5e17):
        text = write_text(sp.Float(value))
        assert text == repr(value)
        assert float(read_text(text, {})) == value


def test_rationals_stay_exact():
    tiny = sp.Rational(1, 10**40)
    assert read_text(write_text(tiny * X), NAMES) == tiny * X


@pytest.mark.parametrize(
    ("text", "position", "words"),
    [
        ("", 0, "ends"),
        ("x +", 3, "ends"),
        ("x + * v", 4, "'*'"),
        ("x $ v", 2, "'$'"),
        ("x ^ 2", 2, "written **"),
        ("h2 + 1", 0, "did you mean h1"),
        ("gamma(x)", 0, "gamma is not supported"),
        ("sin(x, v)", 0, "2 arguments"),
        ("atan2(x)", 0, "1 arguments"),
        ("(x + 1", 6, "expected ')'"),
        ("x 2", 2, "unexpected '2'"),
        ("x < 1", 0, "condition"),
        ("x + (v < 1)", 4, "condition"),
        ("(x < 1) + x", 0, "condition"),
        ("(x < 1)*x", 0, "condition"),
        ("(x < 1)**2", 0, "condition"),
        ("-(x < 1)", 1, "condition"),
        ("(x < 1) < 2", 0, "cannot be compared"),
        ("piecewise((x, v), (1, True))", 14, "condition is needed"),
        ("piecewise((x, v < 1))", 0, "needs the condition True"),
        ("piecewise((x, x or v < 1), (1, True))", 14, "condition is needed"),
        ("1/0", 3, "division by zero"),
        ("0**-1", 0, "division by zero"),
        ("9**9**9", 0, "too large"),
        ("1e999", 0, "finite"),
        ("log(0)", 0, "finite"),
        ("__import__('os')", 11, "meaning"),
        ("x.real", 1, "meaning"),
        ("sqrt(-1) < x", 12, "not a real"),
        ("Max(sqrt(-1), x)", 16, "not a real"),
    ],
)
def test_errors_say_where(text, position, words):
    with pytest.raises(TextError) as caught:
        read_text(text, NAMES)
    assert words in str(caught.value)
    assert caught.value.position == position


@pytest.mark.parametrize(
    "text", ["(" * 5000 + "x" + ")" * 5000, "-" * 5000 + "x", "2**" * 5000 + "x", "not " * 5000]
)
def test_depth_is_limited(text):
    with pytest.raises(TextError, match="levels"):
        read_text(text, NAMES)


def test_only_text_is_read():
    with pytest.raises(TextError, match="is text"):
        read_text(3.0, NAMES)  # type: ignore[arg-type]


def test_writing_refuses_what_it_cannot_read_back():
    for wild in (sp.gamma(X), sp.oo, sp.I * X, sp.Float("0.1", 40), sp.Function("g")(X)):
        with pytest.raises(ValueError, match=r"text form|not a"):
            write_text(wild)


@pytest.mark.parametrize(
    ("expression", "text"),
    [
        (sp.sqrt(X) / (2 * V) - sp.Rational(1, 3), "-1/3 + sqrt(x)/2/v"),
        (-3 * X * (V - 1) / 4, "-3*x*(v - 1)/4"),
        (1 / sp.sqrt(X), "1/sqrt(x)"),
        ((-2) ** X, "(-2)**x"),
        (X ** sp.Rational(-2, 3), "1/x**(2/3)"),
        (sp.exp(1) * X, "exp(1)*x"),
        (sp.Piecewise((1, X < 0), (X, True)), "piecewise((1, x < 0), (x, True))"),
    ],
)
def test_writing(expression, text):
    assert write_text(expression) == text
    assert read_text(text, NAMES) == expression


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1" * 1_000_000, "at most 100000 characters, this one has 1000000"),
        ("1" + "+1" * 400_000, "at most 100000 characters, this one has 800001"),
        ("(" * 1_000_000, "at most 100000 characters"),
        ("(" * 40_000 + "1" + ")" * 40_000, "more than 100 levels"),
        ("-" * 90_000 + "1", "more than 100 levels"),
        ("1" + "**1" * 30_000, "more than 100 levels"),
        ("max(" + ",".join(f"x**{k}" for k in range(2, 9000)) + ")", "more than 100 arguments"),
        ("piecewise((1," + " or ".join(f"x<{k}" for k in range(9000)) + "),(0,True))", "more than"),
        ("piecewise(" + ",".join(f"({k},x<{k})" for k in range(7000)) + ",(0,True))", "more than"),
    ],
    ids=["digits", "ones", "open", "nested", "signs", "powers", "max", "or", "cases"],
)
def test_endless_texts_are_refused_at_once(text, message):
    """Mutants: no longest text, no largest number of arguments in one of the three places."""
    since = time.monotonic()
    with pytest.raises(TextError, match=message) as told:
        read_text(text, {"x": sp.Symbol("x", real=True)})
    assert time.monotonic() - since < 2.0
    assert len(str(told.value)) < 400
