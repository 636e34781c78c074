"""What rounding errors of operands do to the result of an operation: the rules of `rounding`."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from obsynth.derive.intervals.rules import RULES
from obsynth.derive.rigour import Interval
from obsynth.derive.rigour.interval import TINY, absolute, multiply, power_int, raised
from obsynth.symbolic.arrays import BoolArray, FloatArray

Form = Mapping[tuple[int, int], int]
ONE_ROUNDING = frozenset({"add", "subtract", "multiply", "divide", "inverse", "square", "sqrt"})
NO_ROUNDING = frozenset(
    {"assign", "negate", "twice", "absolute", "minimum", "maximum", "sign", "copysign", "floor"}
    | {"ceiling", "remainder", "less", "less_equal", "equal", "not_equal", "logical_not"}
    | {"conjunction", "disjunction", "if_else_zero"}
)
_ONE: Interval = (np.ones(1), np.ones(1))
RANGES: Mapping[str, Callable[..., Interval]] = {
    **RULES,
    "assign": lambda a: a,
    "square": lambda a: power_int(a, 2),
    "inverse": lambda a: RULES["divide"](_ONE, a),
    "not_equal": lambda a, b: RULES["logical_not"](RULES["equal"](a, b)),
}


def _one_plus(a: Interval, sign: float) -> Interval:
    square = power_int(a, 2)
    return RULES["add"](_ONE, square if sign > 0 else RULES["negate"](square))


_SLOPES: Mapping[str, Callable[[Interval], Interval]] = {
    "exp": RULES["exp"],
    "expm1": RULES["exp"],
    "log": lambda a: RULES["divide"](_ONE, a),
    "log1p": lambda a: RULES["divide"](_ONE, RULES["add"](_ONE, a)),
    "sine": RULES["cosine"],
    "cosine": RULES["sine"],
    "tangent": lambda a: _one_plus(RULES["tangent"](a), 1.0),
    "asin": lambda a: RULES["divide"](_ONE, RULES["sqrt"](_one_plus(a, -1.0))),
    "acos": lambda a: RULES["divide"](_ONE, RULES["sqrt"](_one_plus(a, -1.0))),
    "atan": lambda a: RULES["divide"](_ONE, _one_plus(a, 1.0)),
    "sinh": RULES["cosh"],
    "cosh": RULES["sinh"],
    "tanh": lambda a: (0.0 * a[0], 0.0 * a[0] + 1.0),
    "asinh": lambda a: (0.0 * a[0], 0.0 * a[0] + 1.0),
    "acosh": lambda a: RULES["divide"](_ONE, RULES["sqrt"](RULES["negate"](_one_plus(a, -1.0)))),
    "atanh": lambda a: RULES["divide"](_ONE, _one_plus(a, -1.0)),
    "erf": lambda a: (0.0 * a[0], 0.0 * a[0] + 1.1284),
}
"""Derivatives of library functions, for intervals."""


@dataclass(eq=False)
class Node:
    """What is known of one number of the tape, per cell.

    lo, hi (2, cells): of the exact value and of the computed one
    e (cells,): bound of their distance
    form: the combination of inputs that it exactly is, if any
    test: the comparison that a truth value comes from, and whether it is its negation
    choice: truth value and operand of what is that operand or zero
    """

    lo: FloatArray
    hi: FloatArray
    e: FloatArray
    form: Form | None = None
    test: tuple[int, bool] | None = None
    choice: tuple["Node", "Node"] | None = None

    @property
    def range(self) -> Interval:
        """Both intervals."""
        return self.lo, self.hi

    @property
    def size(self) -> FloatArray:
        """Largest magnitudes, (2, cells)."""
        return np.maximum(np.abs(self.lo), np.abs(self.hi))

    @property
    def least(self) -> FloatArray:
        """Smallest magnitudes, (2, cells)."""
        return absolute(self.range)[0]


def over(value: FloatArray) -> FloatArray:
    """Raise a sum of few nonnegative terms above its rounding; an exact zero stays one."""
    return np.where(value == 0.0, 0.0, raised(value, 12))


def _times(a: FloatArray, b: FloatArray) -> FloatArray:
    """Multiply nonnegative numbers; zero times anything is zero, and no other product is."""
    product = np.where((a == 0.0) | (b == 0.0), 0.0, a * b)
    return np.where((product == 0.0) & (a != 0.0) & (b != 0.0), TINY, product)


def propagated(name: str, operands: list[Node], node: Node) -> FloatArray:
    """Bound what the errors of the operands do to the result, (cells,); infinite where unknown."""
    a, b = operands[0], operands[-1]
    if name in ("add", "subtract"):
        return over(a.e + b.e)
    if name in ("negate", "absolute", "assign"):
        return a.e
    if name == "twice":
        return 2.0 * a.e
    if name == "multiply":
        return over(_times(a.e, b.size[0]) + _times(a.size[0], b.e) + _times(a.e, b.e))
    if name == "square":
        return over(2.0 * _times(a.size[0], a.e) + _times(a.e, a.e))
    if name in ("divide", "inverse"):
        exact, computed = 1.0 / b.least
        turned = _times(_times(b.e, computed), exact)
        if name == "inverse":
            return over(turned)
        return over(_times(a.e, computed) + _times(turned, a.size[0]))
    if name == "sqrt":
        roots = np.sqrt(np.maximum(a.lo, 0.0)).sum(axis=0)
        return over(np.minimum(np.where(roots > 0.0, a.e / roots, np.inf), np.sqrt(a.e)))
    if name in ("minimum", "maximum"):
        if name == "minimum":
            first = (a.hi.max(axis=0) < b.lo.min(axis=0)), (b.hi.max(axis=0) < a.lo.min(axis=0))
        else:
            first = (a.lo.min(axis=0) > b.hi.max(axis=0)), (b.lo.min(axis=0) > a.hi.max(axis=0))
        return np.where(first[0], a.e, np.where(first[1], b.e, np.maximum(a.e, b.e)))
    if name == "if_else_zero":
        return np.where(a.e == 0.0, b.e, np.inf)
    if name == "hypotenuse":
        return over(a.e + b.e)
    if name == "arctangent2":
        (y, _), (x_lo, _) = _hull(a), _hull(b)
        away = (x_lo > 0.0) | (y > 0.0) | (_hull(a)[1] < 0.0)
        radius = np.hypot(a.least.min(axis=0), b.least.min(axis=0)) * (1.0 - 2.0**-48)
        return np.where(away, over((a.e + b.e) / radius), np.inf)
    if name in ("power", "power_const"):
        return _power(a, b)
    if name in _SLOPES:
        lo, hi = _hull(a)
        return over(_times(a.e, np.maximum(*map(np.abs, _SLOPES[name]((lo, hi))))))
    return np.full_like(node.e, np.inf)


def _hull(a: Node) -> Interval:
    return a.lo.min(axis=0), a.hi.max(axis=0)


def _power(a: Node, b: Node) -> FloatArray:
    """a^b for a > 0: b a^(b-1) and log(a) a^b."""
    base, exponent = _hull(a), _hull(b)
    by_base = multiply(exponent, RULES["power"](base, RULES["subtract"](exponent, _ONE)))
    by_exponent = multiply(RULES["log"](base), RULES["power"](base, exponent))
    first, second = (np.maximum(*map(np.abs, slope)) for slope in (by_base, by_exponent))
    return over(_times(a.e, first) + _times(b.e, second))


def form_of(name: str, operands: list[Node]) -> Form | None:
    """Return the combination of inputs that a sum, a difference or a negation is."""
    forms = [operand.form for operand in operands]
    if name not in ("add", "subtract", "negate") or any(form is None for form in forms):
        return None
    signs = {"add": (1, 1), "subtract": (1, -1), "negate": (-1,)}[name]
    total: dict[tuple[int, int], int] = {}
    for sign, form in zip(signs, forms, strict=True):
        for key, coefficient in (form or {}).items():
            total[key] = total.get(key, 0) + sign * coefficient
    return {key: coefficient for key, coefficient in total.items() if coefficient}


def is_exact(name: str, operands: list[Node]) -> BoolArray:
    """Where a sum needs no rounding: one operand is zero, or Sterbenz."""
    if name not in ("add", "subtract"):
        return np.zeros(operands[0].e.shape, dtype=bool)
    (al, ah), (bl, bh) = ((node.lo[1], node.hi[1]) for node in operands)
    if name == "add":
        bl, bh = -bh, -bl
    zero = ((al == 0.0) & (ah == 0.0)) | ((bl == 0.0) & (bh == 0.0))
    # of one sign: b by itself, a within the factor of it
    above = (bl > 0.0) & (bh <= 2.0 * al) & (ah <= 2.0 * bl)
    below = (bh < 0.0) & (bl >= 2.0 * ah) & (al >= 2.0 * bh)
    return np.asarray(zero | above | below)
