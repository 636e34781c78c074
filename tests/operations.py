"""Operations of interval programs with the ranges for which they are tried, and their values."""

import casadi as ca
import mpmath as mp
import numpy as np

from obsynth.derive.intervals.graph import Node
from obsynth.derive.intervals.program import Program
from obsynth.designs.core.boxes import FAR

PRECISION = 400
WHOLE, NEAR, UP, DOWN, OPEN = (-FAR, FAR), (-3.0, 5.0), (0.5, 3.0), (-3.0, -0.5), (-2.0, 0.0)
SIGNS = (WHOLE, NEAR, UP, DOWN, OPEN, (0.0, 4.0))
PAIRS = [(a, b) for a in SIGNS for b in SIGNS]
TRUTHS = ((0.0, 1.0),)
CHOICES = [(*TRUTHS, a, b) for a, b in ((NEAR, NEAR), (UP, DOWN), (WHOLE, WHOLE))]


def one(*ranges):
    return [(r,) for r in ranges]


# operation: the ranges of its operands for which it is tried, its value
OPERATIONS = {
    "add": (PAIRS, lambda a, b: a + b),
    "subtract": (PAIRS, lambda a, b: a - b),
    "multiply": (PAIRS, lambda a, b: a * b),
    "divide": (PAIRS, lambda a, b: a / b),
    "negate": (one(*SIGNS), lambda a: -a),
    "twice": (one(*SIGNS), lambda a: 2 * a),
    "sqrt": (one((0.0, 4.0), (0.0, FAR), UP), mp.sqrt),
    "nonnegative": (one((0.0, 4.0), UP), lambda a: a),
    "absolute": (one(*SIGNS), abs),
    "minimum": (PAIRS, min),
    "maximum": (PAIRS, max),
    "meet": (PAIRS, lambda a, b: a),
    "with_zero": (one(*SIGNS), lambda a: a),
    "power_const": ([(r, (p, p)) for r in (UP, (0.0, 4.0)) for p in (1.5, 2.25, 0.3)], mp.power),
    "power": ([(UP, NEAR), (UP, UP), ((0.01, 30.0), DOWN)], mp.power),
    "select": (CHOICES, lambda c, a, b: a if c else b),
    "if_else_zero": ([c[:2] for c in CHOICES], lambda c, a: a if c else mp.mpf(0)),
    "less": (PAIRS, lambda a, b: mp.mpf(a < b)),
    "less_equal": (PAIRS, lambda a, b: mp.mpf(a <= b)),
    "boundary_weight": (PAIRS, lambda a, b: mp.mpf(a < b) if a != b else mp.mpf("0.5")),
    "logical_not": ([TRUTHS], lambda a: mp.mpf(not a)),
    "conjunction": ([TRUTHS * 2], min),
    "disjunction": ([TRUTHS * 2], max),
    "hypotenuse": (PAIRS, mp.hypot),
    "arctangent2": ([(NEAR, UP), (UP, WHOLE), (DOWN, NEAR), (WHOLE, (0.5, FAR))], mp.atan2),
    "exp": (one(NEAR, UP, DOWN, (-700.0, 700.0), WHOLE), mp.exp),
    "expm1": (one(NEAR, UP, (-50.0, 50.0)), mp.expm1),
    "log": (one(UP, (1e-300, FAR), (0.0, 4.0)), mp.log),
    "log1p": (one(UP, (-0.9, 4.0), (0.0, FAR)), mp.log1p),
    "sinh": (one(NEAR, UP, (-200.0, 200.0)), mp.sinh),
    "cosh": (one(NEAR, UP, DOWN, (-200.0, 200.0)), mp.cosh),
    "tanh": (one(NEAR, UP, WHOLE), mp.tanh),
    "asinh": (one(NEAR, UP, WHOLE), mp.asinh),
    "acosh": (one((1.0, 3.0), (1.0, FAR)), mp.acosh),
    "atanh": (one((-0.9, 0.9), (0.2, 0.7)), mp.atanh),
    "asin": (one((-1.0, 1.0), (0.2, 0.7)), mp.asin),
    "acos": (one((-1.0, 1.0), (0.2, 0.7)), mp.acos),
    "atan": (one(NEAR, UP, WHOLE), mp.atan),
    "erf": (one(NEAR, UP, WHOLE), mp.erf),
    "sine": (one(NEAR, (0.2, 0.7), (-1e3, 1e3), WHOLE), mp.sin),
    "cosine": (one(NEAR, (0.2, 0.7), (-1e3, 1e3), WHOLE), mp.cos),
    "tangent": (one((-1.5, 1.5), (0.2, 0.7), (1.6, 4.7)), mp.tan),
}
POWERS = {n: (one(*SIGNS[1:]), lambda a, n=n: a**n) for n in (2, 3, 4, 5)}
CASES = {**OPERATIONS, **{f"power_int {n}": case for n, case in POWERS.items()}}


def drawn(rng, ranges, count):
    """Ends inside of ranges: anywhere, of any size, one number, whole range, near crests."""
    low, high = np.clip(ranges, -1e40, 1e40)
    shape = (2, count)
    found = rng.uniform(low, high, shape) if high - low < 1e6 else rng.normal(0.0, 50.0, shape)
    sizes = 10.0 ** rng.uniform(-30, 2, shape) * rng.choice([-1.0, 1.0], shape)
    found = np.where(rng.uniform(size=count) < 0.2, sizes, found)
    crests = 0.5 * np.pi * rng.integers(-12, 13, shape)
    found = np.where(rng.uniform(size=shape) < 0.1, crests, found)
    found = np.where(rng.uniform(size=shape) < 0.05, np.array([[low], [high]]), found)
    if ranges == (0.0, 1.0):
        found = np.round(np.abs(found)) % 2
    found = np.sort(np.clip(found, low, high), axis=0)
    return np.where(rng.uniform(size=count) < 0.1, found[:1], found)


def points(rng, boxes):
    """Corners of boxes and points inside of them, tuples of rows of numbers."""
    for corner in range(2 ** len(boxes)):
        yield [box[(corner >> i) & 1] for i, box in enumerate(boxes)]
    for _ in range(2):
        share = [rng.uniform(size=box.shape[1]) for box in boxes]
        inner = [b[0] + s * (b[1] - b[0]) for b, s in zip(boxes, share, strict=True)]
        yield [np.clip(v, *b) for v, b in zip(inner, boxes, strict=True)]


# every operation of the rules, and where operands leave the domain or the branch
HALF, PI = 0.5 * np.pi, np.pi
MORE = {
    "acos": ([((-2.0, 2.0),)], mp.acos),
    "sine": ([((-HALF, HALF),)], mp.sin),
    "cosine": ([((-PI, PI),), ((0.0, PI),)], mp.cos),
    "sqrt": ([(WHOLE,), ((-2.0, 4.0),)], mp.sqrt),
    "log": ([(WHOLE,)], mp.log),
    "asin": ([((-2.0, 2.0),)], mp.asin),
    "tangent": ([((-1.5, 1.5),), (NEAR,)], mp.tan),
    "sign": ([(NEAR,)], mp.sign),
    "floor": ([(NEAR,)], mp.floor),
    "ceiling": ([(NEAR,)], mp.ceil),
    "copysign": ([(NEAR, UP)], lambda a, b: mp.sign(b) * abs(a)),
    "remainder": ([(UP, UP)], mp.fmod),
    "equal": ([(NEAR, NEAR)], lambda a, b: mp.mpf(a == b)),
    "power_const": ([((0.5, 3.0), (p, p)) for p in (-0.5, -1.5)], mp.power),
}
TRIED = {
    name: (CASES.get(name, ([], None))[0] + MORE.get(name, ([],))[0], (MORE | CASES)[name][1])
    for name in CASES | MORE
}


def program_of(op, number, count):
    """A program of one operation; nothing is rewritten."""
    program = Program(n_variables=count)
    args = tuple(program.variable(k) for k in range(count))
    program.outputs = [program.append(Node(op, args, number))]
    return program


def result(value, point):
    """The value of an operation at a point, None where it has none or one beyond FAR."""
    with mp.workprec(PRECISION):
        try:
            found = value(*(mp.mpf(float(p)) for p in point))
        except (ValueError, ZeroDivisionError):
            return None
        return None if isinstance(found, mp.mpc) or not abs(found) < FAR else found


UNARY = [
    (ca.sin, mp.sin),
    (ca.cos, mp.cos),
    (ca.tanh, mp.tanh),
    (ca.atan, mp.atan),
    (ca.fabs, abs),
    (lambda a: a * a, lambda a: a * a),
    (lambda a: a**3, lambda a: a**3),
    (lambda a: ca.sqrt(1 + a * a), lambda a: mp.sqrt(1 + a * a)),
    (lambda a: ca.log(2 + ca.sin(a)), lambda a: mp.log(2 + mp.sin(a))),
    (lambda a: ca.exp(ca.sin(a)), lambda a: mp.exp(mp.sin(a))),
    (lambda a: a / (3 + ca.cos(a)), lambda a: a / (3 + mp.cos(a))),
    (lambda a: 0.375 - 1.5 * a, lambda a: mp.mpf(0.375) - mp.mpf(1.5) * a),
]
BINARY = [
    (lambda a, b: a + b, lambda a, b: a + b),
    (lambda a, b: a - b, lambda a, b: a - b),
    (lambda a, b: a * b, lambda a, b: a * b),
    (ca.fmin, min),
    (ca.fmax, max),
    (lambda a, b: ca.if_else(a < b, 2 * a, b - 1), lambda a, b: 2 * a if a < b else b - 1),
]


def written(rng, depth):
    """A random expression as CasADi and as mpmath functions of x."""
    if depth == 0:
        j = int(rng.integers(3))
        return (lambda x: x[j]), (lambda x: x[j])
    if rng.uniform() < 0.45:
        (f, g), (a, b) = UNARY[rng.integers(len(UNARY))], written(rng, depth - 1)
        return (lambda x: f(a(x))), (lambda x: g(b(x)))
    f, g = BINARY[rng.integers(len(BINARY))]
    (a, b), (c, d) = written(rng, depth - 1), written(rng, depth - 1)
    return (lambda x: f(a(x), c(x))), (lambda x: g(b(x), d(x)))
