"""The bound of a function's rounding error: never exceeded, by any tape, and sharp."""

import casadi as ca
import mpmath
import numpy as np
import pytest
import sympy as sp
from tapes import TYPES, errors, sample

from obsynth.designs.core.rounding import rounding_bound
from obsynth.symbolic import lookup
from obsynth.symbolic.convert import sx_function


def bound(function, lo, hi, precision, **known):
    """All bounds, one after the other, over cells of one input."""
    found = rounding_bound(function, {"v": (lo, hi)}, precision, known)
    return np.concatenate([part.error for part in found.values()])


def random_function(rng, size=3, steps=14, library=True):
    """A tape of sums, products, quotients, roots, choices and library functions."""
    v = ca.SX.sym("v", size)
    nodes = [v[i] for i in range(size)]

    def pick():
        if rng.random() < 0.2:
            return ca.SX(float(rng.choice([0.1, 3.0, 1 / 3, -2.7, 1e-3, 40.0])))
        return nodes[rng.integers(len(nodes))]

    unary = [
        lambda a: -a,
        ca.fabs,
        lambda a: a * a,
        lambda a: ca.sqrt(ca.fabs(a) + 0.01),
        lambda a: 1 / (a * a + 0.3),
        lambda a: a + a,
    ]
    if library:
        unary += [
            ca.sin,
            ca.cos,
            ca.tanh,
            ca.atan,
            lambda a: ca.atanh(ca.fmax(ca.fmin(a, 0.9), -0.9)),
            ca.asinh,
            lambda a: ca.acosh(1.2 + a * a),
            lambda a: ca.exp(ca.fmin(a, 2.0)),
            lambda a: ca.log(ca.fabs(a) + 0.2),
            lambda a: ca.log1p(a * a),
            lambda a: ca.expm1(ca.fmax(ca.fmin(a, 1.0), -1.0)),
            lambda a: ca.asin(ca.fmax(ca.fmin(a, 0.9), -0.9)),
            lambda a: ca.acos(ca.fmax(ca.fmin(a, 0.9), -0.9)),
            lambda a: ca.sinh(ca.fmin(ca.fmax(a, -2.0), 2.0)),
            lambda a: ca.cosh(ca.fmin(ca.fmax(a, -2.0), 2.0)),
            lambda a: ca.tan(ca.fmin(ca.fmax(a, -1.2), 1.2)),
            lambda a: (a * a + 0.1) ** 1.7,
            lambda a: (a * a + 0.1) ** -0.6,
            lambda a: ca.atan2(a, a * a + 0.2),
            ca.erf,
        ]
    binary = [
        lambda a, b: a + b,
        lambda a, b: a - b,
        lambda a, b: a - b,
        lambda a, b: a * b,
        lambda a, b: a / (b * b + 0.1),
        ca.fmin,
        ca.fmax,
        lambda a, b: ca.if_else(a < b, a, b * b),
        lambda a, b: ca.if_else(a <= 0.5, a - b, b),
        ca.hypot,
    ]
    for _ in range(steps):
        if rng.random() < 0.4:
            nodes.append(unary[rng.integers(len(unary))](pick()))
        else:
            nodes.append(binary[rng.integers(len(binary))](pick(), pick()))
    return ca.Function("F", [v], [ca.vertcat(*nodes[-3:])], ["v"], ["out"])


@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("library", [False, True])
def test_no_random_function_exceeds_its_bound(precision, library):
    """Mutants: half the unit roundoff, Sterbenz not looked at, a root without its error."""
    rng = np.random.default_rng(7 + library)
    finite, ratios = 0, []
    for _ in range(40):
        function = random_function(rng, library=library)
        centre = rng.normal(size=(3, 8)) * 10.0 ** rng.integers(-2, 2, (3, 8))
        width = 10.0 ** rng.integers(-6, 1) * np.abs(centre) * rng.integers(0, 2, (3, 1))
        lo, hi = (
            (centre + side * width).astype(TYPES[precision]).astype(float) for side in (-1, 1)
        )
        limits = bound(function, lo, hi, precision)
        seen = errors(function, [sample(rng, lo, hi, 40, precision)], precision).max(axis=1)
        assert (seen <= limits).all(), (str(function), seen, limits)
        ok = np.isfinite(limits) & (seen > 0)
        finite += int(np.isfinite(limits).sum())
        ratios += list(limits[ok] / seen[ok])
    assert finite > 100
    # a library function is good to 8 units, and mostly returns the nearest number
    assert np.median(ratios) < (40.0 if library else 10.0)


def one(formula, size=2):
    v = ca.SX.sym("v", size)
    return ca.Function("F", [v], [formula(*ca.vertsplit(v))], ["v"], ["out"])


def at(*values):
    column = np.array(values, dtype=float)[:, None]
    return column, column


def zero(a, b):
    return (a * a) * b - a * (a * b)


C1, C2 = 1211528, 12809876
TWICE = (1 + 3613284 * 2**-23, 1 + 4144635 * 2**-23)
CASES = {
    # the rounding of one product, nearly half a unit in the last place of 1
    "one product": (lambda a, b: a * b, (1 + 2042 * 2**-23, 1 + 2054 * 2**-23), 1.1),
    # nothing is rounded but the number itself
    "a number": (lambda a, b: ca.fmax(a, 0.1), (0.0, 0.0), 1.1),
    # |b| e_a: what a difference of nearly equal numbers keeps, made large
    "a product": (lambda a, b: (a * a - 1.0) * b, (1 + 2**-12 + 2**-23, 2.0**20), 2.1),
    # e_a |1/b|, and |a| e_b |1/b|^2
    "a numerator": (lambda a, b: (a * a - 1.0) / b, (1 + 2**-12 + 2**-23, 2.0**-20), 2.1),
    "a denominator": (lambda a, b: b / (a * a - 1.0), (1 + 2**-12 + 2**-23, 1.0), 2.1),
    "a root": (lambda a, b: ca.sqrt(a * a - 1.0) * b, (1 + 2**-12 + 2**-23, 1.0), 2.1),
    "a square": (lambda a, b: ((a * a - 1.0) * b) ** 2, (1 + 2**-12 + 2**-23, 2.0**20), 2.1),
    "a power": (lambda a, b: ((a * a - 1.0) * b) ** 1.7, (1 + 2**-12 + 2**-23, 2.0**20), 2.1),
    "an exponent": (lambda a, b: 2.0 ** ((a * a - 1.0) * b), (1 + 2**-12 + 2**-23, 1024.0), 2.1),
    "a function": (lambda a, b: ca.exp((a * a - 1.0) * b), (1 + 2**-12 + 2**-23, 1024.0), 2.1),
    # a^2 b is larger than 1, but not when it is rounded
    "a minimum": (lambda a, b: ca.fmin(a * a * b, 1.0), (1 + C1 * 2**-23, C2 * 2**-24), 2.1),
    "a maximum": (lambda a, b: ca.fmax(-1.0, -a * a * b), (1 + C1 * 2**-23, C2 * 2**-24), 2.1),
    "its turn": (lambda a, b: ca.fmin(1.0, a * a * b), (1 + C1 * 2**-23, C2 * 2**-24), 2.1),
    "both turned": (lambda a, b: ca.fmax(-a * a * b, -1.0), (1 + C1 * 2**-23, C2 * 2**-24), 2.1),
    "an angle": (lambda a, b: ca.atan2(1.0, (a * a - 1.0) * b), (1 + 2**-12 + 2**-23, 1024.0), 2.5),
    "a slope": (lambda a, b: ca.atan2((a * a - 1.0) * b, 1.0), (1 + 2**-12 + 2**-23, 1024.0), 2.5),
    # e_a e_b, of factors that are zero but for rounding
    "two errors": (lambda a, b: zero(a, b) * zero(b, a), TWICE, 12.0),
    "an error twice": (lambda a, b: zero(a, b) ** 2, TWICE, 12.0),
    # a^2 is larger than b, but not when it is rounded
    "a choice": (lambda a, b: ca.if_else(a * a <= b, 3.0, 7.0), (1 + 2**-12, 1 + 2**-11), 2.6),
}


@pytest.mark.parametrize("case", CASES)
def test_every_term_is_needed(case):
    """Single precision at one point. Mutants: half the unit roundoff, no error of a constant, no
    |b| e_a in a product, no term of a quotient, the error of a root, square, power or function
    dropped or halved, a choice that is never wrong."""
    formula, point, ratio = CASES[case]
    function = one(formula)
    points = np.array(point)[:, None]
    assert (points == points.astype(np.float32)).all()
    seen = errors(function, [points], "single")[0, 0]
    limit = bound(function, *at(*point), "single")[0]
    assert seen <= limit <= ratio * seen


def test_a_difference_is_exact_within_a_factor_of_two_only():
    """Mutant: the condition of Sterbenz taken for granted, or for a factor of four."""
    rng = np.random.default_rng(0)
    difference = one(lambda a, b: a - b)
    for low, high, exact in [
        (1.0, 2.0, True),
        (-2.0, -1.0, True),
        (0.3125, 1.234375, False),
        (-1.234375, -0.3125, False),
    ]:
        lo, hi = np.array([[low], [low]]), np.array([[high], [high]])
        limit = bound(difference, lo, hi, "single")[0]
        seen = errors(difference, [sample(rng, lo, hi, 400, "single")], "single").max()
        assert seen <= limit
        assert (limit == 0.0) == exact
        assert (seen == 0.0) == exact


@pytest.mark.parametrize("seed", range(4))
def test_differences_are_exact_where_all_corners_are_within_a_factor_of_two(seed):
    """Both conditions at all four corners, of either sign. Mutants: an end exchanged, one left out.

    With zero everything is exact.
    """
    rng, kinds = np.random.default_rng(seed), set()
    difference, together = one(lambda a, b: a - b), one(lambda a, b: a + b)
    for sign in (1.0, -1.0):
        for _ in range(40):
            ends = np.sort(np.round(rng.uniform(2, 8, (2, 2)), 1) / 10, axis=1)
            a, b = np.sort(sign * ends, axis=1)
            exact = all(x <= 2 * y and y <= 2 * x for x in abs(a) for y in abs(b))
            lo, hi = np.array([[a[0]], [b[0]]]), np.array([[a[1]], [b[1]]])
            assert (bound(difference, lo, hi, "double")[0] == 0.0) == exact
            lo[1], hi[1] = -hi[1], -lo[1]
            assert (bound(together, lo, hi, "double")[0] == 0.0) == exact
            kinds.add(exact)
    assert kinds == {True, False}
    for function in (difference, together):
        assert bound(function, *at(1.3, 0.0), "double")[0] == 0.0
        assert bound(function, *at(0.0, 1.3), "double")[0] == 0.0


def test_a_form_is_cut_with_what_the_box_says_of_it():
    """(a + b) - (a - b) is 2 b, however large a is. Mutant: forms dropped, or cut to half."""
    rng = np.random.default_rng(1)
    back = one(lambda a, b: (a + b) - (a - b))
    lo, hi = np.array([[-1e3], [-1.0]]), np.array([[1e3], [1.0]])
    seen = errors(back, [sample(rng, lo, hi, 400, "double")], "double").max()
    limit = bound(back, lo, hi, "double")[0]
    assert seen <= limit < 2.01e3 * 2.0**-53
    kept = one(lambda a, b: 1 / (10.0 + ((a + b) - (a - b))))
    assert bound(kept, lo, hi, "double")[0] < 1e-14


@pytest.mark.parametrize(
    "formula",
    [
        lambda a, b: ca.atan2(a * a, b * a),
        lambda a, b: ca.hypot(a * a, b * a),
        lambda a, b: ca.sqrt(a * a),
        lambda a, b: (a * a) ** 1.7,
        lambda a, b: ca.exp(a * b),
        lambda a, b: a * a / (a + 3.0 * b + 4.0),
        lambda a, b: ca.fmin(a * a, b * b),
    ],
)
def test_wide_cells_keep_a_bound(formula):
    """A few hundred units, not as wide as the cell. Mutant: a distance that becomes zero."""
    lo, hi = np.array([[1.0], [-1.0]]), np.array([[2.0], [1.0]])
    assert bound(one(formula), lo, hi, "double")[0] < 400 * 2.0**-53


def test_what_is_undefined_has_no_bound():
    lo, hi = np.array([[-1.0], [0.0]]), np.array([[1.0], [1.0]])
    for formula in (lambda a, b: 1 / a, lambda a, b: ca.sqrt(a), lambda a, b: ca.log(b)):
        assert bound(one(formula), lo, hi, "double")[0] == np.inf
    # a^2 - b is below zero, and zero when a^2 is rounded
    below = at(1 + 5 * 2.0**-14, 1 + 10 * 2.0**-14 + 2.0**-23)
    assert bound(one(lambda a, b: ca.sqrt(a * a - b)), *below, "single")[0] == np.inf
    large = at(1e30, 1e30)
    assert bound(one(lambda a, b: a * b), *large, "single")[0] == np.inf
    assert bound(one(lambda a, b: a * b), *large, "double")[0] < np.inf
    # a number of the precision, but not when it is rounded twice
    beside = at(1 + 905390 * 2.0**-23, 27335342 * 2.0**-24)
    assert bound(one(lambda a, b: a * a * b * 2.0**127), *beside, "single")[0] == np.inf
    assert bound(one(lambda a, b: a * a * b * 2.0**126), *beside, "single")[0] < np.inf


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_choice_has_the_range_of_both_branches(turned, sign):
    """Here one is around zero and the other is not. Mutants: an end of one branch alone."""

    def formula(a, b):
        branches = sign * a, sign * (5.0 + a)
        return 1 / ca.if_else(a < 1, *(branches[::-1] if turned else branches))

    lo, hi = np.array([[-1.0], [0.0]]), np.array([[3.0], [1.0]])
    assert bound(one(formula), lo, hi, "double")[0] == np.inf
    assert bound(one(formula), lo + 1.5, hi + 1.5, "double")[0] < 1e-14


def test_what_is_known_of_an_output_counts():
    """Of a b, for which 1 / (a b) has a bound. Mutant: nothing is taken as known."""
    v = ca.SX.sym("v", 2)
    z = v[0] * v[1]
    function = ca.Function("F", [v], [z, 1 / z], ["v"], ["z", "out"])
    lo, hi = np.array([[-2.0], [1.0]]), np.array([[2.0], [2.0]])
    assert bound(function, lo, hi, "double")[1] == np.inf
    known = {"z": (np.array([[1.0]]), np.array([[2.0]]))}
    error = rounding_bound(function, {"v": (lo, hi)}, "double", known)["out"].error[0]
    assert 2.0**-53 <= error <= 5.01 * 2.0**-53


def test_numbers_that_stand_for_others_count():
    """A third is no double. Mutant: numbers taken as the doubles that they are."""
    with mpmath.workprec(300):
        meant = {1 / 3: mpmath.mpf(1) / 3}
    third = one(lambda a, b: ca.fmax(a, 1 / 3))
    seen = errors(third, [np.zeros((2, 1))], "double", meant)[0, 0]
    assert 0 < seen <= bound(third, *at(0.0, 0.0), "double")[0]
    quarter = one(lambda a, b: ca.fmax(a, 0.25))
    assert bound(quarter, *at(0.0, 0.0), "double")[0] == 0.0


def product_with_sign(v):
    return v * ca.sign(v)


KINKS = {
    "a kink": (lambda c: ca.if_else(c < 1, c, 0.5 + c / 2), 2e-6),
    "two kinks": (lambda c: ca.if_else(c < 0.5, c, ca.if_else(c <= 1, 0.25 + c / 2, 0.75)), 2e-6),
    "a sign": (lambda c: product_with_sign(c - 1.0), 2e-6),
    "a slope": (lambda c: ca.if_else(c < 1, 1.0, 1.0 + 9.0 * (c - 1.0) * c**4), 2e-3),
    "a jump": (lambda c: ca.if_else(c < 1, c, 1.0 + c), 1.01),
    "a jump down": (lambda c: ca.if_else(c < 1, c, -5.0 - c), 7.01),
}


@pytest.mark.parametrize("kink", KINKS)
def test_comparisons_are_taken_apart(kink):
    """Branches that meet cost little, a jump costs itself; at points where rounding decides.

    Mutants: no cells where a comparison is wrong, the range or the error of one branch alone.
    """
    formula, limit = KINKS[kink]
    function = one(lambda a, b: formula(a * b * 0.37))
    lo, hi = np.array([[-1.0], [1.0]]), np.array([[3.0], [2.0]])
    found = bound(function, lo, hi, "single")[0]
    rng = np.random.default_rng(0)
    b = rng.uniform(1.5, 2, 600).astype(np.float32)
    near = np.where(rng.random(600) < 0.3, rng.uniform(0, 1.6, 600), rng.choice([0.5, 1, 1], 600))
    a = (near / (0.37 * b.astype(float))).astype(np.float32)
    seen = errors(function, [np.array([a, b], dtype=float)], "single").max()
    assert seen <= found <= limit


def test_pieces_meet_where_a_test_of_a_quotient_goes_wrong():
    """A table of x / v, as a wind turbine's: its pieces are written by the node that is tested.

    Mutant: pieces written by themselves, as 37 x / (40 v) - 27/200; the bound is 1.6e-3 then.
    """
    x, v = sp.symbols("x v", real=True)
    ratio = 10 * x / v
    value = v**3 * lookup(ratio, [0, 2, 6, 8, 10, 30], [0, 0.05, 0.42, 0.48, 0.45, 0]) / x
    function = sx_function("f", {"v": [x, v]}, {"y": sp.Matrix([value / 10**6])})
    lo, hi = (np.array(ends)[:, None] for ends in ((0.8, 4.0), (2.2, 14.0)))
    assert bound(function, lo, hi, "double")[0] < 1e-17
    assert bound(function, lo, hi, "single")[0] < 1e-9
