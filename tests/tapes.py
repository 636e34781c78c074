"""Instruction tapes of CasADi functions, run with 300 bits and in a precision."""

import casadi as ca
import mpmath
import numpy as np

from obsynth.derive.intervals.rules import NAMES

TYPES = {"double": np.float64, "single": np.float32}
SAME = {
    "exp",
    "log",
    "sinh",
    "cosh",
    "tanh",
    "asin",
    "acos",
    "atan",
    "asinh",
    "acosh",
    "atanh",
    "expm1",
    "log1p",
    "erf",
}
ARCS = ("sin", "cos", "tan", "sinh", "cosh", "tanh")
SINGLE = {"sine": "sin", "cosine": "cos", "tangent": "tan", "hypotenuse": "hypot"}


def truth(value):
    return mpmath.mpf(1 if value else 0)


EXACT = {
    "assign": lambda a: a,
    "add": lambda a, b: a + b,
    "subtract": lambda a, b: a - b,
    "multiply": lambda a, b: a * b,
    "divide": lambda a, b: a / b,
    "inverse": lambda a: 1 / a,
    "square": lambda a: a * a,
    "twice": lambda a: 2 * a,
    "negate": lambda a: -a,
    "absolute": abs,
    "sqrt": mpmath.sqrt,
    "minimum": min,
    "maximum": max,
    "less": lambda a, b: truth(a < b),
    "less_equal": lambda a, b: truth(a <= b),
    "logical_not": lambda a: truth(a == 0),
    "conjunction": lambda a, b: truth(a != 0 and b != 0),
    "if_else_zero": lambda a, b: b if a != 0 else mpmath.mpf(0),
    "sign": mpmath.sign,
    "power_const": mpmath.power,
    "power": mpmath.power,
    "arctangent2": mpmath.atan2,
    **{name: getattr(mpmath, SINGLE[name]) for name in SINGLE},
    **{name: getattr(mpmath, name) for name in SAME},
}
NUMPY = {
    "assign": lambda a: a,
    "add": np.add,
    "subtract": np.subtract,
    "multiply": np.multiply,
    "divide": np.divide,
    "inverse": lambda a: a.dtype.type(1) / a,
    "square": lambda a: a * a,
    "twice": lambda a: a + a,
    "negate": np.negative,
    "absolute": np.abs,
    "sqrt": np.sqrt,
    "minimum": np.fmin,
    "maximum": np.fmax,
    "less": np.less,
    "less_equal": np.less_equal,
    "logical_not": lambda a: a == 0,
    "conjunction": lambda a, b: (a != 0) & (b != 0),
    "disjunction": lambda a, b: (a != 0) | (b != 0),
    "ceiling": np.ceil,
    "if_else_zero": lambda a, b: np.where(a != 0, b, b.dtype.type(0)),
    "sign": np.sign,
    "power_const": np.power,
    "power": np.power,
    "arctangent2": np.arctan2,
    **{f"a{name}": getattr(np, f"arc{name}") for name in ARCS},
    "erf": lambda a: a.dtype.type(1) * np.vectorize(lambda v: float(mpmath.erf(float(v))))(a),
    **{name: getattr(np, SINGLE[name]) for name in SINGLE},
    **{name: getattr(np, name) for name in SAME - {"erf"} if name[0] != "a"},
}


def tape(function, inputs, rules, number):
    """Run the instructions with rules of an arithmetic; inputs are lists per input."""
    work, found = {}, {}
    for k in range(function.n_instructions()):
        code = function.instruction_id(k)
        out, args = function.instruction_output(k), function.instruction_input(k)
        if code == ca.OP_INPUT:
            work[out[0]] = inputs[args[0]][args[1]]
        elif code == ca.OP_CONST:
            work[out[0]] = number(function.instruction_constant(k))
        elif code == ca.OP_OUTPUT:
            found[out[0], out[1]] = work[args[0]]
        else:
            work[out[0]] = rules[NAMES[code]](*(work[a] for a in args))
    return [found[key] for key in sorted(found)]


def errors(function, points, precision, constants=None):
    """|computed - exact| of every output at every point: (outputs, points), rounded down.

    constants: what the numbers of the tape stand for, where that is not the double.
    """
    kind = TYPES[precision]
    meant = constants or {}
    with np.errstate(all="ignore"):
        computed = tape(
            function,
            [[row.astype(kind) for row in part] for part in points],
            NUMPY,
            lambda value: np.full(points[0].shape[1], value, dtype=kind),
        )
    result = np.zeros((len(computed), points[0].shape[1]))
    with mpmath.workprec(300):
        for k in range(result.shape[1]):
            exact = tape(
                function,
                [[mpmath.mpf(float(v)) for v in part[:, k]] for part in points],
                EXACT,
                lambda value: meant.get(value, mpmath.mpf(value)),
            )
            for i, value in enumerate(exact):
                result[i, k] = float(abs(mpmath.mpf(float(computed[i][k])) - value)) * (1 - 1e-15)
    return result


def sample(rng, lo, hi, count, precision):
    """Numbers of the precision in cells, ends among them: (entries, count)."""
    pick = rng.integers(0, lo.shape[1], count)
    low, high = lo[:, pick], hi[:, pick]
    share = rng.random(low.shape)
    share = np.where(rng.random(low.shape) < 0.2, np.round(share), share)
    value = (low + share * (high - low)).astype(TYPES[precision]).astype(float)
    return np.clip(value, low, high)
