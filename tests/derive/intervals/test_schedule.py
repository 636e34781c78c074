"""Running operations in groups gives what running them one by one gives, in every bit."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from obsynth.derive.intervals.graph import Schedule
from obsynth.derive.intervals.program import Program
from obsynth.derive.intervals.ranges import make_problem, staged
from obsynth.derive.intervals.rules import RULES, uncertain
from obsynth.derive.intervals.search.batch import Entries
from obsynth.derive.intervals.search.branch import Budget, Search

QUICK = settings(max_examples=60, deadline=None, derandomize=True)
X = ca.SX.sym("x", 3)
UNARY = (ca.sin, ca.sqrt, ca.fabs, ca.exp, lambda a: a * a, lambda a: a**3, lambda a: 2.5 / a)
BINARY = (
    lambda a, b: a + b,
    lambda a, b: a - b,
    lambda a, b: a * b,
    lambda a, b: a / b,
    ca.fmin,
    lambda a, b: ca.if_else(a < b, a, b * b),
)


@st.composite
def columns(draw):
    """Several expressions that share parts."""
    parts = [X[0], X[1], X[2], ca.SX(0.3), ca.SX(2.0)]
    for _ in range(draw(st.integers(3, 14))):
        a, b = (parts[draw(st.integers(0, len(parts) - 1))] for _ in range(2))
        if draw(st.booleans()):
            parts.append(draw(st.sampled_from(UNARY))(a))
        else:
            parts.append(draw(st.sampled_from(BINARY))(a, b))
    return ca.vertcat(*parts[5:])


def boxes(seed, n=7):
    rng = np.random.default_rng(seed)
    lower = rng.uniform(-2, 2, (3, n))
    return lower, lower + rng.choice([0.0, 0.1, 3.0], (3, n))


def one_by_one(program, lower, upper):
    values = {}
    with np.errstate(all="ignore"):
        for k, node in enumerate(program.nodes):
            if k in program.constants:
                ends = program.constants[k]
            elif node.op == "input":
                ends = lower[node.number], upper[node.number]
            else:
                extra = (node.number,) if node.op == "power_int" else ()
                ends = RULES[node.op](*(values[a] for a in node.args), *extra)
            values[k] = tuple(np.broadcast_to(e, lower.shape[1:]) for e in ends)
    return values


def differ(schedule, program, seed):
    lower, upper = boxes(seed)
    expected, found = one_by_one(program, lower, upper), schedule.run(lower, upper)
    return any(
        not np.array_equal(a, b, equal_nan=True)
        for k in schedule.row
        for a, b in zip(expected[k], found.of(k), strict=True)
    )


@QUICK
@given(columns(), st.integers(0, 99))
def test_groups_give_what_single_operations_give(column, seed):
    program = Program.from_casadi(ca.Function("f", [X], [column]))
    everything = range(len(program.outputs))
    live = program.live(everything)
    assert not differ(Schedule(program, live, live), program, seed)
    schedule = program.schedule(everything, len(everything))
    assert not differ(schedule, program, seed)
    lower, upper = boxes(seed)
    rough, single = schedule.rough(schedule.run(lower, upper)), one_by_one(program, lower, upper)
    for k in everything:
        expected = np.zeros(lower.shape[1], dtype=bool)
        for n in program.breaks(k):
            node = program.nodes[n]
            expected |= uncertain(node.op, single[n], [single[a] for a in node.args])
        assert np.array_equal(rough[k], expected)


def test_narrow_blocks_give_the_same(monkeypatch):
    column = ca.vertcat(*(ca.sin(X[0] * k) * X[1] - X[2] ** 2 for k in range(1, 9)))
    program = Program.from_casadi(ca.Function("f", [X], [column]))
    schedule = program.schedule(range(8), 0)
    assert schedule.count < len(program.nodes) / 3
    monkeypatch.setattr(schedule, "_block", 2)
    assert not differ(schedule, program, 1)


def test_operands_in_the_wrong_row_are_caught(monkeypatch):
    column = ca.vertcat(X[0] - X[1], X[1] - X[2], X[0] * X[2])
    program = Program.from_casadi(ca.Function("f", [X], [column]))
    live = program.live(range(3))
    right = Schedule(program, live, live)
    assert not differ(right, program, 0)
    rows = "obsynth.derive.intervals.graph._rows"
    monkeypatch.setattr(rows, lambda found: np.array(found[::-1], dtype=np.int64))
    assert differ(Schedule(program, live, live), program, 0)


@pytest.mark.parametrize("cost", [0.0, 1e9])
def test_shared_and_single_programs_give_the_same(monkeypatch, cost):
    column = ca.vertcat(X[0] * X[1], ca.sin(X[2]) * X[0], 1 / X[1])
    program = Program.from_casadi(ca.Function("f", [X], [column]))
    lower, upper = boxes(3, 30)
    entry = np.arange(30) % 3
    monkeypatch.setattr("obsynth.derive.intervals.search.batch._COST_BOX", 1.0)
    monkeypatch.setattr("obsynth.derive.intervals.search.batch._COST_CALL", cost)
    found = Entries(program, np.array([[0, 1], [1, -1], [2, 0]])).enclose(
        entry, lower, upper, judged=True
    )
    whole = program.schedule(range(3), 3)
    values = whole.run(lower, upper)
    rough = whole.rough(values)
    for k, e in enumerate(entry):
        first, second = [(0, 1), (1, None), (2, 0)][e]
        ends = [values.of(program.outputs[first])[side][k] for side in (0, 1)]
        if not np.isfinite(ends).all():
            ends = [-np.inf, np.inf]
        assert [found.lower[0, k], found.upper[0, k]] == ends
        assert found.rough[k] == rough[e, k]
        if second is None:
            assert found.lower[1, k] == found.upper[1, k] == 0.0
    assert found.rough.any() and not found.rough.all()


def test_a_search_goes_on_where_it_stopped():
    f = ca.vertcat(ca.sin(X[0] * X[1]) + X[2] * X[0], ca.cos(3 * X[0]) * X[1] - X[2] ** 2)
    problem = make_problem(f, X, [(-1, 2), (-2, 2), (0, 3)])
    at_once = Search(problem, 1e-6).run(Budget(10_000, 100))
    search = Search(problem, 1e-6)
    first = search.run(Budget(10_000, 3))
    only = search.run(Budget(10_000, 100), [0])
    rest = search.run(Budget(10_000, 100))
    assert not first.finished.any()
    assert only.finished.tolist() == [True, True, False, False]
    assert rest.finished.all() and at_once.finished.all()
    assert np.all(first.bound >= only.bound) and np.all(only.bound >= rest.bound)
    assert np.all(rest.bound >= at_once.attained) and np.all(at_once.bound >= rest.attained)
    assert np.allclose(rest.bound, at_once.bound, rtol=0, atol=1e-5)


@pytest.mark.parametrize("boxes", [1, 40, 300])
def test_what_has_no_bound_does_not_keep_the_search_going(boxes):
    f = ca.vertcat(1 / (X[0] - X[1]), ca.sin(5 * X[0]) * X[2])
    problem = make_problem(f, X, [(0, 1), (0, 1), (-1, 2)])
    found = staged(problem, 1e-9, Budget(boxes, 200))
    assert found.bound[0] == found.bound[1] == np.inf
    assert np.isfinite(found.bound[2:]).all()
