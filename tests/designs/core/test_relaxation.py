"""Affine forms hold every value, with an error that is of second order where that is possible."""

import itertools
from fractions import Fraction

import casadi as ca
import mpmath as mp
import numpy as np
import pytest
from operations import FAR, NEAR, PRECISION, TRIED, UP, drawn, points, program_of, result, written

from obsynth.derive.intervals.graph import Node
from obsynth.derive.intervals.program import Program
from obsynth.designs.core.boxes import Lifted, Rounding
from obsynth.designs.core.relaxation import relax


def code(program, ranges, rounding=None, known=()):
    """Slopes, centre and error of every output as a function of the ends of the variables."""
    ends = [[ca.SX.sym("l"), ca.SX.sym("h")] for _ in ranges]
    variables = [
        Lifted.number(*r) if k in known else Lifted(*e, *r)
        for k, (e, r) in enumerate(zip(ends, ranges, strict=True))
    ]
    found = relax(program, program.outputs, variables, rounding or Rounding())
    zero = ca.SX(0)
    outputs = [
        part
        for a in found
        for part in (*(a.slopes.get(j, zero) for j in range(len(ranges))), a.centre, a.error)
    ]
    return ca.Function("f", [e for pair in ends for e in pair], [ca.SX(v) for v in outputs])


def run(function, boxes):
    """Slopes, centre, error of every output, rows of numbers."""
    return [np.array(v).ravel() for v in function(*[end[None, :] for box in boxes for end in box])]


def missed(case, count=12, rounding=None, seed=0):
    """Return how many values are further from their form than its error."""
    rng = np.random.default_rng(seed)
    op, _, number = case.partition(" ")
    tried, value = TRIED[case]
    outside = 0
    for ranges in tried[:: 1 + len(tried) // 15]:
        known = [k for k, r in enumerate(ranges) if r[0] == r[1]]
        boxes = [drawn(rng, r, count) for r in ranges]
        if op == "meet":
            boxes[1] = np.stack([np.minimum(*boxes)[0], np.maximum(*boxes)[1]])
        program = program_of(op, int(number or 0), len(ranges))
        *slopes, centre, error = run(code(program, ranges, rounding, known), boxes)
        assert not np.isnan([*slopes, centre, error]).any()
        for given in points(rng, boxes):
            for k in range(count):
                point = [g[k] for g in given]
                exact = result(value, point)
                if exact is not None and error[k] < FAR:
                    with mp.workprec(PRECISION):
                        terms = (
                            mp.mpf(s[k]) * mp.mpf(p) for s, p in zip(slopes, point, strict=True)
                        )
                        outside += abs(exact - sum(terms) - mp.mpf(centre[k])) > mp.mpf(error[k])
    return outside


@pytest.mark.parametrize("case", TRIED)
def test_no_value_is_missed(case):
    assert missed(case) == 0


# -- how far ---------------------------------------------------------------------------------------

SMOOTH = {
    **dict.fromkeys(("exp", "expm1", "log", "log1p", "sinh", "cosh", "tanh", "asinh", "atan"), 0.5),
    **dict.fromkeys(("atanh", "asin", "acos", "erf", "sine", "cosine", "tangent", "sqrt"), 0.5),
    **{f"power_int {n}": -0.5 for n in (2, 3, 4, 5)},
    "acosh": 1.5,
    "multiply": (0.5, 1.5),
    "divide": (0.5, 1.5),
    "hypotenuse": (0.5, 1.5),
    "power": (0.5, 1.5),
    "arctangent2": (0.5, 1.5),
    "power_const": (0.5, -1.5),
}


@pytest.mark.parametrize("case", SMOOTH)
def test_errors_are_of_second_order(case):
    """Half the width, a quarter of the error; the slope is the derivative up to the width.

    Near the smallest possible too: half of what a chord over the box is off in its middle, for one
    operand. Mutants: another second derivative, a chord that is never better than the interval,
    slopes of another sign.
    """
    op, _, number = case.partition(" ")
    middles = np.atleast_1d(SMOOTH[case]).astype(float)
    known = [1] if op == "power_const" else []
    value, n = TRIED[case][1], len(middles)
    ranges = [(m, m) if k in known else (m - 0.25, m + 0.25) for k, m in enumerate(middles)]
    widths = np.array([0.4, 0.02, 0.01])
    boxes = [
        m + np.array([[-0.5], [0.5]]) * (0.0 if k in known else widths)
        for k, m in enumerate(middles)
    ]
    *slopes, _, error = run(code(program_of(op, int(number or 0), n), ranges, known=known), boxes)
    assert 3.8 <= error[1] / error[2] <= 4.2
    for j in set(range(n)) - set(known):
        slope = mp.diff(lambda *v: value(*v), tuple(middles), tuple(int(k == j) for k in range(n)))
        assert abs(slopes[j][2] - float(slope)) <= 0.05
    if n == 1:
        ends = [float(value(mp.mpf(b[2]))) for b in boxes[0]]
        bow = abs(0.5 * sum(ends) - float(value(mp.mpf(middles[0]))))
        assert 0.47 * bow <= error[2] <= 0.53 * bow


@pytest.mark.parametrize("far", [0.0, 1e6])
@pytest.mark.parametrize("op", ["multiply", "power_int", "sqrt", "absolute", "maximum"])
def test_errors_are_those_of_exact_rationals(op, far):
    """The largest deviation over the box, exactly, is below the error and within 1e-9 of it.

    Mutants: half of the remainder; the roundings left out.
    """
    rng, count = np.random.default_rng(7), 30
    n = 2 if op in ("multiply", "maximum") else 1
    low = -4.0 if op in ("absolute", "maximum") else 0.0
    numbers = (far + low, far + 4.0)
    boxes = [np.sort(rng.uniform(*numbers, (2, count)), axis=0) for _ in range(n)]
    if op == "sqrt":  # ends with roots that are numbers
        numbers, boxes = (0.0, (far + 4.0) ** 2), [(np.round(b * 2.0**20) / 2.0**20) for b in boxes]
        boxes = [b**2 for b in boxes]
    *slopes, centre, error = run(code(program_of(op, 2, n), [numbers] * n), boxes)
    for k in range(count):
        box = [[Fraction(float(end[k])) for end in b] for b in boxes]
        s, c = [Fraction(float(v[k])) for v in slopes], Fraction(float(centre[k]))
        at = [(p, p) for p in box[0]] if n == 1 else list(itertools.product(*box))
        if op == "maximum":
            at += [(v, v) for b in box for v in b if all(lo <= v <= hi for lo, hi in box)]
        if n == 1 and s[0]:
            inner = {"power_int": s[0] / 2, "sqrt": 1 / (4 * s[0] ** 2)}.get(op, Fraction(0))
            at.append((min(max(inner, box[0][0]), box[0][1]),) * 2)
        root = Fraction(1) / (2 * s[0]) if op == "sqrt" else None
        value = {
            "multiply": lambda p, q: p * q,
            "maximum": max,
            "power_int": lambda p, q: p * p,
            "absolute": lambda p, q: abs(p),
            "sqrt": lambda p, q, root=root: root if p == root**2 else Fraction(float(p) ** 0.5),
        }[op]
        gaps = [value(*v) - sum(a * b for a, b in zip(s, v, strict=False)) - c for v in at]
        worst = max(abs(g) for g in gaps)
        assert worst <= Fraction(float(error[k]))
        assert Fraction(float(error[k])) <= worst * Fraction(1 + 1e-9) + Fraction(1e-14) * size(box)


def size(box):
    """Of the terms, whose roundings count."""
    return max(1, *(abs(end) for b in box for end in b)) ** 2


def of(expression, ranges, boxes, known=()):
    """Slopes, centre and error of one expression f(x) over one box."""
    x = ca.SX.sym("x", len(ranges))
    program = Program.from_casadi(ca.Function("p", [x], [expression(x)]))
    found = run(code(program, ranges, known=known), [np.array(b, float)[:, None] for b in boxes])
    return [v[0] for v in found[:-2]], found[-2][0], found[-1][0]


def test_sums_are_exact():
    """No error where nothing is rounded; inputs that are known are in the centre."""
    box = [(0.0, 1.0), (-1.0, 3.0), (0.5, 0.5)]
    found = of(lambda x: x[0] - 2.0 * x[1] + x[2], box, box, known=[2])
    assert found == ([1.0, -2.0, 0.0], 0.5, 0.0)


def chain(*steps):
    """A program that is not rewritten: operations with a number, one after the other, from x."""
    program = Program(n_variables=1)
    node = program.variable(0)
    for op, number in steps:
        other = program.number(*number) if number else program.variable(0)
        node = program.append(Node(op, (node, other)))
    program.outputs = [node]
    return program


SHORT = 1.0 + 2.0**-22 + 2.0**-11
TIMES = ("multiply", (SHORT, SHORT))


@pytest.mark.parametrize(
    ("steps", "box", "value"),
    [
        ([TIMES] * 3, (1e6, 1e6 + 1), lambda x: x * Fraction(SHORT) ** 3),
        ([TIMES] * 5, (1e6, 1e6 + 1), lambda x: x * Fraction(SHORT) ** 5),
        (
            [*[TIMES] * 3, ("add", (1.0, 1.0))],
            (1e6, 1e6 + 1),
            lambda x: x * Fraction(SHORT) ** 3 + 1,
        ),
        (
            [("add", (2.0**20 + 1,) * 2), *[TIMES] * 3],
            (0.0, 2.0**-30),
            lambda x: (x + 2**20 + 1) * Fraction(SHORT) ** 3,
        ),
        (
            [("multiply", (2.0**-54, 2.0**-54)), ("add", None)],
            (1e6, 1e6 + 1),
            lambda x: x * (1 + Fraction(2.0**-54)),
        ),
        ([("multiply", (1e-200,) * 2), ("multiply", (1e-150,) * 2)], (1.0, 2.0), None),
    ],
)
def test_roundings_of_slopes_and_centres_count(steps, box, value):
    """Short numbers whose product is rounded, or underflows; times the size of the variable.

    Mutants: the part of a slope left out, of the centre, of a sum, of an underflow.
    """
    (slope,), (centre,), (error,) = (
        ([v[0][0] for v in part] if len(part) > 1 else part[0])
        for part in zip(run(code(chain(*steps), [box]), [np.array(box)[:, None]]))
    )
    for x in map(Fraction, box):
        exact = value(x) if value else x * Fraction(1e-200) * Fraction(1e-150)
        gap = abs(exact - Fraction(slope) * x - Fraction(centre))
        assert 0 < gap <= Fraction(error) <= 100 * gap + Fraction(1e-300)


@pytest.mark.parametrize(
    ("op", "number", "value"),
    [("multiply", (0.25, 0.75), lambda x, c: x * c), ("power_const", (0.25, 0.75), pow)],
)
def test_numbers_that_are_not_known_exactly(op, number, value):
    """Mutants: half of their radius; the lower of two exponents for both."""
    (slope,), (centre,), (error,) = run(
        code(chain((op, number)), [(0.5, 4.0)]), [np.array([[1], [3.0]])]
    )
    for x in np.linspace(1.0, 3.0, 9):
        for c in number:
            assert abs(value(x, c) - slope * x - centre) <= error * (1.0 + 1e-12)


@pytest.mark.parametrize("case", [*SMOOTH, "absolute", "maximum", "minimum"])
def test_points_have_no_error_but_rounding(case):
    """Mutant: the chord whatever it is worth, here 0/0."""
    op, _, number = case.partition(" ")
    middles = np.atleast_1d(SMOOTH.get(case, (0.0, 0.0) if op in ("maximum", "minimum") else 0.0))
    known = [1] if op == "power_const" else []
    ranges = [(m, m) if k in known else (m - 0.25, m + 0.25) for k, m in enumerate(middles)]
    program = program_of(op, int(number or 0), len(middles))
    found = run(code(program, ranges, known=known), [np.array([[m], [m]]) for m in middles])
    assert found[-1][0] <= 1e-13


def test_a_chord_that_is_worse_than_the_interval_is_not_taken():
    assert of(lambda x: ca.sin(x[0]), [(-2.0, 2.0)], [(-1.5, 1.5)])[2] <= 0.9976


@pytest.mark.parametrize(
    "expression",
    [lambda x: x[0] * x[1], lambda x: ca.exp(x[0]), lambda x: 1.0 / x[1], lambda x: x[0] ** 3],
)
def test_what_has_no_bound_says_so(expression):
    """`FAR`, and neither slopes nor a centre that are no numbers. Mutant: the error as it comes."""
    slopes, centre, error = of(expression, [(-FAR, FAR)] * 2, [(-FAR, FAR)] * 2)
    assert error == FAR and slopes == [0.0, 0.0] and centre == 0.0
    slopes, centre, error = of(lambda x: x[0] + 0.5 * x[1], [(-FAR, FAR)] * 2, [(-FAR, FAR)] * 2)
    assert (slopes == [1.0, 0.5] and error < 1e-90) or error == FAR


def test_a_function_whose_range_is_not_known_has_no_slope():
    """1e-60 log x with numbers that leave the domain. Mutant: the chord between ends of FAR."""
    (slope,), centre, error = of(lambda x: 2.0**-200 * ca.log(x[0]), [(-2.0, 4.0)], [(1.0, 2.0)])
    for x in (1.0, 1.5, 2.0):
        assert abs(2.0**-200 * np.log(x) - slope * x - centre) <= error


@pytest.mark.parametrize("seed", range(8))
def test_random_programs(seed):
    """No value is missed, and on narrow boxes errors are far below the intervals."""
    rng, count = np.random.default_rng(seed), 6
    ranges = (NEAR, UP, (-2.0, 0.5))
    in_code, exact = zip(*(written(rng, 4) for _ in range(3)), strict=True)
    x = ca.SX.sym("x", 3)
    program = Program.from_casadi(ca.Function("p", [x], [ca.vertcat(*(f(x) for f in in_code))]))
    function = code(program, ranges)
    middle = np.array([rng.uniform(0.9 * a, 0.9 * b, count) for a, b in ranges])
    wide = 10.0 ** rng.uniform(-12, -1, count)
    boxes = [np.stack([m - wide, m + wide]) for m in middle]
    boxes = [np.clip(b, *r) for b, r in zip(boxes, ranges, strict=True)]
    found = run(function, boxes)
    for i, value in enumerate(exact):
        *slopes, centre, error = found[5 * i : 5 * i + 5]
        for given in points(rng, boxes):
            for k in range(count):
                point = [g[k] for g in given]
                wanted = result(lambda *p, value=value: value(p), point)
                with mp.workprec(PRECISION):
                    terms = (mp.mpf(s[k]) * mp.mpf(p) for s, p in zip(slopes, point, strict=True))
                    assert abs(wanted - sum(terms) - mp.mpf(centre[k])) <= mp.mpf(error[k])
