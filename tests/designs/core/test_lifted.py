"""Lifted intervals never miss an exact value, and are as narrow as the rules of the derivations."""

from fractions import Fraction

import casadi as ca
import mpmath as mp
import numpy as np
import pytest
from operations import CASES, NEAR, PRECISION, TRUTHS, UP, drawn, points, written
from tapes import NUMPY, tape

from obsynth.derive.intervals.graph import Node
from obsynth.derive.intervals.program import Program, constant_interval, evaluate
from obsynth.derive.intervals.rules import RULES
from obsynth.designs.core import lifted
from obsynth.designs.core.boxes import FAR, Lifted, Rounding
from obsynth.designs.core.lifted import lift

ROUNDED = [
    *("add", "subtract", "multiply", "divide", "power_int", "power_const", "power", "sqrt"),
    *("hypotenuse", "arctangent2", "exp", "expm1", "log", "log1p", "sinh", "cosh", "tanh"),
    *("asinh", "acosh", "atanh", "asin", "acos", "atan", "erf", "sine", "cosine", "tangent"),
]


def test_every_form_is_tried():
    assert {name.split()[0] for name in CASES} == set(lifted._FORMS)
    assert set(ROUNDED) <= set(lifted._FORMS)


def test_a_constant_interval_has_its_ends():
    found = Lifted.number(1.0, 2.0)
    assert (float(found.lower), float(found.upper)) == (found.low, found.high) == (1.0, 2.0)


def code(op, number, ranges, rounding):
    """One operation as a function of the ends of its operands."""
    ends = [(ca.SX.sym("l"), ca.SX.sym("h")) for _ in ranges]
    operands = [Lifted(*pair, *given) for pair, given in zip(ends, ranges, strict=True)]
    found = lifted._Arithmetic(rounding).apply(Node(op, (), number), operands)
    function = ca.Function("f", [e for pair in ends for e in pair], [found.lower, found.upper])
    return function, (found.low, found.high)


def run(function, boxes):
    given = [end[None, :] for box in boxes for end in box]
    return [np.array(v).ravel() for v in function(*given)]


def missed(case, count=10, rounding=None, seed=0):
    """Return how many exact values are outside of a lifted operation, and the ends it gave.

    Outside of the ends, or of the numbers that hold both.
    """
    rng = np.random.default_rng(seed)
    op, _, number = case.partition(" ")
    tried, value = CASES[case]
    outside, ends = 0, []
    for ranges in tried:
        boxes = [drawn(rng, r, count) for r in ranges]
        if op == "meet":
            boxes[1] = np.sort([np.clip(boxes[0][0], *ranges[1]), boxes[1][1]], axis=0)
        function, (least, most) = code(op, int(number or 0), ranges, rounding or Rounding())
        low, high = run(function, boxes)
        ends.append((ranges, boxes, low, high))
        truths = [
            (b == 0.0) | (b == 1.0) for r, b in zip(ranges, boxes, strict=True) if r in TRUTHS
        ]
        assert all(t.all() for t in truths)
        with mp.workprec(PRECISION):
            for numbers in points(rng, boxes):
                for k in range(count):
                    given = [mp.mpf(float(v[k])) for v in numbers]
                    if op == "divide" and given[1] == 0:
                        continue
                    if op == "meet" and not boxes[1][0][k] <= given[0] <= boxes[1][1][k]:
                        continue
                    if any(
                        r in TRUTHS and g not in (0, 1) for r, g in zip(ranges, given, strict=True)
                    ):
                        continue
                    try:
                        exact = value(*given)
                    except (ValueError, ZeroDivisionError):
                        continue
                    if abs(exact) < FAR:  # what is beyond counts as FAR
                        outside += not (low[k] <= exact <= high[k] and least <= exact <= most)
    return outside, ends


@pytest.mark.parametrize("case", CASES)
def test_no_exact_value_is_outside(case):
    outside, _ = missed(case)
    assert outside == 0


@pytest.mark.parametrize("case", CASES)
def test_ends_are_those_of_the_rules(case):
    """To some units in the last place, wherever the rules know an end."""
    op, _, number = case.partition(" ")
    extra = (int(number),) if number else ()
    for ranges, boxes, low, high in missed(case, seed=1)[1]:
        with np.errstate(all="ignore"):
            rule = RULES[op](*(tuple(b) for b in boxes), *extra)
        apart = True if op != "divide" else (boxes[1][0] > 0) | (boxes[1][1] < 0)
        for got, wanted in zip((low, high), rule, strict=True):
            known = np.isfinite(wanted) & (np.abs(wanted) < FAR) & apart
            size = np.maximum(np.abs(got), np.abs(wanted))
            with np.errstate(invalid="ignore"):  # of ends that are not known
                near = np.abs(got - wanted) <= 64 * 2.0**-53 * size + 1e-300
            assert near[known].all(), ranges
            assert known.any()


class _NoStep(Rounding):
    step = 0.0
    tiny = 0.0


@pytest.mark.parametrize("op", ROUNDED)
def test_without_the_step_over_rounding_values_are_missed(op):
    """Mutant: ends as floating point has them."""
    assert missed("power_int 3" if op == "power_int" else op, rounding=_NoStep())[0] > 0


def swapped(a, b):
    """Mutant: where both signs are known the ends are taken the wrong way round."""
    lower, upper = product(a, b)
    known = (a.low >= 0.0 or a.high <= 0.0) and (b.low >= 0.0 or b.high <= 0.0)
    return (upper, lower) if known else (lower, upper)


def unlike(a, b):
    """Mutant: the sign of the second factor is not asked."""
    if a.low >= 0.0:
        return a.lower * b.lower, a.upper * b.upper
    return product(a, b)


product = lifted._product


def without_zero(self, args, low, high, n):
    squares = [end * end for end in (args[0].lower, args[0].upper)]
    return self.rounding.interval(ca.fmin(*squares), ca.fmax(*squares), low, high)


@pytest.mark.parametrize("mutant", [swapped, unlike])
def test_a_case_of_signs_that_is_wrong_is_seen(mutant, monkeypatch):
    monkeypatch.setattr(lifted, "_product", mutant)
    assert missed("multiply")[0] > 0


@pytest.mark.parametrize(
    ("case", "name", "mutant"),
    [
        ("sine", "_may_cross", lambda self, a, phase: False),
        ("cosine", "_crosses", lambda self, a, phase: ca.SX(0)),
        ("power_int 2", "power_int", without_zero),
        (
            "subtract",
            "subtract",
            lambda self, a, low, high: lifted._Arithmetic.add(
                self, [a[0], Lifted(-a[1].lower, -a[1].upper, -a[1].low, -a[1].high)], low, high
            ),
        ),
    ],
)
def test_other_wrong_forms_are_seen(case, name, mutant, monkeypatch):
    """Mutants: crests forgotten; no zero in a square; the ends of b not exchanged."""
    monkeypatch.setattr(lifted._Arithmetic, name, mutant)
    if name in lifted._FORMS:
        monkeypatch.setitem(lifted._FORMS, name, mutant)
    assert missed(case)[0] > 0


# -- what a form is not known for, numbers, single precision ------------------------------------


@pytest.mark.parametrize(
    ("op", "ranges", "wanted"),
    [
        ("arctangent2", ((-3.0, 5.0), (-3.0, 5.0)), (-np.pi, np.pi)),
        ("power_const", ((2.0, 3.0), (1.0, 2.0)), (2.0, 9.0)),
        ("floor", ((-3.0, 5.5),), (-3.0, 5.0)),
        ("acosh", ((-3.0, -2.0),), (-FAR, FAR)),
        ("log", ((-3.0, -2.0),), (-FAR, FAR)),
    ],
)
def test_what_has_no_form_is_enclosed_by_its_numbers(op, ranges, wanted):
    """Mutants: one number for both ends; an operation that is defined nowhere given its form."""
    function, numbers = code(op, 0, ranges, Rounding())
    low, high = run(function, [np.array([[lo + 0.1], [hi - 0.1]]) for lo, hi in ranges])
    assert [low[0], high[0]] == list(numbers) == pytest.approx(wanted)


@pytest.mark.parametrize(
    "numbers", [(np.nan, 1.0), (1.0, np.nan), (-np.inf, np.inf), (-1e200, 1e200)]
)
def test_what_is_not_known_is_far(numbers):
    assert lifted._within(*numbers) == (-FAR, FAR)


def test_numbers_are_those_of_the_rules():
    """Not wider, so that signs that the rules know make the formulas short."""
    for case, (tried, _) in CASES.items():
        op, _, number = case.partition(" ")
        extra = (int(number),) if number else ()
        for ranges in tried:
            with np.errstate(all="ignore"):
                rule = RULES[op](*(tuple(np.array([end]) for end in r) for r in ranges), *extra)
            wanted = lifted._within(*(float(end[0]) for end in rule))
            if op not in ("power_const", "add", "subtract", "multiply", "select", "divide"):
                assert code(op, int(number or 0), ranges, Rounding())[1] == wanted, case


def in_single(function, boxes):
    """Run a function in single precision, rows of ends."""
    given = [[end.astype(np.float32)] for box in boxes for end in box]
    count = boxes[0].shape[1]
    with np.errstate(all="ignore"):
        found = tape(function, given, NUMPY, lambda v: np.full(count, v, dtype=np.float32))
    return [np.broadcast_to(np.asarray(v, dtype=float), (count,)) for v in found]


SINGLE = dict.fromkeys(("add", "subtract", "multiply", "divide"), (NEAR, UP))
SINGLE |= {"sqrt": ((0.0, 4.0),), "power_int 3": (NEAR,)}


@pytest.mark.parametrize("case", SINGLE)
@pytest.mark.parametrize("precision", ["single", "double"])
def test_single_precision_steps_over_its_own_rounding(case, precision):
    """Mutant: the step of doubles, by which values are missed."""
    rng, outside, ranges = np.random.default_rng(3), 0, SINGLE[case]
    given = [np.float32(rng.uniform(*r, 300)).astype(float) for r in ranges]
    op, _, number = case.partition(" ")
    function = code(op, int(number or 0), ranges, Rounding(precision))[0]
    low, high = in_single(function, [np.stack([v, v]) for v in given])
    with mp.workprec(PRECISION):
        for k in range(300):
            exact = CASES[case][1](*(mp.mpf(float(v[k])) for v in given))
            outside += not low[k] <= exact <= high[k]
    assert (outside == 0) == (precision == "single")


NUMBERS = [
    (0.5, 0.5),
    (-4.0, -4.0),
    (3.0, 3.0),
    (-0.1, -0.1),
    *map(constant_interval, (0.3, -1e-3)),
]


@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("numbers", NUMBERS)
@pytest.mark.parametrize("op", ["multiply", "divide"])
def test_a_factor_that_is_known_to_some_units_is_one_number(op, numbers, precision):
    """No exact product or quotient with an end of it is outside; powers of two are not rounded.

    Mutants: the step over one rounding alone; ends not exchanged by a negative number.
    """
    rng, kind = np.random.default_rng(11), np.float32 if precision == "single" else np.float64
    ends = [ca.SX.sym("l"), ca.SX.sym("h")]
    args = [Lifted(*ends, *NEAR), Lifted.number(*numbers)]
    found = lifted.combine(op, *args, rounding=Rounding(precision))
    function = ca.Function("f", ends, [found.lower, found.upper])
    box = np.sort(rng.uniform(*NEAR, (2, 200)).astype(kind), axis=0).astype(float)
    low, high = in_single(function, [box]) if precision == "single" else run(function, [box])
    for k in range(200):
        corners = [(Fraction(z), Fraction(c)) for z in box[:, k] for c in numbers]
        exact = [z * c if op == "multiply" else z / c for z, c in corners]
        gaps = min(exact) - Fraction(low[k]), Fraction(high[k]) - max(exact)
        assert min(gaps) >= 0
        unit = 2.0**-24 if precision == "single" else 2.0**-53
        most = 1e-30 if numbers[0] in (0.5, -4.0) else 20 * unit * float(max(map(abs, exact)))
        assert max(gaps) <= most


@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize(("op", "crest"), [("sine", 0.5), ("cosine", 0.0)])
def test_crests_and_troughs_beside_an_end_are_not_missed(op, crest, precision):
    """Of angles of any size: the end beyond it is the next number of the precision.

    Mutants: no margin for the rounding of the number of periods; large angles taken as known.
    """
    rng, kind = np.random.default_rng(4), np.float32 if precision == "single" else np.float64
    sizes = 10.0 ** rng.uniform(0, 7 if precision == "single" else 15, 200)
    most = 2e8 if precision == "single" else 1e16
    for half in (0, 1):
        with mp.workprec(PRECISION):
            at = [
                (2 * int(n) + half + mp.mpf(crest)) * mp.pi
                for n in sizes * rng.choice([-1, 1], 200)
            ]
        near = np.array([float(v) for v in at]).astype(kind)
        below = np.array([float(n) <= v for n, v in zip(near, at, strict=True)])
        under = np.where(below, near, np.nextafter(near, kind(-np.inf)))
        above = np.where(below, np.nextafter(near, kind(np.inf)), near)
        wide = rng.uniform(0.1, 1.0, 200).astype(kind)
        for low, high in ((under, above + wide), (under - wide, above)):
            box = np.stack([low, high]).astype(float)
            function = code(op, 0, ((-most, most),), Rounding(precision))[0]
            found = in_single(function, [box]) if precision == "single" else run(function, [box])
            assert (found[0] == -1.0).all() if half else (found[1] == 1.0).all()


# -- programs ----------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(12))
def test_random_programs(seed):
    """No value outside; ends within 1e-9 of those that the rules give for the same boxes."""
    rng = np.random.default_rng(seed)
    ranges, count = (NEAR, UP, (-2.0, 0.5)), 12
    in_code, exact = zip(*(written(rng, 5) for _ in range(4)), strict=True)
    x = ca.SX.sym("x", 3)
    program = Program.from_casadi(ca.Function("p", [x], [f(x) for f in in_code]))
    low, high = ca.SX.sym("low", 3), ca.SX.sym("high", 3)
    variables = [Lifted(low[i], high[i], *r) for i, r in enumerate(ranges)]
    found = lift(program, program.outputs, variables, Rounding() if seed % 2 else None)
    function = ca.Function(
        "f",
        [low, high],
        [
            ca.vertcat(*e)
            for e in ([ca.SX(o.lower) for o in found], [ca.SX(o.upper) for o in found])
        ],
    )
    boxes = np.array(
        [
            np.sort(
                rng.uniform(*r, (2, count)) if k % 2 else np.array(r)[:, None] + np.zeros(count),
                axis=0,
            )
            for k, r in enumerate(ranges)
        ]
    )
    got = [np.array(v) for v in function(boxes[:, 0], boxes[:, 1])]
    with np.errstate(all="ignore"):
        rules = evaluate(program, boxes[:, 0], boxes[:, 1], list(range(len(found))))
    for ends, wanted in zip(got, rules, strict=True):
        size = np.abs(np.array(rules)).max(axis=0)
        assert np.all(np.abs(ends - wanted) <= 1e-9 * (1.0 + size))
    with mp.workprec(PRECISION):
        for numbers in points(rng, list(boxes)):
            for k in range(count):
                given = [mp.mpf(float(v[k])) for v in numbers]
                for i, value in enumerate(exact):
                    assert got[0][i, k] <= value(given) <= got[1][i, k]
