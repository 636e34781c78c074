"""The interval engine against balls of 300 bits: nothing it encloses may leave its bounds."""

import casadi as ca
import flint
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from obsynth.derive.errors import DerivationError
from obsynth.derive.intervals import functions, rules
from obsynth.derive.intervals.program import Program, constant_interval, evaluate
from obsynth.derive.intervals.rewriting import rewrites
from obsynth.derive.rigour import interval as arithmetic

QUICK = settings(max_examples=120, deadline=None, derandomize=True)
UNARY = {
    "sqrt": ca.sqrt,
    "exp": ca.exp,
    "log": ca.log,
    "sin": ca.sin,
    "cos": ca.cos,
    "tan": ca.tan,
    "atan": ca.atan,
    "tanh": ca.tanh,
    "sinh": ca.sinh,
    "cosh": ca.cosh,
    "asinh": ca.asinh,
    "fabs": ca.fabs,
    "sign": ca.sign,
    "neg": lambda a: -a,
    "square": lambda a: a * a,
    "cube": lambda a: a**3,
    "inverse": lambda a: 1 / a,
    "fraction": lambda a: a**1.5,
    "third": lambda a: a ** (-7 / 3),
    "erf": ca.erf,
}
BINARY = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "min": ca.fmin,
    "max": ca.fmax,
    "choice": lambda a, b: ca.if_else(a < b, a * b, a - b),
    "hypot": ca.hypot,
    "atan2": ca.atan2,
}
X = ca.SX.sym("x", 3)
number = st.sampled_from([-3.0, -1.0, -0.1, 0.0, 0.3, 1.0, 2.0, 7.1])


@st.composite
def expressions(draw, depth=4):
    if depth == 0 or draw(st.integers(0, 5)) == 0:
        return draw(st.one_of(st.sampled_from([X[0], X[1], X[2]]), number.map(ca.SX)))
    if draw(st.booleans()):
        name = draw(st.sampled_from(sorted(UNARY)))
        return UNARY[name](draw(expressions(depth=depth - 1)))
    name = draw(st.sampled_from(sorted(BINARY)))
    return BINARY[name](draw(expressions(depth=depth - 1)), draw(expressions(depth=depth - 1)))


@st.composite
def boxes(draw):
    ends = []
    for _ in range(3):
        centre = draw(st.floats(-4, 4, allow_nan=False).map(lambda v: round(v, 3)))
        width = draw(st.sampled_from([0.0, 0.0, 1e-9, 0.01, 0.5, 3.0]))
        ends.append((centre, centre + width))
    return np.array(ends)


def outside(low, high, ball):
    """Whether a ball certainly lies outside [low, high]; undefined values prove nothing."""
    if not ball.is_finite():
        return False
    return bool(ball < flint.arb(low)) or bool(ball > flint.arb(high))


def points_of(box, count, seed=0):
    share = np.random.default_rng(seed).random((count, len(box)))
    share[:1], share[1:2] = 0.0, 1.0
    where = box[:, 0] + share * (box[:, 1] - box[:, 0])
    return np.clip(where, box[:, 0], box[:, 1])


def leaks(exactly, function, box, count=6):
    """Points of the box at which the natural enclosure is wrong."""
    lo, hi = evaluate(Program.from_casadi(function), box[:, :1], box[:, 1:])
    found = []
    for point in points_of(box, count):
        try:
            values = exactly(function, point)
        except ArithmeticError:
            continue
        found += [point for k, v in enumerate(values) if outside(lo[k, 0], hi[k, 0], v)]
    return found


@QUICK
@given(expression=expressions(), box=boxes())
def test_random_expressions_never_leave_their_enclosure(exactly, expression, box):
    assert not leaks(exactly, ca.Function("f", [X], [expression]), box)


@QUICK
@given(expression=expressions(depth=3), box=boxes())
def test_random_gradients_never_leave_their_enclosure(exactly, expression, box):
    gradient = ca.densify(ca.gradient(expression, X))
    assert not leaks(exactly, ca.Function("f", [X], [gradient]), box, count=3)


FIXED = [
    X[0] / 3 + X[1],
    X[0] * X[1] - X[2],
    ca.sqrt(X[0]) * 0.1,
    ca.exp(X[0]) + ca.sin(X[1]),
    X[0] ** 1.7,
]


def point_leaks(exactly):
    """Failures at single points, where only the rounding stands between the bounds."""
    rng = np.random.default_rng(1)
    found = 0
    for expression in FIXED:
        function = ca.Function("f", [X], [expression])
        for _ in range(20):
            point = rng.random(3) * 3 + 0.1
            found += len(leaks(exactly, function, np.stack([point, point], axis=1), count=1))
    return found


def test_single_points_are_enclosed(exactly):
    assert point_leaks(exactly) == 0


@pytest.mark.parametrize("names", [("down", "up"), ("down",), ("up",)])
def test_removed_rounding_is_caught(exactly, monkeypatch, names):
    for name in names:
        monkeypatch.setattr(arithmetic, name, lambda value: value)
    monkeypatch.setattr(functions, "widen", lambda ends, ulps: ends)
    assert point_leaks(exactly) > 0


@pytest.mark.parametrize("shift", [-1.0, 1.0])
def test_misplaced_crest_is_caught(exactly, monkeypatch, shift):
    function = ca.Function("f", [X], [ca.sin(X[0])])
    box = np.array([[1.0, 2.2], [0.0, 0.0], [0.0, 0.0]])
    assert not leaks(exactly, function, box, count=50)
    monkeypatch.setattr(functions, "_HALF_PI", functions._HALF_PI + shift)
    assert leaks(exactly, function, box, count=50)


# -- libraries of elementary functions ---------------------------------------------------------

LIBRARY = {
    "exp": (np.exp, "exp", (-700, 700)),
    "log": (np.log, "log", (1e-300, 1e300)),
    "log1p": (np.log1p, "log1p", (-0.999, 10)),
    "expm1": (np.expm1, "expm1", (-30, 30)),
    "sin": (np.sin, "sin", (-1e6, 1e6)),
    "cos": (np.cos, "cos", (-1e6, 1e6)),
    "tan": (np.tan, "tan", (-100, 100)),
    "asin": (np.arcsin, "asin", (-1, 1)),
    "acos": (np.arccos, "acos", (-1, 1)),
    "atan": (np.arctan, "atan", (-100, 100)),
    "sinh": (np.sinh, "sinh", (-50, 50)),
    "cosh": (np.cosh, "cosh", (-50, 50)),
    "tanh": (np.tanh, "tanh", (-20, 20)),
    "asinh": (np.arcsinh, "asinh", (-100, 100)),
    "acosh": (np.arccosh, "acosh", (1, 100)),
    "atanh": (np.arctanh, "atanh", (-0.999, 0.999)),
    "erf": (rules._erf, "erf", (-5, 5)),
}


@pytest.mark.parametrize("name", sorted(LIBRARY))
def test_library_is_within_half_of_the_allowed_ulps(name):
    function, oracle, (low, high) = LIBRARY[name]
    at = low + np.random.default_rng(3).random(400) * (high - low)
    values = function(at)
    before, flint.ctx.prec = flint.ctx.prec, 200
    try:
        exact = [getattr(flint.arb(float(v)), oracle)() for v in at]
        errors = [
            abs(float((flint.arb(float(v)) - e) / flint.arb(float(np.spacing(abs(v))))))
            for v, e in zip(values, exact, strict=True)
        ]
    finally:
        flint.ctx.prec = before
    assert max(errors) <= functions.ULPS / 2


def escaped(rule, exact, boxes):
    """Members, ends included, whose exact image is outside; boxes (lo, hi) per operand, arrays."""
    with np.errstate(all="ignore"):
        lo, hi = rule(*boxes)
    rng, beyond = np.random.default_rng(4), 0
    before, flint.ctx.prec = flint.ctx.prec, 200
    try:
        for share in ((0.0,) * len(boxes), (1.0,) * len(boxes), *rng.random((6, len(boxes)))):
            points = [
                np.clip(low + s * (high - low), low, high)
                for (low, high), s in zip(boxes, np.round(share, 1), strict=True)
            ]
            for k, at in enumerate(zip(*points, strict=True)):
                value = exact(*(flint.arb(float(v)) for v in at))
                known = not (np.isnan(lo[k]) or np.isnan(hi[k]))
                beyond += known and (value < flint.arb(lo[k]) or value > flint.arb(hi[k]))
        return beyond, int(np.isfinite(lo).sum())
    finally:
        flint.ctx.prec = before


def boxes_of(rng, low, high, count=150):
    """Points and short and long intervals."""
    at = rng.uniform(low, high, count)
    width = np.where(rng.random(count) < 0.4, 0.0, (high - low) * 10.0 ** rng.uniform(-6, 0, count))
    return at, np.minimum(at + width, high)


RULE_OF = {"sin": "sine", "cos": "cosine", "tan": "tangent"}


@pytest.mark.parametrize("name", sorted(LIBRARY))
def test_the_range_of_a_function_holds_the_exact_values_of_members(name):
    """Mutants: what the library loses is not pushed outwards; one end for both."""
    _, oracle, (low, high) = LIBRARY[name]
    box = boxes_of(np.random.default_rng(1), low, high)
    found = escaped(rules.RULES[RULE_OF.get(name, name)], lambda v: getattr(v, oracle)(), [box])
    assert found[0] == 0
    assert found[1] > 40


@pytest.mark.parametrize(
    ("name", "exact", "ranges"),
    [
        ("power_const", lambda a, b: a**b, [(0.0, 5.0), (-2.5, 3.5)]),
        ("power", lambda a, b: a**b, [(0.1, 5.0), (-2.5, 3.5)]),
        ("hypotenuse", lambda a, b: (a * a + b * b).sqrt(), [(-3.0, 4.0), (-5.0, 2.0)]),
        ("arctangent2", flint.arb.atan2, [(-3.0, 4.0), (-5.0, 2.0)]),
        ("arctangent2", flint.arb.atan2, [(-3.0, 4.0), (0.5, 2.0)]),
        ("arctangent2", flint.arb.atan2, [(-3.0, -1.0), (-5.0, 2.0)]),
        ("arctangent2", flint.arb.atan2, [(1.0, 4.0), (-5.0, 2.0)]),
    ],
)
def test_the_range_of_two_operands_holds_the_exact_values_of_members(name, exact, ranges):
    """Mutants: a corner for the wrong end, no rounding outwards, a missed cut or half circle."""
    rng = np.random.default_rng(2)
    boxes = [boxes_of(rng, *pair) for pair in ranges]
    found = escaped(rules.RULES[name], exact, boxes)
    assert found[0] == 0
    assert found[1] > 100


def test_bases_and_angles_at_the_edges():
    """Mutants: a negative base taken for one that is not; the cut missed where y touches 0."""
    both = functions.power_const, functions.power
    for base, known in (((0.0, 2.0), (True, False)), ((-0.1, 2.0), (False, False))):
        for rule, told in zip(both, known, strict=True):
            operands = [tuple(np.array([end]) for end in box) for box in (base, (0.5, 0.7))]
            with np.errstate(invalid="ignore"):
                assert np.isfinite(rule(*operands)).all() == told
    pi = flint.arb.pi()
    for y, whole in (((0.0, 1.0), True), ((-1.0, 0.0), True), ((0.1, 1.0), False)):
        box = [tuple(np.array([end]) for end in pair) for pair in (y, (-2.0, -1.0))]
        low, high = (float(end[0]) for end in functions.arctangent2(*box))
        assert (flint.arb(low) < -pi and flint.arb(high) > pi) == whole
        assert whole or 1.5 < low < high < np.pi
    right = [tuple(np.array([end]) for end in pair) for pair in ((-1.0, 1.0), (1.0, 2.0))]
    low, high = (float(end[0]) for end in functions.arctangent2(*right))
    assert -0.8 < low < high < 0.8


def test_a_sine_of_nothing_known_is_a_sine():
    nothing = np.full(1, np.nan), np.full(1, np.nan)
    assert [end.tolist() for end in functions.sine(nothing)] == [[-1.0], [1.0]]


# -- the program ---------------------------------------------------------------------------------


def test_wrong_cancelling_is_caught(exactly, monkeypatch):
    quotient = X[0] ** 3 * ca.sin(X[1]) / ca.sqrt(X[0])
    function = ca.Function("f", [X], [quotient])
    box = np.array([[0.0, 2.0], [0.5, 1.0], [0.0, 0.0]])
    assert not leaks(exactly, function, box)
    lo, hi = evaluate(Program.from_casadi(function), box[:, :1], box[:, 1:])
    assert (lo[0, 0], hi[0, 0]) == pytest.approx((0.0, 2**2.5 * np.sin(1)), rel=1e-14)
    real = rewrites._powers
    monkeypatch.setattr(
        rewrites,
        "_powers",
        lambda graph, factor, half, roots: real(graph, factor, half - 1, roots),
    )
    assert leaks(exactly, function, box)


def test_equal_enclosures_of_constants_do_not_cancel():
    c = ca.SX.sym("c", 2)
    function = ca.Function("f", [X, c], [X[0] * c[0] / c[1]])
    program = Program.from_casadi(function, {1: [(0.1, 0.3), (0.1, 0.3)]})
    lo, hi = evaluate(program, np.ones((3, 1)), np.ones((3, 1)))
    assert (lo[0, 0], hi[0, 0]) == pytest.approx((1 / 3, 3.0), rel=1e-14)


@pytest.mark.parametrize(
    ("expression", "ops"),
    [
        (X[0] * X[0], {"power_int"}),
        (ca.sqrt(X[0] * X[0]), {"absolute"}),
        # two copies that CasADi does not recognise as equal
        (
            ca.sqrt(ca.sin(X[0]) * X[1]) * ca.sqrt(ca.sin(X[0]) * X[1]),
            {"sine", "multiply", "sqrt", "nonnegative"},
        ),
        (X[0] ** 6, {"power_int"}),
        (X[0] ** 2 / ca.sqrt(X[0]), {"power_int", "nonnegative", "sqrt", "multiply"}),
        (X[0] * X[1] / (X[0] * ca.sin(X[1])), {"sine", "multiply", "divide"}),
        # nothing would be left of the root but its domain
        (
            ca.sqrt(ca.sin(X[0])) * X[1] / ca.sqrt(ca.sin(X[0])),
            {"sine", "sqrt", "multiply", "divide"},
        ),
        (ca.sign(X[0]) * X[0], {"sign", "absolute"}),
        # exp(-z) in place of exp(z) over a sum with it, once for every power
        (
            X[1] * ca.exp(X[0]) / (3 + 2 * ca.exp(X[0])) ** 2,
            {"exp", "twice", "add", "power_int", "negate", "multiply", "divide"},
        ),
        (ca.if_else(X[0] < X[1], X[0], X[1]), {"less", "logical_not", "if_else_zero", "select"}),
        (ca.jacobian(ca.fmin(X[0], X[1]), X[0]), {"less_equal", "add", "boundary_weight"}),
    ],
)
def test_rewrites(expression, ops):
    program = Program.from_casadi(ca.Function("f", [X], [expression]))
    used = {program.nodes[k].op for k in range(len(program.nodes))} - {"input", "constant"}
    assert used == ops


def test_equal_expressions_are_one_node():
    a, b = ca.sin(X[0] + X[1]), ca.sin(X[1] + X[0])
    program = Program.from_casadi(ca.Function("f", [X], [a * X[2], b / X[2]]))
    assert sum(node.op == "sine" for node in program.nodes) == 1


def test_narrower_for_the_rewrites():
    box = np.array([[-1.0], [0.0], [0.0]]), np.array([[2.0], [0.0], [0.0]])
    square = evaluate(Program.from_casadi(ca.Function("f", [X], [X[0] * X[0]])), *box)
    assert (square[0][0, 0], square[1][0, 0]) == (0.0, 4.0)
    both = ca.if_else(X[0] < 0, -X[0], X[0])
    choice = evaluate(Program.from_casadi(ca.Function("f", [X], [both])), *box)
    assert (choice[0][0, 0], choice[1][0, 0]) == (-2.0, 2.0)


def test_constants_are_widened_unless_short():
    assert constant_interval(3.0) == (3.0, 3.0)
    assert constant_interval(-0.375) == (-0.375, -0.375)
    lo, hi = constant_interval(0.1 * 3)
    assert lo < 0.3 < hi
    assert hi - lo <= 9 * np.spacing(0.3)


def test_constants_as_inputs_are_intervals():
    c = ca.SX.sym("c")
    function = ca.Function("f", [X, c], [X[0] * c])
    program = Program.from_casadi(function, {1: [(0.25, 0.5)]})
    lo, hi = evaluate(program, np.ones((3, 1)), 2 * np.ones((3, 1)))
    assert program.n_variables == 3
    assert (lo[0, 0], hi[0, 0]) == pytest.approx((0.25, 1.0), rel=1e-15)


def test_operation_without_a_rule_is_refused():
    with pytest.raises(DerivationError, match="no range rule"):
        Program.from_casadi(ca.Function("f", [X], [ca.erfinv(X[0])]))


def test_exponents_stay_integers():
    """A constant exponent n makes n - 1 in the derivative, which has to be exact."""
    n = ca.SX.sym("n")
    cube = X[0] ** n
    function = ca.Function("f", [X, n], [cube, ca.jacobian(cube, X[0])])
    program = Program.from_casadi(function, {1: [(3.0, 3.0)]})
    lo, hi = evaluate(program, -2.0 * np.ones((3, 1)), -1.0 * np.ones((3, 1)))
    assert (lo[0, 0], hi[0, 0]) == pytest.approx((-8.0, -1.0), rel=1e-14)
    assert (lo[1, 0], hi[1, 0]) == pytest.approx((3.0, 12.0), rel=1e-14)
