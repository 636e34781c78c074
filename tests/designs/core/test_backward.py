"""What is known of nodes never cuts a point off that has led to it, and cuts what it can."""

import subprocess
from fractions import Fraction

import casadi as ca
import mpmath as mp
import numpy as np
import pytest
from operations import (
    BINARY,
    FAR,
    NEAR,
    TRIED,
    UP,
    WHOLE,
    drawn,
    program_of,
    result,
    written,
)
from tapes import NUMPY, tape

from obsynth.derive.intervals.graph import Node
from obsynth.derive.intervals.program import Program
from obsynth.derive.intervals.rules import RULES
from obsynth.designs.core.backward import contract
from obsynth.designs.core.boxes import Lifted, Rounding
from obsynth.designs.core.relaxation import relax


def code(program, ranges, rounding=None, known=()):
    """Contraction as a function of the ends of the variables and of every output.

    Returns lower ends, upper ends, whether something is empty. Exponents in `known` are numbers.
    """
    ends = [[ca.SX.sym("l"), ca.SX.sym("h")] for _ in ranges]
    told = [[ca.SX.sym("a"), ca.SX.sym("b")] for _ in program.outputs]
    variables = [
        Lifted.number(*r) if k in known else Lifted(*e, *r)
        for k, (e, r) in enumerate(zip(ends, ranges, strict=True))
    ]
    given = {node: Lifted(*pair) for node, pair in zip(program.outputs, told, strict=True)}
    cut, empty = contract(program, given, variables, rounding or Rounding())
    outputs = [*(v.lower for v in cut), *(v.upper for v in cut), empty]
    inputs = [e for pair in [*ends, *told] for e in pair]
    return ca.Function("f", inputs, [ca.SX(v) for v in outputs])


def affine(program, ranges):
    """Affine forms as a function of the ends of the variables."""
    ends = [[ca.SX.sym("l"), ca.SX.sym("h")] for _ in ranges]
    variables = [Lifted(*e, *r) for e, r in zip(ends, ranges, strict=True)]
    found = relax(program, program.outputs, variables, Rounding())
    outputs = [v for a in found for v in (*a.slopes.values(), a.centre, a.error)]
    return ca.Function("g", [e for pair in ends for e in pair], [ca.SX(v) for v in outputs])


def run(function, boxes, told):
    """Rows of lower ends, of upper ends, and of what is empty."""
    given = [end[None, :] for box in [*boxes, *told] for end in box]
    found = [np.array(v).ravel() for v in function(*given)]
    n = len(boxes)
    return found[:n], found[n : 2 * n], found[-1]


def doubles(value):
    """The doubles around a number, and FAR for what is beyond."""
    near = float(value)
    low = near if mp.mpf(near) <= value else np.nextafter(near, -np.inf)
    high = near if mp.mpf(near) >= value else np.nextafter(near, np.inf)
    return np.array([max(low, -FAR), min(high, FAR)])


def lost(case, count=24, rounding=None, seed=0):
    """Return how many points of boxes are cut off by an interval around their value."""
    rng = np.random.default_rng(seed)
    op, _, number = case.partition(" ")
    ranges_tried, value = TRIED[case]
    outside = 0
    for ranges in ranges_tried[:: 1 + len(ranges_tried) // 15]:
        known = [k for k, r in enumerate(ranges) if r[0] == r[1]]
        boxes = [drawn(rng, r, count) for r in ranges]
        if op == "meet":
            boxes[1] = np.stack([np.minimum(*boxes)[0], np.maximum(*boxes)[1]])
        share = rng.choice([0.0, 1.0, 0.3, 0.8], (len(ranges), count))
        points = [np.clip(b[0] + s * (b[1] - b[0]), *b) for b, s in zip(boxes, share, strict=True)]
        told, exact = (
            np.zeros((2, count)),
            [result(value, [p[k] for p in points]) for k in range(count)],
        )
        for k, known_value in enumerate(exact):
            if known_value is not None:
                wide = rng.choice([0.0, 0.0, 1e-3, 1.0], 2) * (1.0 + abs(float(known_value)))
                told[:, k] = doubles(known_value) + wide * [-1.0, 1.0]
        program = program_of(op, int(number or 0), len(ranges))
        function = code(program, ranges, rounding, known)
        lower, upper, empty = run(function, boxes, [told])
        for k in range(count):
            if exact[k] is not None:
                inside = zip(lower, points, upper, strict=True)
                kept = all(a[k] <= p[k] <= b[k] for a, p, b in inside)
                outside += not kept or empty[k] != 0
    return outside


def test_every_operation_is_tried():
    assert {name.split()[0] for name in TRIED} == set(RULES)


@pytest.mark.parametrize("case", TRIED)
def test_no_point_is_lost(case):
    assert lost(case) == 0


# -- how far ---------------------------------------------------------------------------------------

SHARP = {
    **dict.fromkeys(("exp", "expm1", "log", "log1p", "sinh", "tanh", "asinh"), ((0.25, 0.75),)),
    **dict.fromkeys(("atanh", "asin", "acos", "atan", "sine", "tangent", "sqrt"), ((0.25, 0.75),)),
    **dict.fromkeys(("negate", "twice", "absolute", "nonnegative"), ((0.25, 0.75),)),
    **dict.fromkeys(("add", "subtract", "multiply", "divide"), ((0.25, 0.75), (0.25, 0.75))),
    **dict.fromkeys(("hypotenuse", "arctangent2", "power"), ((0.25, 0.75), (1.25, 1.75))),
    **{f"power_int {n}": ((-0.75, -0.25),) for n in (2, 3, 4, 5)},
    "power_int 2 ": ((0.25, 0.75),),
    "power_int 3 ": ((-0.25, 0.75),),
    "absolute ": ((-0.75, -0.25),),
    "cosine": ((-0.75, -0.25),),
    "cosine ": ((0.25, 0.75),),
    "cosh": ((-0.75, -0.25),),
    "acosh": ((1.25, 1.75),),
    "power_const": ((0.25, 0.75), (-1.5, -1.5)),
    "power_const ": ((0.25, 0.75), (0.3, 0.3)),
}


@pytest.mark.parametrize("case", SHARP)
@pytest.mark.parametrize("wide", [False, True])
def test_cuts_are_sharp(case, wide):
    """What is told of a monotone operation comes back to 1e-12, every operand in its turn.

    From operands whose numbers know the side and from such whose ends alone do. Mutants: an end
    that is not cut, the wrong branch, an inverse that is off.
    """
    op, _, number = case.strip().partition(" ")
    value, ranges = TRIED[case.strip()][1], SHARP[case]
    for k, (low, high) in enumerate(ranges):
        if low == high:
            continue
        inner = [0.75 * low + 0.25 * high, 0.25 * low + 0.75 * high]
        middles = [0.5 * (a + b) for a, b in ranges]
        at = [[*middles[:k], end, *middles[k + 1 :]] for end in inner]
        told = sorted(float(result(value, point)) for point in at)
        ends = [
            list(r) if j == k else [m, m]
            for j, (r, m) in enumerate(zip(ranges, middles, strict=True))
        ]
        one_sided = {"log", "sqrt", "power_const", "power", "arctangent2", "divide", "nonnegative"}
        numbers = ranges
        if wide and op not in one_sided | {"acosh", "atanh", "asin", "acos", "log1p", "tangent"}:
            numbers = [r if r[0] == r[1] else (-2.0, 2.0) for r in ranges]
        exponents = [j for j, (a, b) in enumerate(ranges) if a == b]
        function = code(program_of(op, int(number or 0), len(ranges)), numbers, known=exponents)
        boxes = [np.array(e)[:, None] for e in ends]
        lower, upper, empty = run(function, boxes, [np.array(told)[:, None]])
        assert [lower[k][0], upper[k][0]] == pytest.approx(inner, rel=1e-12)
        assert not empty[0]


def exact_cut(op, k, z, others):
    """Exact ends of the operand k of an operation, its result and other operands in intervals."""
    z, other = ([Fraction(v) for v in ends] for ends in (z, others))
    corners = [(p, q) for p in z for q in other]
    if op == "add":
        found = [p - q for p, q in corners]
    elif op == "subtract":
        found = [q - p for p, q in corners] if k else [p + q for p, q in corners]
    elif op == "multiply":
        found = [p / q for p, q in corners]
    else:
        found = [q / p for p, q in corners] if k else [p * q for p, q in corners]
    return min(found), max(found)


@pytest.mark.parametrize("op", ["add", "subtract", "multiply", "divide"])
@pytest.mark.parametrize("numbers", [(0.25, 8.0), (0.0, 8.0), (-8.0, 8.0)])
def test_single_steps_are_as_exact_as_rationals_ask(op, numbers):
    """No end inside of the exact one, and none further than four units away.

    Mutants: the outward step left out; a divisor that may be zero not told from one that is not.
    """
    rng, count = np.random.default_rng(5), 40
    function = code(program_of(op, 0, 2), [numbers] * 2)
    z, b = (np.sort(rng.uniform(0.5, 2.0, (2, count)), axis=0) for _ in range(2))
    for k in (0, 1):
        boxes = [b, b]
        boxes[k] = np.array([[-FAR if numbers[0] < 0 else numbers[0]], [FAR]]) + np.zeros(count)
        found = run(function, boxes, [z])
        for n in range(count):
            low, high = exact_cut(op, k, z[:, n], b[:, n])
            got = [Fraction(float(found[side][k][n])) for side in (0, 1)]
            for end, exact, sign in zip(got, (low, high), (1, -1), strict=True):
                if boxes[k][0][n] < exact < boxes[k][1][n]:
                    gap = sign * (exact - end)
                    assert 0 <= gap <= 4 * Fraction(2.0**-52) * abs(exact) + Fraction(2.0**-50)


@pytest.mark.parametrize("n", [3, 4, 5, 7])
def test_roots_of_large_numbers_are_not_above_themselves(n):
    """The exponent 1/n is rounded itself. Mutant: that part left out."""
    rng, count = np.random.default_rng(8), 60
    z = 10.0 ** rng.uniform(-90, 90, count) * np.ones((2, 1))
    function = code(program_of("power_int", n, 1), [(0.0, 1e40)])
    lower, upper, _ = run(function, [np.array([[0.0], [1e40]]) + np.zeros(count)], [z])
    for low, high, told in zip(lower[0], upper[0], z[0], strict=True):
        assert Fraction(float(low)) ** n <= Fraction(float(told)) <= Fraction(float(high)) ** n
        assert high - low <= 1e-12 * high


@pytest.mark.parametrize("exponents", [(0.25, 0.35), (-1.75, -1.5), (0.3, 0.3 + 2.0**-50)])
def test_exponents_that_are_not_known_exactly(exponents):
    """Bases whose power, by an exponent between them, is told stay. Mutant: one exponent."""
    program = Program(n_variables=1)
    given = (program.variable(0), program.number(*exponents))
    program.outputs = [program.append(Node("power_const", given))]
    function = code(program, [(0.0, 30.0)])
    a = np.linspace(0.1, 20.0, 40)
    box = np.array([[0.0], [30.0]]) + np.zeros(40)
    for p in exponents:
        lower, upper, _ = run(function, [box], [doubles_of(a**p)])
        assert np.all((lower[0] <= a) & (a <= upper[0]))
        assert exponents[1] - exponents[0] > 0.01 or np.allclose(lower[0], upper[0], 1e-9)


def doubles_of(values):
    """Intervals of some units around numbers."""
    return values + np.array([[-1.0], [1.0]]) * 2.0**-50 * values


@pytest.mark.parametrize("op", ["power_int", "sqrt", "twice"])
def test_roots_and_squares_are_as_exact_as_rationals_ask(op):
    rng, count = np.random.default_rng(6), 60
    z = np.sort(rng.uniform(0.01, 3.0, (2, count)), axis=0)
    function = code(program_of(op, 2, 1), [(0.0, 100.0)])
    lower, upper, _ = run(function, [np.array([[0.0], [100.0]]) + np.zeros(count)], [z])
    for n in range(count):
        for end, told, sign in ((lower[0][n], z[0, n], 1), (upper[0][n], z[1, n], -1)):
            end, told = Fraction(float(end)), Fraction(float(told))
            image = {"power_int": end**2, "sqrt": end, "twice": 2 * end}[op]
            wanted = told**2 if op == "sqrt" else told
            assert 0 <= sign * (wanted - image) <= 8 * Fraction(2.0**-53) * wanted


# -- programs ----------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(8))
def test_random_programs(seed):
    """Points whose values are told stay; something is cut."""
    rng, count, gained = np.random.default_rng(seed), 8, 0
    ranges = (NEAR, UP, (-2.0, 0.5))
    in_code, exact = zip(*(written(rng, 4) for _ in range(3)), strict=True)
    x = ca.SX.sym("x", 3)
    program = Program.from_casadi(ca.Function("p", [x], [ca.vertcat(*(f(x) for f in in_code))]))
    function = code(program, ranges)
    boxes = [np.sort(rng.uniform(*r, (2, count)), axis=0) for r in ranges]
    share = rng.choice([0.0, 1.0, 0.3, 0.8], (3, count))
    points = [np.clip(b[0] + s * (b[1] - b[0]), *b) for b, s in zip(boxes, share, strict=True)]
    told = np.zeros((3, 2, count))
    for i, value in enumerate(exact):
        for k in range(count):
            found = result(lambda *point, value=value: value(point), [p[k] for p in points])
            told[i, :, k] = doubles(found) + rng.choice([0.0, 1e-3], 2) * [-1.0, 1.0]
    lower, upper, empty = run(function, boxes, list(told))
    assert not empty.any()
    for low, point, high, box in zip(lower, points, upper, boxes, strict=True):
        assert np.all((low <= point) & (point <= high))
        assert np.all((low >= box[0]) & (high <= box[1]))
        gained += np.sum((low > box[0]) | (high < box[1]))
    assert gained > 0


def of(expression, ranges, told, boxes):
    """Cut ends and emptiness of one expression f(x) for one box."""
    x = ca.SX.sym("x", len(ranges))
    program = Program.from_casadi(ca.Function("p", [x], [expression(x)]))
    function = code(program, ranges)
    lower, upper, empty = run(
        function, [np.array(b, dtype=float)[:, None] for b in boxes], [np.array(told)[:, None]]
    )
    return [(a[0], b[0]) for a, b in zip(lower, upper, strict=True)], bool(empty[0])


def test_a_branch_that_is_not_taken_is_not_asked_for_a_value():
    """x = -1/2 has the value told by the other branch, where the root has none.

    Mutant: whatever is below a choice is taken for defined.
    """
    found, empty = of(
        lambda x: ca.if_else(x[0] > 0.0, ca.fmin(ca.sqrt(x[0]) - 7.0, 1.0), -x[0]),
        [(-1.0, 4.0)],
        [0.5, 0.5],
        [(-1.0, 4.0)],
    )
    assert found[0][0] <= -0.5 <= found[0][1] and not empty


def test_a_quotient_that_is_not_taken_is_not_asked_for_a_value():
    """x_0 / x_1 at x_1 = 0 says nothing of x_0. Mutant: divisors taken for defined."""
    found, empty = of(
        lambda x: ca.if_else(x[1] > 0.0, x[0] / x[1], 5.0),
        [(-9.0, 9.0), (-1.0, 1.0)],
        [5.0, 5.0],
        [(-3.0, 3.0), (0.0, 0.0)],
    )
    assert found == [(-3.0, 3.0), (0.0, 0.0)] and not empty


@pytest.mark.parametrize(
    ("expression", "kept"),
    [
        (lambda x: ca.sqrt(x[0]), (0.25, 4.0)),
        (lambda x: ca.sqrt(x[0]) - 5.5, (36.0, 56.25)),
        (lambda x: ca.log(x[0]), (np.exp(0.5), 4.0)),
        (lambda x: 1.0 / x[0], (0.5, 2.0)),
        (lambda x: x[0] ** 2, (-2.0, 2.0)),
    ],
)
def test_a_told_node_has_a_value(expression, kept):
    """Outside of its domain nothing led there. Mutant: inverted only where defined everywhere."""
    told = [0.5, 2.0] if kept[0] > 0 else [0.5, 4.0]
    found, _ = of(expression, [(-FAR, FAR)], told, [(-3.0, 4.0 if kept[1] < 5 else 99.0)])
    assert found[0] == pytest.approx(kept, rel=1e-9)
    for function, told, kept in (
        (ca.sqrt, (-5.0, 0.5), (0.0, 0.25)),
        (ca.acos, (-0.5, 0.2), (np.cos(0.2), 1.0)),
    ):
        found = of(lambda x, f=function: f(x[0]), [WHOLE], told, [(-3.0, 4.0)])[0]
        assert found[0] == pytest.approx(kept)


DOMAINS = {"sqrt": (0, FAR), "log": (0, FAR), "asin": (-1, 1), "acos": (-1, 1)}


@pytest.mark.parametrize("told", [(-FAR, FAR), (np.nan, np.nan), (-np.inf, np.inf)])
@pytest.mark.parametrize("box", [(-FAR, FAR), (-2.0, 3.0)])
def test_what_says_nothing_cuts_nothing(told, box):
    """For every operation, from ends that are finite or not. Mutant: an end of FAR is a bound."""
    for case, (tried, _) in TRIED.items():
        op, _, number = case.partition(" ")
        for ranges in tried[:3]:
            known = [k for k, r in enumerate(ranges) if r[0] == r[1]]
            function = code(program_of(op, int(number or 0), len(ranges)), ranges, known=known)
            boxes = [np.clip(np.array(box), *r)[:, None] for r in ranges]
            lower, upper, _ = run(function, boxes, [np.array(told)[:, None]])
            for k, b in enumerate(boxes):
                # what is told has a value, so the domain is kept
                domain = {"sqrt": (0, FAR), "log": (0, FAR), "asin": (-1, 1), "acos": (-1, 1)}.get(
                    op, (-FAR, FAR)
                )
                low, high = np.clip(b[:, 0], *domain)
                assert k in known or (lower[k][0] <= low and upper[k][0] >= high), case


def test_what_has_no_bound_is_found():
    """An input d that nothing bounds, from the sum that it enters; a factor beside zero."""
    found, empty = of(lambda x: x[0] + 2.0 * x[1], [NEAR, WHOLE], [1.0, 2.0], [(0, 1), WHOLE])
    assert found[1] == pytest.approx((0.0, 1.0)) and not empty
    ranges = [WHOLE, (0.0, 4.0)]
    assert of(lambda x: x[0] * x[1], ranges, [1.0, 2.0], [WHOLE, (0, 4)])[0][0] == (
        pytest.approx(0.25),
        FAR,
    )
    assert of(lambda x: x[0] * x[1], ranges, [0.0, 2.0], [WHOLE, (0, 4)])[0][0] == WHOLE
    assert of(lambda x: x[0] * x[1], ranges, [-2.0, 0.0], [WHOLE, (0, 4)])[0][0] == WHOLE


def test_numbers_of_what_is_told_hold_whatever_the_ends_are():
    """An end that is no number leaves the sign. Mutant: an end outside of its numbers."""
    program, x = Program(n_variables=1), [ca.SX.sym("l"), ca.SX.sym("h")]
    program.outputs = [program.variable(0)]
    told = Lifted(ca.SX(np.nan), ca.SX(np.nan), 0.0, 4.0)
    (cut,), _ = contract(program, {0: told}, [Lifted(*x, -3.0, 5.0)], Rounding())
    found = ca.Function("f", x, [ca.SX(cut.lower), ca.SX(cut.upper)])(-2.0, 3.0)
    assert [float(v) for v in found] == [0.0, 3.0] and cut.low == 0.0


def test_what_cannot_be_is_empty():
    """Told node and variable. Mutant: emptiness of variables alone."""
    assert of(lambda x: x[0] ** 2, [NEAR], [-2.0, -1.0], [(-1, 2)])[1]
    assert of(lambda x: x[0] + x[1], [NEAR, NEAR], [7.0, 8.0], [(0, 1), (0, 1)])[1]
    assert of(lambda x: 3.0 + 0.0 * x[0], [NEAR], [7.0, 8.0], [(0, 1)])[1]
    x = ca.SX.sym("x", 1)
    both = ca.Function("p", [x], [ca.vertcat(2.0 * x, ca.exp(x))])
    function = code(Program.from_casadi(both), [NEAR])
    told = [np.array([[0.0], [0.4]]), np.array([[2.2], [2.5]])]
    assert run(function, [np.array([[0.0], [1.0]])], told)[2][0] == 1.0
    assert not of(lambda x: x[0] + x[1], [NEAR, NEAR], [1.0, 1.0], [(0, 1), (0, 1)])[1]


# -- code ------------------------------------------------------------------------------------------


def test_compiled_code_returns_the_same_bits(tmp_path):
    """Also where ends are beyond everything or no numbers, for contraction and affine forms."""
    x, rng = ca.SX.sym("x", 3), np.random.default_rng(9)
    rows = [f(x[0], x[1]) for f, _ in BINARY] + [ca.fmin(x[0] ** 4, ca.exp(x[1])), x[0] / x[2]]
    rows += [ca.sqrt(x[0]), ca.sin(x[2]), ca.atan(x[0]), ca.fabs(x[2]), ca.tanh(x[0] - x[1])]
    program = Program.from_casadi(ca.Function("p", [x], [ca.vertcat(*rows)]))
    ranges = [WHOLE, UP, NEAR]
    function = code(program, ranges)
    forms = affine(program, ranges)
    made = ca.CodeGenerator("made.c")
    for f in (function, forms):
        made.add(f)
    made.generate(f"{tmp_path}/")
    command = "cc -std=c99 -O0 -ffp-contract=off -shared -fPIC -o made.so made.c -lm"
    subprocess.run(command.split(), cwd=tmp_path, check=True)
    odd = np.array([-FAR, FAR, np.nan, np.inf, -np.inf, 0.0, -0.0, 1e-310, 1e200, -1e200])
    for f in (function, forms):
        compiled = ca.external(f.name(), f"{tmp_path}/made.so")
        for _ in range(60):
            given = rng.normal(0.0, 2.0, f.n_in())
            given = np.where(rng.uniform(size=f.n_in()) < 0.2, rng.choice(odd, f.n_in()), given)
            ends = np.array([[float(v) for v in g(*given)] for g in (f, compiled)])
            assert np.array_equal(ends[0], ends[1], equal_nan=True)


@pytest.mark.parametrize("op", ["add", "subtract", "multiply", "divide"])
@pytest.mark.parametrize("precision", ["single", "double"])
def test_single_precision_steps_over_its_own_rounding(op, precision):
    """No end inside of the exact one in code that is run in single precision.

    Mutant: the step of doubles, which is lost in floats.
    """
    rng, count, inside = np.random.default_rng(3), 100, 0
    z, a = (np.sort(rng.uniform(0.5, 3.0, (2, count)).astype(np.float32), axis=0) for _ in range(2))
    free = [np.full(count, end, np.float32) for end in (-99.0, 99.0)]
    function = code(program_of(op, 0, 2), [UP, (-99.0, 99.0)], Rounding(precision))
    with np.errstate(all="ignore"):
        given = [[v] for v in (*a, *free, *z)]
        found = tape(function, given, NUMPY, lambda v: np.full(count, v, dtype=np.float32))
    for k in range(count):
        low, high = exact_cut(op, 1, z[:, k].astype(float), a[:, k].astype(float))
        inside += not Fraction(float(found[1][k])) <= low <= high <= Fraction(float(found[3][k]))
    assert (inside == 0) == (precision == "single")
