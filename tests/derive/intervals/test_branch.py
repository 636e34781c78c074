"""Branch and bound: sound on anything, tight where it says so, honest where it stops."""

import casadi as ca
import flint
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from obsynth.derive.errors import DerivationError
from obsynth.derive.intervals.program import evaluate
from obsynth.derive.intervals.ranges import Status, bound_ranges, make_problem, staged
from obsynth.derive.intervals.search import batch, branch

X = ca.SX.sym("x", 3)
UNIT = [(-1, 2)] * 3
QUICK = settings(max_examples=60, deadline=None, derandomize=True)

SMOOTH = {
    "sin": ca.sin,
    "cos": ca.cos,
    "exp": lambda a: ca.exp(ca.sin(a)),
    "tanh": ca.tanh,
    "square": lambda a: a * a,
    "cube": lambda a: a**3,
    "fabs": ca.fabs,
    "sign": ca.sign,
    "inverse": lambda a: 1 / (a - 0.3),
    "root": lambda a: ca.sqrt(a + 1.5),
    "floor": ca.floor,
    "atan": lambda a: ca.atan(1 / a),
}
JOINS = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "max": ca.fmax,
    "choice": lambda a, b: ca.if_else(a < b, b, a * a),
}


@st.composite
def expressions(draw, depth=4):
    if depth == 0 or draw(st.integers(0, 6)) == 0:
        return draw(st.sampled_from([X[0], X[1], X[2], ca.SX(0.7), X[0] - X[1]]))
    if draw(st.booleans()):
        return SMOOTH[draw(st.sampled_from(sorted(SMOOTH)))](draw(expressions(depth=depth - 1)))
    join = JOINS[draw(st.sampled_from(sorted(JOINS)))]
    return join(draw(expressions(depth=depth - 1)), draw(expressions(depth=depth - 1)))


@st.composite
def boxes(draw):
    ends = []
    for _ in range(3):
        low = draw(st.sampled_from([-2.0, -1.0, -0.5, 0.0, 0.25, 1.0]))
        ends.append((low, low + draw(st.sampled_from([0.0, 0.01, 0.5, 1.0, 3.0]))))
    return np.array(ends)


def wrong_bounds(exactly, expression, box, effort="fast", rtol=1e-3):
    """Samples outside the guaranteed bounds, and attained values that are not attained."""
    found = bound_ranges(expression, X, box, rtol=rtol, effort=effort)
    function = ca.Function("f", [X], [ca.densify(ca.vec(expression))])
    share = np.random.default_rng(0).random((12, 3))
    share[:4] = np.round(share[:4])
    points = np.clip(box[:, 0] + share * (box[:, 1] - box[:, 0]), box[:, 0], box[:, 1])
    bad = []
    for point in points:
        try:
            balls = exactly(function, point)
        except ArithmeticError:
            continue
        for k, ball in enumerate(balls):
            if ball.is_finite() and (
                ball < flint.arb(found.lower[k]) or ball > flint.arb(found.upper[k])
            ):
                bad.append((k, point))
    for k in range(len(found.lower)):
        for value, point, sign in (
            (found.attained_lower[k], found.points_lower[k], 1),
            (found.attained_upper[k], found.points_upper[k], -1),
        ):
            if not np.isfinite(value):
                continue
            try:
                ball = exactly(function, point)[k]
            except ArithmeticError:
                continue
            if ball.is_finite() and sign * ball > sign * flint.arb(value):
                bad.append((k, point))
    return bad


@QUICK
@given(expression=expressions(), box=boxes())
def test_random_expressions_stay_inside_and_reach_what_is_attained(exactly, expression, box):
    assert not wrong_bounds(exactly, expression, box)


def test_a_quantity_that_is_no_number_at_an_end_is_no_way_to_a_point(exactly):
    """Mutant: NaN goes on to the search for a root, which ends in SciPy's own error."""
    steep = X[0] + ca.atan(1 / ca.atan(1 / ca.sqrt(X[1] + 1.5)))
    box = np.array([[-2.0, -2.0], [-2.0, -1.99], [-2.0, -2.0]])
    assert not wrong_bounds(exactly, ca.atan(1 / steep), box)


@pytest.mark.long
@settings(max_examples=3000, deadline=None, derandomize=True)
@given(expression=expressions(depth=5), box=boxes())
def test_many_random_expressions(exactly, expression, box):
    assert not wrong_bounds(exactly, expression, box)


@QUICK
@given(expression=expressions(), box=boxes(), work=st.integers(1, 60))
def test_an_infinite_end_is_a_failure_with_its_box_whatever_the_budget(expression, box, work):
    """And a finite one is none.

    Mutants: `Search.outcome` copies ``self.singular`` only; `_merged` keeps what was singular
    before a later search found a bound.
    """
    problem = make_problem(
        ca.vertcat(expression, X[0] / (1 + (X[1] - X[2]) * (X[1] - X[2]))), X, box
    )
    outcome = staged(problem, 1e-3, branch.Budget(boxes=20 * work, sweeps=work))
    endless = np.flatnonzero(~np.isfinite(outcome.bound)).tolist()
    assert sorted(outcome.singular) == endless
    for goal, (low, high) in outcome.singular.items():
        assert (box[:, 0] <= low).all()
        assert (low <= high).all()
        assert (high <= box[:, 1]).all()
        enclosed = evaluate(problem.program, low[:, None], high[:, None], [goal // 2])
        assert not np.isfinite(enclosed[goal % 2]).all()


def test_what_a_longer_search_bounds_is_no_failure():
    """The denominator is positive, which the first boxes, without a bound, do not show."""
    a, b, c = X[0] - X[1], X[1] - X[2], X[2] - X[0]
    quotient = 1 / (2 + a * a + b * b + c * c + a * b + b * c)
    problem = make_problem(quotient, X, UNIT)
    assert branch.maximise(problem, 1e-2, branch.Budget(20, 1)).singular
    found = bound_ranges(quotient, X, UNIT, rtol=1e-2)
    assert np.isfinite(found.upper[0])
    assert not found.failures


MONOTONE = ca.vertcat(
    ca.exp(X[0]) - X[1] ** 3,
    X[0] * X[1] + ca.sin(X[2] / 4),
    ca.sqrt(X[0] + 2) / (X[1] + 3),
)


def mirror(enclose, entries):
    """Engine whose partial derivatives have the wrong sign: every monotone branch is wrong."""

    def wrong(program, lower, upper, outputs, judged):
        found = enclose(program, lower, upper, outputs, judged)
        slopes = np.array([k >= entries for k in outputs])[:, None]
        lo = np.where(slopes, -found.upper, found.lower)
        hi = np.where(slopes, -found.lower, found.upper)
        return type(found)(lo, hi, found.rough)

    return wrong


def test_wrong_monotone_branch_is_caught(exactly, monkeypatch):
    box = np.array([(-1.0, 2.0), (0.5, 2.0), (-1.0, 1.0)])
    assert not wrong_bounds(exactly, MONOTONE, box, rtol=1e-6)
    monkeypatch.setattr(batch, "enclose", mirror(batch.enclose, 3))
    assert wrong_bounds(exactly, MONOTONE, box, rtol=1e-6)


@pytest.mark.parametrize("side", ["rising", "falling"])
def test_one_wrong_facet_is_caught(exactly, monkeypatch, side):
    """The mutant goes to the wrong end of every variable in which a goal rises (falls)."""
    real = branch.shrink

    def wrong(rows, slope_lower, slope_upper):
        lower, upper = real(rows, slope_lower, slope_upper)
        if side == "rising":
            rises = (lower == rows.upper) & (rows.lower < rows.upper)
            return np.where(rises, rows.lower, lower), np.where(rises, rows.lower, upper)
        falls = (upper == rows.lower) & (rows.lower < rows.upper)
        return np.where(falls, rows.upper, lower), np.where(falls, rows.upper, upper)

    monkeypatch.setattr(branch, "shrink", wrong)
    box = np.array([(-1.0, 2.0), (0.5, 2.0), (-1.0, 1.0)])
    assert wrong_bounds(exactly, MONOTONE, box, rtol=1e-6)


def test_mean_value_form_without_its_radius_is_caught(exactly, monkeypatch):
    wave = ca.sin(3 * X[0] + X[1]) * ca.cos(2 * X[1] - X[2])
    box = np.array(UNIT, dtype=float)
    assert not wrong_bounds(exactly, wave, box)
    real = branch.mean_value_terms
    monkeypatch.setattr(branch, "mean_value_terms", lambda *given: 0.01 * real(*given))
    assert wrong_bounds(exactly, wave, box)


def test_trusting_the_derivative_across_a_jump_is_caught(exactly, monkeypatch):
    jumps = ca.vertcat(ca.sign(X[0]) * X[1], ca.atan(1 / X[0]), ca.floor(2 * X[0]) + X[1])
    box = np.array(UNIT, dtype=float)
    assert not wrong_bounds(exactly, jumps, box)
    enclose = batch.enclose
    monkeypatch.setattr(
        batch,
        "enclose",
        lambda program, lower, upper, outputs, judged: enclose(program, lower, upper, outputs, 0),
    )
    assert wrong_bounds(exactly, jumps, box)


# -- cases with known answers ------------------------------------------------------------------


def one(expression, box=UNIT, **options):
    found = bound_ranges(expression, X, box, **options)
    return found, float(found.lower[0]), float(found.upper[0])


@pytest.mark.parametrize(
    ("expression", "low", "high"),
    [
        (X[0] * X[1] - X[1] * X[2], -6.0, 6.0),
        (ca.sin(X[0]) ** 2 + ca.cos(X[0]) ** 2, 1.0, 1.0),
        (X[0] ** 3 - 3 * X[0], -2.0, 2.0),
        (ca.fabs(X[0] - X[1]) - ca.fmax(X[0], X[2]), -2.0, 4.0),
        (ca.fmin(X[0], X[1]) * X[2], -2.0, 4.0),
        (ca.sign(X[0]), -1.0, 1.0),
        (ca.exp(-(((X[0] - 0.3) / 3e-5) ** 2)), 0.0, 1.0),
        (
            X[0] * ca.exp(-(X[0] ** 2) - X[1] ** 2),
            -np.exp(-0.5) / np.sqrt(2),
            np.exp(-0.5) / np.sqrt(2),
        ),
        # a sampling grid of step 1/8 sees the constant 1 here
        (ca.cos(16 * np.pi * X[0]), -1.0, 1.0),
        ((X[0] - X[1]) * (X[0] - X[1]) + X[2], -1.0, 11.0),
    ],
)
def test_ranges_with_known_ends(expression, low, high):
    found, lower, upper = one(expression, rtol=1e-6)
    width = max(high - low, 1e-9)
    assert low - 1e-6 * width <= lower <= low + 1e-15 * (1 + abs(low))
    assert high + 1e-6 * width >= upper >= high - 1e-15 * (1 + abs(high))
    assert found.status[0] in (Status.EXACT, Status.CONVERGED)
    assert found.gap[0] <= 1.1e-6 * width


def test_corner_values_are_exact():
    found, _, _ = one(ca.exp(X[0]) * (X[1] + 3))
    assert found.status_upper[0] is Status.EXACT
    assert found.points_upper[0].tolist()[:2] == [2.0, 2.0]
    assert found.sweeps == 1


def test_affine_variables_cost_no_boxes():
    """A form affine in each of three variables is settled on the corners."""
    found, lower, upper = one(X[0] * X[1] * X[2] - X[0] * X[2], rtol=1e-9)
    corners = [x * y * z - x * z for x in (-1, 2) for y in (-1, 2) for z in (-1, 2)]
    assert (lower, upper) == pytest.approx((min(corners), max(corners)), rel=1e-14)
    assert found.boxes < 100


def test_pole_on_an_interior_diagonal():
    found, lower, upper = one(1 / (X[0] - X[1]))
    assert (lower, upper) == (-np.inf, np.inf)
    assert found.status[0] is Status.UNBOUNDED
    failure = found.failures[0]
    assert failure.operation == "a division by an interval that contains zero"
    assert failure.lower[0] <= failure.upper[1]
    assert failure.lower[1] <= failure.upper[0]
    assert (failure.upper - failure.lower)[:2].max() < 1e-5


def test_one_sided_pole_leaves_the_other_bound():
    found, lower, upper = one(1 / ca.sqrt(X[0]), [(0, 4), (0, 0), (0, 0)])
    assert upper == np.inf
    assert lower == pytest.approx(0.5, rel=1e-15)
    assert (found.status_lower[0], found.status_upper[0]) == (Status.EXACT, Status.UNBOUNDED)


@pytest.mark.parametrize(
    ("expression", "operation"),
    [
        (ca.log(X[0]), "a logarithm"),
        (ca.sqrt(X[0]), "a square root"),
        (ca.tan(X[0]), "a tangent over a pole"),
        (X[0] ** 2.5, "a fractional or negative power"),
        (ca.asin(X[0]), "an arc sine"),
    ],
)
def test_domains_are_checked(expression, operation):
    found = bound_ranges(expression, X, [(-3, 3)] * 3)
    assert found.failures[0].operation.startswith(operation)


def test_budget_is_honest():
    wild = ca.sin(40 * X[0] * X[1]) * ca.cos(31 * X[1] * X[2]) + ca.sin(37 * X[2] * X[0])
    found = bound_ranges(wild, X, UNIT, rtol=1e-12, effort="fast")
    assert found.status[0] is Status.BUDGET
    assert found.lower[0] < found.attained_lower[0]
    assert found.upper[0] > found.attained_upper[0]
    assert found.boxes < 20_000
    better = bound_ranges(wild, X, UNIT, rtol=1e-4, effort="normal")
    assert better.gap[0] < found.gap[0]


def test_many_expressions_share_one_run():
    column = ca.vertcat(*[ca.sin(X[0] + k * X[1]) * ca.cos(X[2]) for k in range(8)])
    together = bound_ranges(column, X, UNIT, rtol=1e-6)
    for k in range(8):
        alone = bound_ranges(column[k], X, UNIT, rtol=1e-6)
        assert together.upper[k] == pytest.approx(alone.upper[0], abs=3e-6)


def test_constants_are_intervals_too():
    c = ca.SX.sym("c")
    found = bound_ranges(X[0] * c, X, [(1, 2)] * 3, c, [(0.1, 0.3)])
    assert found.lower[0] == pytest.approx(0.1, rel=1e-14)
    assert found.upper[0] == pytest.approx(0.6, rel=1e-14)
    assert found.attained_upper[0] <= 0.2 + 1e-14


def test_unbounded_variables_that_do_not_matter():
    free = [(-np.inf, np.inf), (0, 1), (0, 1)]
    found = bound_ranges(ca.vertcat(X[1] ** 2, ca.sin(X[0]), X[0] * X[1]), X, free)
    assert (found.lower[0], found.upper[0]) == pytest.approx((0.0, 1.0), abs=1e-15)
    assert (found.lower[1], found.upper[1]) == (-1.0, 1.0)
    assert found.status[2] is Status.UNBOUNDED


@pytest.mark.parametrize(
    "call",
    [
        lambda: bound_ranges(X[0], X, [(0, 1)] * 2),
        lambda: bound_ranges(X[0], X, [(1, 0)] * 3),
        lambda: bound_ranges(X[0], X, [(np.nan, 0)] * 3),
        lambda: bound_ranges(X[0], X[1:], [(0, 1)] * 2),
        lambda: bound_ranges(X[0], X, UNIT, effort="heroic"),
        lambda: bound_ranges(X[0], X, UNIT, rtol=-1.0),
        lambda: bound_ranges(X[0], X, UNIT, X[0], []),
    ],
)
def test_bad_questions_are_refused(call):
    with pytest.raises(DerivationError):
        call()


def test_a_slope_however_small_is_not_taken_for_none():
    """Mutant: slopes below 1e-12 count as falling, so the wrong end is looked at."""
    _, low, high = one(1e-13 * X[0])
    assert low <= -1e-13 and high >= 2e-13
