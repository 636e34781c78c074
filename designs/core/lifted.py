"""Interval arithmetic lifted into CasADi: ends are SX, every rounded operation steps outwards.

What comes out is code that encloses the range of a program for any ends. Beside its symbols every
interval carries the numbers between which they can lie, by the rules of the derivations; where
these know a sign the formula is the short one, and an operation that has no lifted form is enclosed
by them alone.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce

import casadi as ca
import numpy as np

from obsynth.derive.intervals.functions import ULPS
from obsynth.derive.intervals.graph import Node
from obsynth.derive.intervals.program import Program
from obsynth.derive.intervals.rules import PARTIAL, RULES
from obsynth.derive.rigour.interval import UNIT
from obsynth.designs.core.boxes import FAR, Lifted, Rounding

_TWO_PI = 2.0 * np.pi


def lift(
    program: Program,
    nodes: Sequence[int],
    variables: Sequence[Lifted],
    rounding: Rounding | None = None,
) -> list[Lifted]:
    """Return what nodes of a program enclose for variables between lifted ends."""
    arithmetic = _Arithmetic(Rounding() if rounding is None else rounding)
    found: dict[int, Lifted] = {}
    for index in needed(program, nodes):
        node = program.nodes[index]
        if index in program.constants:
            low, high = (float(end[0]) for end in program.constants[index])
            found[index] = arithmetic.rounding.number(*_within(low, high))
        elif node.op == "input":
            found[index] = arithmetic.rounding.signal(variables[node.number])
        else:
            found[index] = arithmetic.apply(node, [found[a] for a in node.args])
    return [found[index] for index in nodes]


def combine(op: str, *args: Lifted, rounding: Rounding, number: int = 0) -> Lifted:
    """Return one operation of the rules; `number` is the exponent of ``power_int``."""
    return _Arithmetic(rounding).apply(Node(op, (), number), list(args))


def needed(program: Program, nodes: Sequence[int]) -> list[int]:
    """List nodes and what they are made of, operands first."""
    found: set[int] = set()
    stack = list(nodes)
    while stack:
        index = stack.pop()
        if index not in found:
            found.add(index)
            stack.extend(() if index in program.constants else program.nodes[index].args)
    return sorted(found)


def is_point(a: Lifted) -> bool:
    """Whether both ends are one number."""
    return bool(ca.is_equal(a.lower, a.upper, 2))


def _within(low: float, high: float) -> tuple[float, float]:
    """Return numbers with `FAR` in place of what is beyond, or unknown."""
    known = not (np.isnan(low) or np.isnan(high))
    return (low if low > -FAR else -FAR, high if high < FAR else FAR) if known else (-FAR, FAR)


@dataclass(frozen=True, eq=False)
class _Arithmetic:
    rounding: Rounding

    def apply(self, node: Node, args: list[Lifted]) -> Lifted:
        """Return one operation, by its lifted form or by its numbers."""
        extra = (node.number,) if node.op == "power_int" else ()
        ends = [(np.array([a.low]), np.array([a.high])) for a in args]
        with np.errstate(all="ignore"):
            low, high = (float(end[0]) for end in RULES[node.op](*ends, *extra))
        nowhere = bool(np.isnan([low, high]).any())
        low, high = _within(low, high)
        form = _FORMS.get(node.op)
        if form is None or (nowhere and node.op != "divide"):
            return self.rounding.number(low, high)
        lifted = form(
            self,
            [clamped(a, self.rounding) for a in args] if node.op in PARTIAL else args,
            low,
            high,
            *extra,
        )
        return self.rounding.number(low, high) if lifted is None else lifted

    def add(self, args: list[Lifted], low: float, high: float) -> Lifted:
        a, b = args
        if _zero(a) or _zero(b):
            return b if _zero(a) else a
        return self.rounding.interval(a.lower + b.lower, a.upper + b.upper, low, high, tiny=False)

    def subtract(self, args: list[Lifted], low: float, high: float) -> Lifted:
        a, b = args
        if _zero(a) or _zero(b):
            return Lifted(-b.upper, -b.lower, low, high) if _zero(a) else a
        return self.rounding.interval(a.lower - b.upper, a.upper - b.lower, low, high, tiny=False)

    def multiply(self, args: list[Lifted], low: float, high: float) -> Lifted:
        if any(map(_zero, args)):
            return Lifted.number(0.0)
        for a, b in (args, args[::-1]):
            if _factor(a):
                return self.scaled(b, a, low, high)
        return self.rounding.interval(*_product(*args), low, high)

    def scaled(self, a: Lifted, by: Lifted, low: float, high: float, power: int = 1) -> Lifted:
        """Multiply with, or divide by (power -1), a number that is known to some units."""
        number, unit = (0.5 * by.low + 0.5 * by.high) ** power, UNIT[self.rounding.precision]
        units = 1.0 if power == 1 else 2.0
        if by.low != by.high:
            units += 0.5 + 0.3 * (by.high - by.low) / (abs(by.low) * unit)
        elif abs(np.frexp(number)[0]) == 0.5:
            units = 0.0
        lower, upper = (a.lower, a.upper) if number > 0.0 else (a.upper, a.lower)
        return self.rounding.interval(number * lower, number * upper, low, high, units)

    def divide(self, args: list[Lifted], low: float, high: float) -> Lifted | None:
        a, b = args
        if not (b.low > 0.0 or b.high < 0.0):
            return self._divide_open(a, b)
        if _factor(b):
            return self.scaled(a, b, low, high, -1)
        pairs = [(p, q) for p in _ends(a) for q in _ends(b)]
        if a.low >= 0.0 or a.high <= 0.0:
            # signs known: the ends that make the quotient smallest and largest
            top, bottom = (a.lower, a.upper), (b.lower, b.upper)
            if b.high < 0.0:
                top, bottom = (-a.upper, -a.lower), (-b.upper, -b.lower)
            nonnegative = (a.low >= 0.0) == (b.low > 0.0)
            order = (1, 0) if nonnegative else (0, 1)
            lower, upper = top[0] / bottom[order[0]], top[1] / bottom[order[1]]
        else:
            quotients = [p / q for p, q in pairs]
            lower, upper = reduce(ca.fmin, quotients), reduce(ca.fmax, quotients)
        return self.rounding.interval(lower, upper, low, high)

    def _divide_open(self, a: Lifted, b: Lifted) -> Lifted:
        """Divide by what may be zero: nothing where it may."""
        apart = ca.logic_or(b.lower > 0.0, b.upper < 0.0)
        safe = [ca.if_else(apart, end, 1.0) for end in _ends(b)]
        quotients = [p / q for p in _ends(a) for q in safe]
        found = self.rounding.interval(
            reduce(ca.fmin, quotients), reduce(ca.fmax, quotients), -FAR, FAR
        )
        far = self.rounding.limits.largest
        return Lifted(ca.if_else(apart, found.lower, -far), ca.if_else(apart, found.upper, far))

    def power_int(self, args: list[Lifted], low: float, high: float, n: int) -> Lifted:
        (a,) = args
        units = 1.0 if n == 2 else 2.0 * ULPS
        lower, upper = (_to(end, n) for end in (a.lower, a.upper))
        if n % 2 == 0 and a.low < 0.0:
            if a.high <= 0.0:
                lower, upper = upper, lower
            else:
                inside = ca.logic_and(a.lower <= 0.0, a.upper >= 0.0)
                lower, upper = (
                    ca.if_else(inside, 0.0, ca.fmin(lower, upper)),
                    ca.fmax(lower, upper),
                )
        return self.rounding.interval(lower, upper, low, high, units)

    def sqrt(self, args: list[Lifted], low: float, high: float) -> Lifted:
        (a,) = args
        return self.rounding.interval(ca.sqrt(a.lower), ca.sqrt(a.upper), low, high, tiny=False)

    def nonnegative(self, args: list[Lifted], low: float, high: float) -> Lifted:
        return args[0]

    def absolute(self, args: list[Lifted], low: float, high: float) -> Lifted:
        (a,) = args
        if a.low >= 0.0:
            return a
        if a.high <= 0.0:
            return Lifted(-a.upper, -a.lower, low, high)
        return Lifted(
            ca.fmax(ca.fmax(a.lower, -a.upper), 0.0), ca.fmax(-a.lower, a.upper), low, high
        )

    def power_const(self, args: list[Lifted], low: float, high: float) -> Lifted | None:
        a, p = args
        if p.low != p.high:
            return None
        ends = [a.lower**p.low, a.upper**p.low]
        lower, upper = ends if p.low >= 0.0 else ends[::-1]
        return self.rounding.interval(lower, upper, low, high, 2.0 * ULPS)

    def corners(
        self, function: Callable[..., ca.SX], args: list[Lifted], low: float, high: float
    ) -> Lifted:
        """Enclose a function of two variables that is monotone in each of them."""
        values = [function(p, q) for p in _ends(args[0]) for q in _ends(args[1])]
        lower, upper = reduce(ca.fmin, values), reduce(ca.fmax, values)
        return self.rounding.interval(lower, upper, low, high, 2.0 * ULPS)

    def arctangent2(self, args: list[Lifted], low: float, high: float) -> Lifted | None:
        y, x = args
        whole = x.low > 0.0 or y.low > 0.0 or y.high < 0.0
        return self.corners(ca.atan2, args, low, high) if whole else None

    def hypotenuse(self, args: list[Lifted], low: float, high: float) -> Lifted:
        return self.corners(ca.hypot, [self.absolute([a], 0.0, FAR) for a in args], low, high)

    def cosh(self, args: list[Lifted], low: float, high: float) -> Lifted:
        return _increasing(ca.cosh)(self, [self.absolute(args, 0.0, FAR)], low, high)

    def wave(
        self,
        function: Callable[[ca.SX], ca.SX],
        crest: float,
        args: list[Lifted],
        low: float,
        high: float,
    ) -> Lifted:
        """Enclose a sine or cosine: its crest at a phase, its trough half a period on."""
        (a,) = args
        left, right = function(a.lower), function(a.upper)
        found = self.rounding.interval(
            ca.fmin(left, right), ca.fmax(left, right), -1.0, 1.0, 2.0 * ULPS
        )
        unknown = ca.logic_not(
            ca.fmax(ca.fabs(a.lower), ca.fabs(a.upper)) < self.rounding.limits.angle
        )
        lower, upper = ca.fmax(found.lower, -1.0), ca.fmin(found.upper, 1.0)
        if self._may_cross(a, crest):
            top = ca.logic_or(self._crosses(a, crest), unknown)
            upper = ca.if_else(top, 1.0, upper)
        if self._may_cross(a, crest + np.pi):
            bottom = ca.logic_or(self._crosses(a, crest + np.pi), unknown)
            lower = ca.if_else(bottom, -1.0, lower)
        return Lifted(lower, upper, low, high)

    def _margin(self) -> float:
        return 16.0 * self.rounding.step

    def _may_cross(self, a: Lifted, phase: float) -> bool:
        """Whether an extremum can lie between the numbers at all."""
        if max(abs(a.low), abs(a.high)) >= self.rounding.limits.angle:
            return True
        margin = self._margin() * (abs(a.low) + abs(a.high) + 4.0)
        first = np.ceil((a.low - phase - margin) / _TWO_PI)
        return bool(first * _TWO_PI <= a.high - phase + margin)

    def _crosses(self, a: Lifted, phase: float) -> ca.SX:
        margin = self._margin() * (ca.fabs(a.lower) + ca.fabs(a.upper) + 4.0)
        first = ca.ceil((a.lower - phase - margin) / _TWO_PI)
        return first * _TWO_PI <= a.upper - phase + margin

    def select(self, args: list[Lifted], low: float, high: float) -> Lifted:
        condition, a, b = args
        true, false = condition.lower > 0.0, condition.upper <= 0.0
        lower = ca.if_else(true, a.lower, ca.if_else(false, b.lower, ca.fmin(a.lower, b.lower)))
        upper = ca.if_else(true, a.upper, ca.if_else(false, b.upper, ca.fmax(a.upper, b.upper)))
        return Lifted(lower, upper, low, high)

    def if_else_zero(self, args: list[Lifted], low: float, high: float) -> Lifted:
        return self.select([*args, Lifted.number(0.0)], low, high)


def clamped(a: Lifted, rounding: Rounding) -> Lifted:
    """Keep the ends between the numbers, where an operation is not defined beyond them."""
    (low, high), far = rounding.around(a.low, a.high), rounding.limits.largest
    if ca.SX(a.lower).is_constant() and ca.SX(a.upper).is_constant():
        return a
    lower = ca.fmax(a.lower, low) if a.low > -far else a.lower
    return Lifted(lower, ca.fmin(a.upper, high) if a.high < far else a.upper, a.low, a.high)


def _ends(a: Lifted) -> tuple[ca.SX, ...]:
    return (a.lower,) if is_point(a) else (a.lower, a.upper)


def _product(a: Lifted, b: Lifted) -> tuple[ca.SX, ca.SX]:
    """Multiply with as few products as the known signs allow; rounded ends."""
    if a.low < 0.0 < a.high and not b.low < 0.0 < b.high:
        a, b = b, a
    if a.high <= 0.0 and a.low < 0.0:
        lower, upper = _product(Lifted(-a.upper, -a.lower, -a.high, -a.low), b)
        return -upper, -lower
    if a.low >= 0.0:
        least = (a.upper if b.high <= 0.0 else a.lower) if _signed(b) else None
        most = (a.lower if b.high <= 0.0 else a.upper) if _signed(b) else None
        if least is not None and most is not None:
            return least * b.lower, most * b.upper
        if len(_ends(a)) == 1:
            return a.lower * b.lower, a.lower * b.upper
        return (
            ca.fmin(a.lower * b.lower, a.upper * b.lower),
            ca.fmax(a.lower * b.upper, a.upper * b.upper),
        )
    products = [p * q for p in _ends(a) for q in _ends(b)]
    return reduce(ca.fmin, products), reduce(ca.fmax, products)


def _factor(a: Lifted) -> bool:
    """Whether an interval is a constant that is known to some units."""
    size = min(abs(a.low), abs(a.high)) if a.low * a.high > 0.0 else 0.0
    return a.lower.is_constant() and a.upper.is_constant() and a.high - a.low < 2.0**-46 * size


def _zero(a: Lifted) -> bool:
    return a.low == 0.0 == a.high


def _signed(a: Lifted) -> bool:
    return a.low >= 0.0 or a.high <= 0.0


def _to(value: ca.SX, n: int) -> ca.SX:
    return value * value if n == 2 else value**n


def _increasing(function: Callable[[ca.SX], ca.SX]) -> Callable[..., Lifted]:
    def form(arithmetic: _Arithmetic, args: list[Lifted], low: float, high: float) -> Lifted:
        found = arithmetic.rounding.interval(
            function(args[0].lower), function(args[0].upper), low, high, 2.0 * ULPS
        )
        return clamped(found, arithmetic.rounding)

    return form


def _unrounded(ends: Callable[..., tuple[ca.SX, ca.SX]]) -> Callable[..., Lifted]:
    """Return the form of an operation whose ends are not rounded."""
    return lambda self, args, low, high: Lifted(*ends(*args), low, high)


_ENDS: Mapping[str, Callable[..., tuple[ca.SX, ca.SX]]] = {
    "negate": lambda a: (-a.upper, -a.lower),
    "twice": lambda a: (2.0 * a.lower, 2.0 * a.upper),
    "minimum": lambda a, b: (ca.fmin(a.lower, b.lower), ca.fmin(a.upper, b.upper)),
    "maximum": lambda a, b: (ca.fmax(a.lower, b.lower), ca.fmax(a.upper, b.upper)),
    "meet": lambda a, b: (ca.fmax(a.lower, b.lower), ca.fmin(a.upper, b.upper)),
    "with_zero": lambda a: (ca.fmin(a.lower, 0.0), ca.fmax(a.upper, 0.0)),
    "less": lambda a, b: (a.upper < b.lower, a.lower < b.upper),
    "less_equal": lambda a, b: (a.upper <= b.lower, a.lower <= b.upper),
    "boundary_weight": lambda a, b: (a.upper < b.lower, a.lower <= b.upper),
    "logical_not": lambda a: (a.upper <= 0.0, a.lower <= 0.0),
}
_OWN = """add subtract multiply divide power_int sqrt nonnegative absolute power_const select
if_else_zero arctangent2 hypotenuse cosh"""
_INCREASING = "exp expm1 log log1p sinh tanh asinh acosh atanh asin atan erf"
_FORMS: Mapping[str, Callable[..., Lifted | None]] = {
    **{name: getattr(_Arithmetic, name) for name in _OWN.split()},
    **{name: _unrounded(ends) for name, ends in _ENDS.items()},
    **{name: _increasing(getattr(ca, name)) for name in _INCREASING.split()},
    "tangent": _increasing(ca.tan),
    "acos": lambda self, args, *given: _increasing(ca.acos)(
        self, [Lifted(args[0].upper, args[0].lower)], *given
    ),
    "power": lambda self, *given: self.corners(lambda a, b: a**b, *given),
    "conjunction": _unrounded(_ENDS["minimum"]),
    "disjunction": _unrounded(_ENDS["maximum"]),
    "sine": lambda self, *given: self.wave(ca.sin, 0.5 * np.pi, *given),
    "cosine": lambda self, *given: self.wave(ca.cos, 0.0, *given),
}
