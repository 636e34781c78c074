"""Second derivatives and fewer variables: what they prove, that they help, and planted mistakes."""

from fractions import Fraction

import casadi as ca
import flint
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from obsynth.derive.intervals import ranges
from obsynth.derive.intervals.ranges import Status, bound_ranges
from obsynth.derive.intervals.search import batch, branch, curvature, reduction
from obsynth.derive.intervals.search.batch import RowRanges, Rows
from obsynth.derive.intervals.search.curvature import Hessians, is_concave
from obsynth.derive.intervals.search.reduction import SxGraph, reduce_variables

X = ca.SX.sym("x", 4)
NONE = ca.SX(0, 1)
QUICK = settings(max_examples=40, deadline=None, derandomize=True)

SMOOTH = {
    "sin": ca.sin,
    "cos": ca.cos,
    "exp": lambda a: ca.exp(-a * a),
    "tanh": ca.tanh,
    "square": lambda a: a * a,
    "bell": lambda a: 1 / (1 + a * a),
    "root": lambda a: ca.sqrt(a * a + 0.5),
    "atan": ca.atan,
    "kink": ca.fabs,
}
JOINS = {"add": lambda a, b: a + b, "sub": lambda a, b: a - b, "mul": lambda a, b: a * b}


@st.composite
def expressions(draw, depth=4):
    if depth == 0 or draw(st.integers(0, 6)) == 0:
        return draw(st.sampled_from([X[0], X[1], X[2], X[3], X[0] - X[1], X[2] * X[3] + 0.3]))
    if draw(st.booleans()):
        return SMOOTH[draw(st.sampled_from(sorted(SMOOTH)))](draw(expressions(depth=depth - 1)))
    join = JOINS[draw(st.sampled_from(sorted(JOINS)))]
    return join(draw(expressions(depth=depth - 1)), draw(expressions(depth=depth - 1)))


def wrong_bounds(exactly, expression, box, effort="fast", rtol=1e-6):
    """Points with a value beyond the bounds, and attained values that are not attained."""
    found = bound_ranges(expression, X, box, rtol=rtol, effort=effort)
    function = ca.Function("f", [X], [ca.densify(ca.vec(expression))])
    box = np.array(box, dtype=float)
    share = np.random.default_rng(0).random((12, 4))
    share[:4] = np.round(share[:4])
    points = [*(box[:, 0] + share * (box[:, 1] - box[:, 0])), *found.points_lower]
    bad = []
    for point in [*points, *found.points_upper]:
        for k, ball in enumerate(exactly(function, np.clip(point, box[:, 0], box[:, 1]))):
            if ball < flint.arb(found.lower[k]) or ball > flint.arb(found.upper[k]):
                bad.append((k, point))
    for k in range(len(found.lower)):
        if exactly(function, found.points_lower[k])[k] > flint.arb(found.attained_lower[k]):
            bad.append((k, "lower"))
        if exactly(function, found.points_upper[k])[k] < flint.arb(found.attained_upper[k]):
            bad.append((k, "upper"))
    return bad


@QUICK
@given(expression=expressions(), seed=st.integers(0, 9))
def test_random_smooth_expressions_stay_inside(exactly, expression, seed):
    low = np.random.default_rng(seed).choice([-2.0, -0.5, 0.0, 0.3], 4)
    box = np.column_stack([low, low + np.random.default_rng(seed).choice([0.0, 0.2, 1.5], 4)])
    assert not wrong_bounds(exactly, expression, box)


@pytest.mark.long
@settings(max_examples=1500, deadline=None, derandomize=True)
@given(expression=expressions(depth=5), seed=st.integers(0, 999))
def test_many_random_smooth_expressions(exactly, expression, seed):
    low = np.random.default_rng(seed).choice([-2.0, -0.5, 0.0, 0.3], 4)
    box = np.column_stack([low, low + np.random.default_rng(seed).choice([0.0, 0.2, 1.5], 4)])
    assert not wrong_bounds(exactly, expression, box)


# -- what they are for -------------------------------------------------------------------------

ROOM = [(-1.0, 2.0)] * 4
# a ridge that is not along an axis, with a top inside
TILTED = -((X[0] - 0.3) ** 2) - (X[0] + X[1] - X[2]) ** 2 - (X[1] + 2 * X[2]) ** 2
HILL = ca.exp(TILTED - (X[3] - X[0] * X[1]) ** 2)


def test_an_inner_summit_is_settled_and_not_surrounded():
    found = bound_ranges(HILL, X, ROOM, rtol=1e-9)
    assert found.upper[0] == pytest.approx(1.0, abs=1e-9)
    assert found.status_upper[0] in (Status.EXACT, Status.CONVERGED)
    assert found.boxes < 20_000


def test_the_first_order_alone_needs_many_more_boxes(monkeypatch):
    with_curvature = bound_ranges(HILL, X, ROOM, rtol=1e-9).boxes
    monkeypatch.setattr(branch, "_FIRST_ORDER_SWEEPS", 10**9)
    assert bound_ranges(HILL, X, ROOM, rtol=1e-9).boxes > 4 * with_curvature


def test_a_summit_that_is_a_surface_is_found_in_fewer_variables():
    slip = (X[0] + 2 * X[1]) / (X[2] + 3)
    force = ca.sin(1.4 * ca.atan(9 * slip - 0.2 * (9 * slip - ca.atan(9 * slip)))) + X[3] ** 2
    found = bound_ranges(force, X, ROOM, rtol=1e-9)
    assert found.upper[0] == pytest.approx(5.0, abs=1e-9)
    assert found.gap[0] <= 1e-9 * (found.upper[0] - found.lower[0])
    assert found.boxes < 20_000


def test_a_reduced_expression_is_attained_at_a_point_of_the_box(exactly):
    expression = ca.cos(3 * (X[0] * X[1] - X[2])) + X[3]
    found = bound_ranges(expression, X, ROOM, rtol=1e-9)
    function = ca.Function("f", [X], [expression])
    for point, value in (
        (found.points_lower[0], found.attained_lower[0]),
        (found.points_upper[0], found.attained_upper[0]),
    ):
        assert ((np.array(ROOM)[:, 0] <= point) & (point <= np.array(ROOM)[:, 1])).all()
        assert abs(exactly(function, point)[0] - flint.arb(value)) < 1e-12
    assert found.attained_upper[0] == pytest.approx(3.0, abs=1e-9)
    assert found.attained_lower[0] == pytest.approx(-2.0, abs=1e-9)


def test_a_goal_of_large_size_does_not_take_the_budget_of_a_small_one():
    hard = 1e6 * ca.sin(9 * X[0] * X[1] + 3 * X[2]) * ca.fabs(ca.sin(7 * X[2] * X[3] - X[0]))
    easy = 1e-3 * X[0] * ca.fabs(X[1] - 0.1) * (X[2] - 0.4)
    found = bound_ranges(ca.vertcat(hard, easy), X, ROOM, rtol=1e-6, effort="fast")
    assert found.gap[1] <= 1e-6 * (found.upper[1] - found.lower[1])


def test_no_bound_is_named_in_the_variables_of_the_user():
    found = bound_ranges(1 / (X[0] + X[1]) + ca.sin(X[2]), X, ROOM)
    (failure,) = found.failures
    assert failure.lower.shape == (4,)
    assert failure.lower[0] + failure.lower[1] <= 0 <= failure.upper[0] + failure.upper[1]


# -- parts -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kink", [ca.fabs(X[0]), ca.fmax(X[0], X[1] ** 2), ca.sign(X[0]) * X[0]])
def test_second_derivatives_across_a_kink_are_not_used(kink):
    problem = ranges.make_problem(kink * X[2], X, ROOM)
    made = curvature.Curvatures(problem.source, problem.program)
    low, high = problem.lower[:, None], problem.upper[:, None]
    assert not made.enclose(np.array([1]), low, high).usable.any()


def test_concavity_is_proved_for_every_matrix_between_the_bounds():
    rng = np.random.default_rng(3)
    proved = refused = 0
    for _ in range(300):
        n = int(rng.integers(1, 5))
        middle = rng.normal(size=(n, n))
        middle = middle + middle.T - rng.uniform(0, 4) * np.eye(n)
        radius = rng.uniform(0, 0.3) * rng.random((n, n))
        radius = radius + radius.T
        bounds = Hessians((middle - radius)[None], (middle + radius)[None], np.array([True]))
        free = rng.random((n, 1)) < 0.8
        concave = bool(is_concave(bounds, free)[0])
        some = [
            middle + np.where(upper, radius, -radius)
            for upper in (np.triu(s) | np.triu(s).T for s in rng.random((20, n, n)) < 0.5)
        ]
        keep = np.flatnonzero(free[:, 0])
        largest = max(
            (np.linalg.eigvalsh(m[np.ix_(keep, keep)]).max(initial=-1.0) for m in some),
        )
        assert not concave or largest < 0
        proved, refused = proved + concave, refused + (not concave)
    assert proved > 40 < refused


def test_what_is_not_usable_is_not_concave():
    bounds = Hessians(-np.ones((1, 1, 1)), -np.ones((1, 1, 1)), np.array([False]))
    assert not is_concave(bounds, np.ones((1, 1), dtype=bool))[0]


def test_only_quantities_that_share_no_variable_are_taken():
    def names(expression):
        graph = SxGraph(expression, X, NONE)
        return sorted(str(graph.expression(n)) for n in graph.quantities(0))

    sum_, product = X[0] + X[1], X[2] * X[3]
    assert names(ca.sin(sum_) * ca.exp(sum_) + product) == ["(x_0+x_1)", "(x_2*x_3)"]
    assert names(ca.sin(sum_) * X[0] + product) == ["(x_2*x_3)", "(x_0*sin((x_0+x_1)))"][::-1]
    assert names(sum_) == []
    assert names(ca.sin(sum_)) == ["(x_0+x_1)"]
    assert names(ca.sin(sum_ / X[2]) + X[2]) == ["(x_0+x_1)"]


def test_equal_quantities_written_twice_are_one_variable():
    twice = ca.sin(X[0] + 2 * X[1]) + ca.cos(2 * X[1] + X[0])
    found = reduce_variables(ca.vertcat(twice, ca.exp(X[0] + 2 * X[1])), X, NONE, [0, 1])
    assert found.symbols.numel() == 1
    assert found.used == [[0], [0]]
    assert found.supports == [[0, 1]]


# -- planted mistakes --------------------------------------------------------------------------

SADDLE = X[0] ** 2 - X[1] ** 2 + ca.sin(3 * X[0] * X[1]) + X[2] * X[3] ** 2 - X[2] ** 2
COMPOSED = ca.sin(5 * (X[0] + X[1])) * ca.exp(X[2] / 3) + ca.cos(4 * X[2] * X[3])


@pytest.fixture
def at_once(monkeypatch):
    monkeypatch.setattr(branch, "_FIRST_ORDER_SWEEPS", 0)


def test_planted_mistakes_start_from_what_is_right(exactly, at_once):
    for expression in (HILL, SADDLE, COMPOSED):
        assert not wrong_bounds(exactly, expression, ROOM)


def test_second_derivatives_of_wrong_sign_are_caught(exactly, at_once, monkeypatch):
    real = curvature.Curvatures.enclose

    def wrong(self, goal, lower, upper):
        found = real(self, goal, lower, upper)
        return Hessians(-found.upper, -found.lower, found.usable)

    monkeypatch.setattr(curvature.Curvatures, "enclose", wrong)
    assert wrong_bounds(exactly, SADDLE, ROOM)


def test_concavity_that_is_not_there_is_caught(exactly, at_once, monkeypatch):
    monkeypatch.setattr(branch, "is_concave", lambda hessians, free: hessians.usable)
    bent = ca.exp(-((4 * X[0] - 1) ** 2)) + ca.exp(-((4 * X[0] - 6) ** 2 + X[1] ** 2)) * 1.5
    assert not wrong_bounds(exactly, TILTED, ROOM)
    real = curvature.Curvatures.enclose

    def everywhere(self, goal, lower, upper):
        found = real(self, goal, lower, upper)
        low = np.minimum(found.lower, -1e-9)
        return Hessians(low, np.minimum(found.upper, -1e-9), found.usable)

    monkeypatch.setattr(curvature.Curvatures, "enclose", everywhere)
    assert wrong_bounds(exactly, bent + SADDLE, ROOM)


def test_a_parabola_of_half_the_size_is_caught(exactly, at_once, monkeypatch):
    real = branch.taylor_spread
    monkeypatch.setattr(branch, "taylor_spread", lambda *a: 0.3 * real(*a))
    assert wrong_bounds(exactly, SADDLE, ROOM)


def test_a_tangent_that_does_not_rise_is_caught(at_once, monkeypatch):
    from obsynth.derive.intervals.search import curvature

    bowl = -((X[0] - 0.1) ** 2) - (X[1] - X[0]) ** 2 - (X[2] + 0.5 * X[1]) ** 2 - X[3] ** 2
    # the top is not at the middle of the box, and the climber is held there
    monkeypatch.setattr(curvature, "_newton", lambda rows, hessians, at, slope: at)
    assert bound_ranges(bowl, X, ROOM).upper[0] >= 0.0
    monkeypatch.setattr(
        curvature, "tangent_rise", lambda low, high, at, ends: np.zeros(low.shape[1])
    )
    assert bound_ranges(bowl, X, ROOM).upper[0] < -0.01


@pytest.mark.parametrize("side", [1, -1])
def test_tangents_are_bounded_on_both_sides(side):
    low, high, at = np.array([[-1.0]]), np.array([[3.0]]), np.array([[0.5]])
    slope = np.array([[2.0 * side]])
    rise = curvature.tangent_rise(low, high, at, (slope, slope))[0]
    assert rise == pytest.approx(5.0 if side > 0 else 3.0, rel=1e-14)
    assert rise >= (5.0 if side > 0 else 3.0)


def test_a_quantity_whose_variables_stand_elsewhere_too_costs_tightness_and_says_so(
    exactly, monkeypatch
):
    entangled = ca.sin(5 * (X[0] + X[1])) - ca.cos(5 * X[0]) * X[2] * X[3]
    right = bound_ranges(entangled, X, ROOM, rtol=1e-6)
    assert right.gap[0] <= 1e-6 * (right.upper[0] - right.lower[0])

    def first_sum(self, output):
        live = self._live(self.roots[output])
        return [n for n in live if self.supports[n] == {0, 1} and n != self.roots[output]][-1:]

    monkeypatch.setattr(ranges, "_QUICK", branch.Budget(boxes=1, sweeps=1))
    monkeypatch.setattr(reduction.SxGraph, "quantities", first_sum)
    assert not wrong_bounds(exactly, entangled, ROOM)
    found = bound_ranges(entangled, X, ROOM, rtol=1e-6)
    assert found.gap[0] > 1e-3
    assert found.status[0] is Status.BUDGET


def test_a_range_of_a_quantity_that_is_too_narrow_is_caught(exactly, monkeypatch):
    real = ranges.make_problem

    def narrow(expressions, variables, box, *constants):
        box = np.array(box, dtype=float)
        if len(box) > 4:
            width = box[4:, 1] - box[4:, 0]
            box[4:, 0] += 0.2 * width
            box[4:, 1] -= 0.2 * width
        return real(expressions, variables, box, *constants)

    monkeypatch.setattr(ranges, "_FEW", 0)
    monkeypatch.setattr(ranges, "make_problem", narrow)
    rising = ca.atan(X[0] + X[1] + ca.sin(4 * X[0] * X[1])) * ca.exp(X[2] * X[3] - X[2])
    assert wrong_bounds(exactly, rising, ROOM)


def test_the_spread_of_a_product_is_reached_at_a_corner():
    """c x y about the middle rises by c r_x r_y; mutant: the cross term halved."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        c, radius = rng.uniform(0.1, 10.0), rng.uniform(0.1, 3.0, (2, 1))
        bend = np.array([[[0.0, c], [c, 0.0]]])
        hessians = curvature.Hessians(bend, bend, np.array([True]))
        flat = np.zeros((2, 1))
        spread = curvature.taylor_spread(-radius, radius, flat, (flat, flat), hessians)
        assert c * radius.prod() <= spread[0] <= c * radius.prod() * (1.0 + 1e-12)


def test_the_bound_of_a_concave_goal_starts_from_the_upper_end_at_the_top():
    """c - (x - .3)^2 - (y + x)^2 with c in [0, 1] rises to 1, not to 0.

    Mutant: found.lower for found.upper in concave_bounds.
    """
    offset = ca.SX.sym("c")

    def evaluate(rows):
        x, y = rows.lower
        low = -((x - 0.3) ** 2) - (x + y) ** 2
        slope = np.array([-2 * (x - 0.3) - 2 * (x + y), -2 * (x + y)])
        return RowRanges(low, low + 1.0, slope, slope, np.zeros(len(x), dtype=bool))

    box = np.array([[-1.0], [-1.0]]), np.array([[1.0], [1.0]])
    rows = Rows(np.array([1]), *box, np.array([np.inf]))
    bend = np.array([[[-4.0, -2.0], [-2.0, -2.0]]])
    start = np.zeros((2, 1))
    hessians = Hessians(bend, bend, np.array([True]))
    slope = evaluate(Rows(rows.goal, start, start, rows.bound)).slope_lower
    bound = curvature.concave_bounds(
        rows, hessians, start, slope, evaluate, lambda r: r.bound > 1.0 + 1e-9
    )
    assert 1.0 <= bound[0] <= 1.0 + 1e-9
    goal = offset - (X[0] - 0.3) ** 2 - (X[0] + X[1]) ** 2
    found = bound_ranges(goal, X[:2], [(-1, 1), (-1, 1)], offset, [(0.0, 1.0)])
    assert 1.0 <= found.upper[0] <= 1.0 + 1e-6


@pytest.mark.parametrize("bent", ["HILL", "SADDLE", "COMPOSED", "BOWL", "WAVE"])
def test_what_is_not_known_of_a_constant_is_not_lost(at_once, bent):
    """f + c with c in [0, 1] and its negative; mutants: a lower end where a bound starts."""
    more = {"BOWL": X[0] ** 2 + (X[1] - X[0]) ** 2 + ca.exp(X[2]), "WAVE": ca.sin(3 * X[0])}
    expression = more.get(bent, globals().get(bent))
    offset = ca.SX.sym("c")
    alone = bound_ranges(expression, X, ROOM, effort="fast")
    moved = bound_ranges(
        ca.vertcat(expression + offset, -expression - offset),
        X,
        ROOM,
        offset,
        [(0.0, 1.0)],
        effort="fast",
    )
    assert moved.lower[0] <= alone.attained_lower[0]
    assert moved.upper[0] >= alone.attained_upper[0] + 1.0
    assert moved.lower[1] <= -alone.attained_upper[0] - 1.0
    assert moved.upper[1] >= -alone.attained_lower[0]


@pytest.mark.parametrize(
    "roof",
    [-ca.fabs(X[0] - 0.3), X[1] - 2 * ca.fabs(X[0] + X[1] - 0.3), ca.fmin(X[0], 0.6 - X[0])],
)
def test_what_has_a_kink_is_not_split_into_facets(exactly, at_once, roof):
    """Mutant: second derivatives that are not known taken for zero, and the roof for convex."""
    assert not wrong_bounds(exactly, roof, ROOM)


def test_terms_of_the_mean_value_form_hold_the_exact_products():
    """Mutants: the radius, or its product with the slope, rounded to nearest."""
    rng = np.random.default_rng(0)
    lower, width = rng.uniform(-1.0, 0.0, (3, 3000)), rng.uniform(1.0, 3.0, (3, 3000))
    upper = lower + width
    centre = np.clip(0.5 * (lower + upper), lower, upper)
    slope = rng.uniform(1.0, 2.0, (3, 3000))
    terms = batch.mean_value_terms(lower, upper, centre, slope, slope)
    numbers = (part.ravel().tolist() for part in (lower, upper, centre, slope, terms))
    for low, high, middle, s, term in zip(*numbers, strict=True):
        reach = max(Fraction(high) - Fraction(middle), Fraction(middle) - Fraction(low))
        assert Fraction(term) >= abs(Fraction(s)) * reach
