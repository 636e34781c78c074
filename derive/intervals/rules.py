"""Which range rule belongs to which operation of CasADi."""

from collections.abc import Callable

import casadi as ca
import numpy as np

from obsynth.derive.intervals import functions as fn
from obsynth.derive.rigour import Interval
from obsynth.derive.rigour import interval as ar
from obsynth.symbolic.arrays import BoolArray, FloatArray


def _erf(value: FloatArray) -> FloatArray:
    from scipy.special import erf

    return np.asarray(erf(value), dtype=float)


_SAME = (
    "assign add exp log sqrt twice asin acos atan floor sign copysign erf sinh cosh tanh asinh "
    "acosh atanh log1p expm1 if_else_zero"
)
_OTHERS = {
    "sub": "subtract",
    "mul": "multiply",
    "div": "divide",
    "neg": "negate",
    "pow": "power",
    "constpow": "power_const",
    "sq": "square",
    "inv": "inverse",
    "sin": "sine",
    "cos": "cosine",
    "tan": "tangent",
    "atan2": "arctangent2",
    "hypot": "hypotenuse",
    "fabs": "absolute",
    "fmin": "minimum",
    "fmax": "maximum",
    "fmod": "remainder",
    "ceil": "ceiling",
    "lt": "less",
    "le": "less_equal",
    "eq": "equal",
    "ne": "not_equal",
    "not": "logical_not",
    "and": "conjunction",
    "or": "disjunction",
}
NAMES: dict[int, str] = {
    getattr(ca, f"OP_{op.upper()}"): name
    for op, name in (*((name, name) for name in _SAME.split()), *_OTHERS.items())
}


def _both(function: Callable[[FloatArray], FloatArray]) -> Callable[[Interval], Interval]:
    """Make the rule of an increasing function that is exact; of sign over zero it is [-1, 1]."""
    return lambda a: (function(a[0]), function(a[1]))


_HALF = float(np.nextafter(0.5 * np.pi, np.inf))


_MINUS_ACOS = fn.increasing(
    lambda v: -np.arccos(v), -float(np.nextafter(np.pi, np.inf)), 0.0, (-1.0, 1.0)
)

RULES: dict[str, Callable[..., Interval]] = {
    "add": ar.add,
    "subtract": ar.subtract,
    "multiply": ar.multiply,
    "divide": ar.divide,
    "negate": ar.negate,
    "twice": ar.twice,
    "power_int": ar.power_int,
    "sqrt": ar.sqrt,
    "nonnegative": ar.nonnegative,
    "absolute": ar.absolute,
    "minimum": ar.minimum,
    "maximum": ar.maximum,
    "meet": ar.meet,
    "with_zero": ar.with_zero,
    "exp": fn.increasing(np.exp, 0.0),
    "expm1": fn.increasing(np.expm1, -1.0),
    "log": fn.increasing(np.log, domain=(0.0, np.inf)),
    "log1p": fn.increasing(np.log1p, domain=(-1.0, np.inf)),
    "sinh": fn.increasing(np.sinh),
    "tanh": fn.increasing(np.tanh, -1.0, 1.0),
    "asinh": fn.increasing(np.arcsinh),
    "acosh": fn.increasing(np.arccosh, 0.0, domain=(1.0, np.inf)),
    "atanh": fn.increasing(np.arctanh, domain=(-1.0, 1.0)),
    "asin": fn.increasing(np.arcsin, -_HALF, _HALF, (-1.0, 1.0)),
    "acos": lambda a: ar.negate(_MINUS_ACOS(a)),
    "atan": fn.increasing(np.arctan, -_HALF, _HALF),
    "erf": fn.increasing(_erf, -1.0, 1.0),
    "sine": fn.sine,
    "cosine": fn.cosine,
    "tangent": fn.tangent,
    "cosh": fn.cosh,
    "power": fn.power,
    "power_const": fn.power_const,
    "arctangent2": fn.arctangent2,
    "hypotenuse": fn.hypotenuse,
    "remainder": fn.remainder,
    "sign": _both(np.sign),
    "copysign": fn.copysign,
    "floor": _both(np.floor),
    "ceiling": _both(np.ceil),
    "less": fn.less,
    "less_equal": fn.less_equal,
    "equal": fn.equal,
    "boundary_weight": fn.boundary_weight,
    "logical_not": fn.logical_not,
    "conjunction": ar.minimum,
    "disjunction": ar.maximum,
    "if_else_zero": lambda condition, a: fn.select(condition, a, ar.point(0.0)),
    "select": fn.select,
}

COMMUTATIVE = frozenset(
    {"add", "multiply", "minimum", "maximum", "equal", "conjunction", "disjunction", "hypotenuse"}
)

_ROOT = "a square root of an interval that reaches below zero"
_LOGARITHM = "a logarithm of an interval that reaches zero"

PARTIAL = {
    "divide": "a division by an interval that contains zero",
    "sqrt": _ROOT,
    "nonnegative": _ROOT,
    "log": _LOGARITHM,
    "log1p": _LOGARITHM,
    "power": "a power of an interval that reaches zero",
    "power_const": "a fractional or negative power of an interval that reaches zero",
    "tangent": "a tangent over a pole",
    "asin": "an arc sine of an interval that leaves [-1, 1]",
    "acos": "an arc cosine of an interval that leaves [-1, 1]",
    "acosh": "an inverse hyperbolic cosine of an interval that reaches below 1",
    "atanh": "an inverse hyperbolic tangent of an interval that reaches -1 or 1",
}
"""Operations that are not defined everywhere, with what is wrong where they are not."""

JUMPS = frozenset(
    {
        "sign",
        "copysign",
        "floor",
        "ceiling",
        "remainder",
        "less",
        "less_equal",
        "equal",
        "boundary_weight",
        "arctangent2",
    }
)
"""Operations with a jump, of which CasADi's derivative knows nothing."""


def uncertain(op: str, result: Interval, operands: list[Interval]) -> BoolArray:
    """Where an operation may jump or be undefined inside the box."""
    lo, hi = result
    if op in PARTIAL:
        return np.asarray(~(np.isfinite(lo) & np.isfinite(hi)))
    if op == "copysign":
        return np.asarray(~((operands[1][0] > 0.0) | (operands[1][1] < 0.0)))
    if op == "remainder":
        inside = ar.absolute(operands[0])[1] < ar.absolute(operands[1])[0]
        return np.asarray(~inside)
    if op == "arctangent2":
        (y_lo, y_hi), (x_lo, _) = operands
        return np.asarray(~((x_lo > 0.0) | (y_lo > 0.0) | (y_hi < 0.0)))
    return np.asarray(lo != hi)
