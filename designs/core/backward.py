"""Contraction of a box by what is known of nodes of a program: forward, then backward (HC4-revise).

Every operation is enclosed over the box (`lifted`), met with what is known of it, and solved for
each of its operands in reverse order, so that the box is cut to what can have led there. No point
of the box whose nodes lie in what is told is lost, in floating point: every cut is rounded
outwards, and an end that is not a number cuts nothing, as ``fmax`` and ``fmin`` of C99 leave it
out. Where an operation has no inverse that is unique its operands are left alone: over a pole, a
crest, a factor or a divisor that may be zero together with the product, a choice that is open.

An operation that may be undefined in the box is inverted only if some told node is defined nowhere
else; below a choice it may be the branch that is not taken. Ends of `FAR` are no bounds: what they
would say of an operand by a logarithm or a root is left out.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import casadi as ca
import numpy as np

from obsynth.derive.intervals.functions import ULPS
from obsynth.derive.intervals.graph import Node
from obsynth.derive.intervals.program import Program
from obsynth.derive.intervals.rules import PARTIAL, RULES
from obsynth.derive.rigour.interval import UNIT
from obsynth.designs.core.lifted import FAR, Lifted, Rounding, combine, lift, needed, varying

_QUARTER = 0.5 * np.pi  # as doubles these are below the numbers that they stand for
_HALF = np.pi
_SMALL = 2.0**-1000
_LARGEST_LOGARITHM = 745.0
_CHOICES = {"select": (1, 2), "if_else_zero": (1,), "meet": (0, 1), "with_zero": (0,)}


def contract(
    program: Program, told: Mapping[int, Lifted], variables: Sequence[Lifted], rounding: Rounding
) -> tuple[list[Lifted], ca.SX]:
    """Return the variables cut to what nodes are told to be, and 1 where something told is empty.

    told: intervals in which nodes (``program.outputs[k]``) are known to lie; their numbers `low`
        and `high` hold, whatever the ends are
    """
    nodes = needed(program, list(told))
    found = dict(zip(nodes, lift(program, nodes, variables, rounding), strict=True))
    loose, sure = varying(program, nodes, variables), _sure(program, told)
    backward = _Backward(rounding)
    cut = set(told)
    for index, known in told.items():
        found[index] = _meet(found[index], known)
    for index in reversed(nodes):
        node = program.nodes[index]
        if index not in cut or index not in loose or node.op == "input":
            continue
        for k, operand in enumerate(node.args):
            args = [found[a] for a in node.args]
            value: Lifted | None = None
            if operand in loose and (index in sure or _defined(node, args)):
                value = backward.operand(node, k, found[index], args)
            if value is not None:
                found[operand] = _meet(found[operand], value)
                cut.add(operand)
    result, empty = list(variables), ca.SX(0)
    for index in sorted(cut):
        node = program.nodes[index]
        if index in told or node.op == "input":
            empty = ca.logic_or(empty, found[index].lower > found[index].upper)
        if node.op == "input":
            result[node.number] = found[index]
    return result, empty


def _sure(program: Program, told: Mapping[int, Lifted]) -> set[int]:
    """Return the nodes without a value of which some told node has none."""
    found: set[int] = set()
    stack = list(told)
    while stack:
        index = stack.pop()
        if index not in found and index not in program.constants:
            found.add(index)
            node = program.nodes[index]
            left = _CHOICES.get(node.op, ())
            stack.extend(a for k, a in enumerate(node.args) if k not in left)
    return found


def _defined(node: Node, args: list[Lifted]) -> bool:
    """Whether an operation is defined all over the numbers of its operands."""
    if node.op not in PARTIAL:
        return True
    if node.op == "divide":
        return args[1].low > 0.0 or args[1].high < 0.0
    with np.errstate(all="ignore"):
        ends = RULES[node.op](*((np.array([a.low]), np.array([a.high])) for a in args))
    return not np.isnan(ends).any()


def _meet(a: Lifted, b: Lifted) -> Lifted:
    """Cut an interval; its numbers change only where they gain a sign."""
    lower = a.lower if _constant(b.lower, -FAR) else ca.fmax(a.lower, b.lower)
    upper = a.upper if _constant(b.upper, FAR) else ca.fmin(a.upper, b.upper)
    low, high = a.low, a.high
    if b.low >= 0.0 > low or b.low > 0.0 >= low:
        low, lower = b.low, ca.fmax(lower, b.low)
    if b.high <= 0.0 < high or b.high < 0.0 <= high:
        high, upper = b.high, ca.fmin(upper, b.high)
    return Lifted(lower, upper, low, high)


def _constant(end: ca.SX, value: float) -> bool:
    return bool(ca.SX(end).is_constant()) and float(end) == value


def _clipped(a: Lifted, low: float, high: float) -> Lifted:
    """Keep the part of an interval between numbers between which the value is known to lie."""
    lower, upper = a.lower, a.upper
    if a.low < low:
        lower = ca.fmax(lower, low)
    if a.high > high:
        upper = ca.fmin(upper, high)
    return Lifted(lower, upper, max(a.low, low), min(a.high, high))


def _negative(a: Lifted) -> Lifted:
    return Lifted(-a.upper, -a.lower, -a.high, -a.low)


def _where(condition: ca.SX, a: Lifted) -> Lifted:
    """Keep a cut where a condition holds."""
    if _constant(condition, 1.0):
        return a
    lower, upper = ca.if_else(condition, a.lower, -FAR), ca.if_else(condition, a.upper, FAR)
    return Lifted(lower, upper)


def _inside(a: Lifted, limit: float) -> ca.SX | None:
    """Whether an interval is between -limit and limit: 1 by its numbers alone, None if never."""
    if a.low >= -limit and a.high <= limit:
        return ca.SX(1)
    if a.low >= limit or a.high <= -limit:
        return None
    return ca.logic_and(a.lower >= -limit, a.upper <= limit)


def _either(a: Lifted, size: Lifted) -> Lifted:
    """Return where a number is whose absolute value is known, by the side on which it is known."""
    if a.low >= 0.0:
        return size
    if a.high <= 0.0:
        return _negative(size)
    lower = ca.if_else(a.lower > -size.lower, size.lower, -size.upper)
    upper = ca.if_else(a.upper < size.lower, -size.lower, size.upper)
    return Lifted(lower, upper)


@cache
def composed(op: str) -> Program:
    """Return an operation of two operands as a program of others."""
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    forms = {
        "power": ca.exp(b * ca.log(a)),
        "hypotenuse": ca.sqrt(a * a + b * b),
        "arctangent2": ca.atan(a / b),
    }
    return Program.from_casadi(ca.Function(op, [a, b], [forms[op]]))


def composes(op: str, args: Sequence[Lifted]) -> bool:
    """Whether that program has the values of the operation, for operands between their numbers."""
    known = {"hypotenuse": True}
    if op == "power":
        known[op] = args[0].low > 0.0
    if op == "arctangent2":
        known[op] = args[1].low > 0.0
    return known.get(op, False)


@dataclass(frozen=True, eq=False)
class _Backward:
    rounding: Rounding

    def operand(self, node: Node, k: int, z: Lifted, args: list[Lifted]) -> Lifted | None:
        """Return what the result of an operation says of its operand k, or nothing."""
        if composes(node.op, args):
            program = composed(node.op)
            return contract(program, {program.outputs[0]: z}, args, self.rounding)[0][k]
        form = _INVERSES.get(node.op)
        return None if form is None else form(self, k, z, args, node.number)

    def do(self, op: str, *args: Lifted, number: int = 0) -> Lifted:
        return combine(op, *args, rounding=self.rounding, number=number)

    def quotient(self, z: Lifted, b: Lifted) -> Lifted:
        """Return a where z = a b: nothing where b and z may both be zero."""
        if b.high <= 0.0 and b.low < 0.0:
            return self.quotient(_negative(z), _negative(b))
        if b.low > 0.0 or b.low < 0.0:
            return self.do("divide", z, b)
        size = Lifted(ca.fmax(b.lower, _SMALL), ca.fmax(b.upper, _SMALL), _SMALL, b.high)
        found = self.do("divide", z, size)
        above, below = z.lower > 0.0, z.upper < 0.0
        lower = ca.if_else(ca.logic_or(b.lower >= _SMALL, above), found.lower, -FAR)
        upper = ca.if_else(ca.logic_or(b.lower >= _SMALL, below), found.upper, FAR)
        return Lifted(lower, upper, found.low if z.low > 0 else -FAR, FAR)

    def monotone(
        self,
        function: Callable[[ca.SX], ca.SX],
        z: Lifted,
        units: float = 2.0 * ULPS,
        falling: bool = False,
    ) -> Lifted:
        """Return what a monotone inverse makes of both ends; `FAR` says nothing."""
        first, second = function(z.lower), function(z.upper)
        if falling:
            first, second = second, first
        lower, upper = self.rounding.down(first, units, True), self.rounding.up(second, units, True)
        below, above = z.low <= -FAR, z.high >= FAR
        if above if falling else below:
            lower = ca.if_else(z.upper < FAR if falling else z.lower > -FAR, lower, -FAR)
        if below if falling else above:
            upper = ca.if_else(z.lower > -FAR if falling else z.upper < FAR, upper, FAR)
        return Lifted(lower, upper)

    def root(self, z: Lifted, least: float, most: float, falling: bool = False) -> Lifted:
        """Take powers of nonnegative ends with an exponent between positive numbers."""
        exponent = 0.5 * least + 0.5 * most
        unknown = (most - least) / (UNIT[self.rounding.precision] * exponent) + 1.0
        units = 2.0 * ULPS + 0.6 * _LARGEST_LOGARITHM * exponent * unknown
        sign = -1.0 if falling else 1.0
        if exponent == 0.5:
            units = 1.0
        return self.monotone(lambda end: end ** (sign * exponent), z, units, falling)

    def power_int(self, k: int, z: Lifted, args: list[Lifted], n: int) -> Lifted:
        if n % 2 == 0:
            return _either(args[0], self.root(z, 1.0 / n, 1.0 / n))
        if z.high <= 0.0 and z.low < 0.0:
            return _negative(self.power_int(k, _negative(z), [_negative(args[0])], n))
        if z.low >= 0.0:
            return self.root(z, 1.0 / n, 1.0 / n)
        units = 2.0 * ULPS + 0.6 * _LARGEST_LOGARITHM / n
        return self.monotone(lambda end: ca.sign(end) * ca.fabs(end) ** (1.0 / n), z, units)

    def power_const(self, k: int, z: Lifted, args: list[Lifted], n: int) -> Lifted | None:
        low, high = sorted((args[1].low, args[1].high), key=abs)
        if k or low * high <= 0.0:
            return None
        found = self.root(_clipped(z, 0.0, FAR), 1.0 / abs(high), 1.0 / abs(low), high < 0.0)
        return replace(found, low=0.0, lower=ca.fmax(found.lower, 0.0))

    def least(self, k: int, z: Lifted, args: list[Lifted], n: int) -> Lifted:
        """Solve z = min(a, b): above z both, at z the one whose other is above."""
        return Lifted(z.lower, ca.if_else(args[1 - k].lower > z.upper, z.upper, FAR), z.low, FAR)

    def most(self, k: int, z: Lifted, args: list[Lifted], n: int) -> Lifted:
        return _negative(self.least(k, _negative(z), [_negative(a) for a in args], n))

    def select(self, k: int, z: Lifted, args: list[Lifted], n: int) -> Lifted | None:
        condition = args[0]
        if k == 0:
            return None
        if condition.low > 0.0 or condition.high <= 0.0:
            return z if (condition.low > 0.0) == (k == 1) else None
        return _where(condition.lower > 0.0 if k == 1 else condition.upper <= 0.0, z)

    def sine(self, k: int, z: Lifted, args: list[Lifted], n: int) -> Lifted | None:
        inside = _inside(args[0], _QUARTER)
        return None if inside is None else _where(inside, self.monotone(ca.asin, z))

    def cosine(self, k: int, z: Lifted, args: list[Lifted], n: int) -> Lifted | None:
        inside = _inside(args[0], _HALF)
        size = self.monotone(ca.acos, z, falling=True)
        return None if inside is None else _where(inside, _either(args[0], size))

    def tangent(self, k: int, z: Lifted, args: list[Lifted], n: int) -> Lifted | None:
        inside = _inside(args[0], _QUARTER)
        return None if inside is None else _where(inside, self.monotone(ca.atan, z))

    def atan(self, k: int, z: Lifted, args: list[Lifted], n: int) -> Lifted:
        found = self.monotone(ca.tan, z)
        if z.low > -_QUARTER and z.high < _QUARTER:
            return found
        lower = ca.if_else(z.lower > -_QUARTER, found.lower, -FAR)
        return Lifted(lower, ca.if_else(z.upper < _QUARTER, found.upper, FAR))


_Form = Callable[[_Backward, int, Lifted, list[Lifted], int], Lifted | None]


def _through(
    inverse: Callable[[ca.SX], ca.SX],
    low: float = -FAR,
    high: float = FAR,
    falling: bool = False,
) -> _Form:
    """Return the form of a monotone operation with values between two numbers."""
    return lambda self, k, z, args, n: self.monotone(
        inverse, _clipped(z, low, high), falling=falling
    )


_INVERSES: Mapping[str, _Form] = {
    "add": lambda self, k, z, args, n: self.do("subtract", z, args[1 - k]),
    "subtract": lambda self, k, z, args, n: (
        self.do("subtract", args[0], z) if k else self.do("add", z, args[1])
    ),
    "negate": lambda self, k, z, args, n: _negative(z),
    "twice": lambda self, k, z, args, n: self.rounding.interval(
        0.5 * z.lower, 0.5 * z.upper, 0.5 * z.low, 0.5 * z.high, 0.0
    ),
    "multiply": lambda self, k, z, args, n: self.quotient(z, args[1 - k]),
    "divide": lambda self, k, z, args, n: (
        self.quotient(args[0], z) if k else self.do("multiply", z, args[1])
    ),
    "power_int": _Backward.power_int,
    "sqrt": lambda self, k, z, args, n: self.do("power_int", _clipped(z, 0.0, FAR), number=2),
    "nonnegative": lambda self, k, z, args, n: _clipped(z, 0.0, FAR),
    "absolute": lambda self, k, z, args, n: _either(args[0], z),
    "minimum": _Backward.least,
    "maximum": _Backward.most,
    "power_const": _Backward.power_const,
    "select": _Backward.select,
    "if_else_zero": _Backward.select,
    "sine": _Backward.sine,
    "cosine": _Backward.cosine,
    "tangent": _Backward.tangent,
    "exp": _through(ca.log),
    "expm1": _through(ca.log1p),
    "log": _through(ca.exp),
    "log1p": _through(ca.expm1),
    "sinh": _through(ca.asinh),
    "cosh": lambda self, k, z, args, n: _either(args[0], self.monotone(ca.acosh, z)),
    "tanh": _through(ca.atanh),
    "asinh": _through(ca.sinh),
    "acosh": _through(ca.cosh, 0.0),
    "atanh": _through(ca.tanh),
    "asin": _through(ca.sin, -_QUARTER, _QUARTER),
    "acos": _through(ca.cos, 0.0, _HALF, falling=True),
    "atan": _Backward.atan,
}
