"""Second derivatives and fewer variables: what they prove, that they help, and planted mistakes."""

from fractions import Fraction

import casadi as ca
import flint
import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from obsynth.derive.intervals import ranges
from obsynth.derive.intervals.ranges import Status, bound_ranges
from obsynth.derive.intervals.search import batch, branch, curvature, reduction
from obsynth.derive.intervals.search.curvature import Hessians
from obsynth.derive.intervals.search.reduction import SxGraph, reduce_variables
from obsynth.derive.jacobian.entries import jacobian_entries
from obsynth.symbolic import plants

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
    entries = jacobian_entries(plants.planar_arm(2, sp.Rational(981, 100)), "states")
    with_curvature = entries.search(1e-6, "normal").boxes
    monkeypatch.setattr(branch, "_FIRST_ORDER_SWEEPS", 10**9)
    assert entries.search(1e-6, "normal").boxes > 1.5 * with_curvature


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


def test_a_parabola_of_half_the_size_is_caught(exactly, at_once, monkeypatch):
    real = branch.taylor_spread
    monkeypatch.setattr(branch, "taylor_spread", lambda *a: 0.3 * real(*a))
    assert wrong_bounds(exactly, SADDLE, ROOM)


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
