"""Affine enclosures of the nodes of a program over a box, in code.

A node is ``sum_j slopes[j] v_j + centre + err`` with ``|err| <= error`` for all v in the box. Sums
are exact, a product is ``ac b + bc a - ac bc +- ra rb`` with middles and radii of its factors, a
function g of one variable on [l, h] its chord of slope m, between

    g(l) - m l - max(g'', 0) (h - l)^2 / 8    and    g(l) - m l + max(-g'', 0) (h - l)^2 / 8,

g'' enclosed over [l, h]; square and root have their exact remainders, the absolute value the secant
through its ends, and minimum, maximum and a choice that is open weigh their operands. Whatever has
no such form, and a chord that is worse, is its interval: slope zero. Slopes are the numbers of the
code: what they, the centre and the error itself lose by rounding is in the error, every slope's
part times the size of its variable.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property

import casadi as ca
import numpy as np

from obsynth.derive.intervals.functions import ULPS
from obsynth.derive.intervals.graph import Node
from obsynth.derive.intervals.program import Program
from obsynth.derive.intervals.rules import PARTIAL
from obsynth.designs.core.backward import composed, composes
from obsynth.designs.core.lifted import (
    FAR,
    Lifted,
    Rounding,
    clamped,
    combine,
    is_point,
    lift,
    needed,
)

_LIMIT = 1e50
"""Errors from which on a form says nothing."""


@dataclass(frozen=True, eq=False)
class Affine:
    """An affine enclosure: slopes by variable, centre and the largest error; `FAR` says nothing."""

    slopes: dict[int, ca.SX]
    centre: ca.SX
    error: ca.SX


_Term = tuple[Lifted, Affine]


def relax(
    program: Program, nodes: Sequence[int], variables: Sequence[Lifted], rounding: Rounding
) -> list[Affine]:
    """Return affine enclosures of nodes over a box; variables that are points are in the centre."""
    relaxation = _Relaxation(rounding, variables)
    start = [
        relaxation.flat(v) if is_point(v) else Affine({j: ca.SX(1)}, ca.SX(0), ca.SX(0))
        for j, v in enumerate(variables)
    ]
    given = list(zip(variables, start, strict=True))
    return [_known(a) for _, a in relaxation.walk(program, nodes, given)]


def _known(a: Affine) -> Affine:
    """Say `FAR` where the error has no bound or is not a number."""
    if ca.SX(a.error).is_zero():
        return a
    known = a.error < _LIMIT
    slopes = {j: ca.if_else(known, s, 0.0) for j, s in a.slopes.items()}
    return Affine(slopes, ca.if_else(known, a.centre, 0.0), ca.if_else(known, a.error, FAR))


def _scales(weight: ca.SX) -> bool:
    """Whether products with a number are not rounded: powers of two, and zero."""
    return bool(ca.SX(weight).is_constant()) and np.frexp(abs(float(weight)))[0] in (0.0, 0.5)


@cache
def _bend(op: str, n: int) -> Program:
    """Return the second derivative of an operation of a as a program of a, its value z and p."""
    a, z, p = (ca.SX.sym(name) for name in "azp")
    inner, outer = 1 - a * a, 1 + a * a
    forms = {
        **dict.fromkeys(("exp", "sinh", "cosh"), z),
        **dict.fromkeys(("sine", "cosine"), -z),
        "expm1": z + 1,
        "log": -1 / (a * a),
        "log1p": -1 / ((1 + a) * (1 + a)),
        "tanh": -2 * z * (1 - z * z),
        "asinh": -a / (outer * ca.sqrt(outer)),
        "acosh": -a / ((a * a - 1) * ca.sqrt(a * a - 1)),
        "atanh": 2 * a / (inner * inner),
        "asin": a / (inner * ca.sqrt(inner)),
        "acos": -a / (inner * ca.sqrt(inner)),
        "atan": -2 * a / (outer * outer),
        "erf": -4 / np.sqrt(np.pi) * a * ca.exp(-a * a),
        "tangent": 2 * z * (1 + z * z),
        "inverse": 2 * z**3,
        "power_int": n * (n - 1) * a ** (n - 2),
        "power_const": p * (p - 1) * z / (a * a),
    }
    return Program.from_casadi(ca.Function(op, [a, z, p], [forms[op]]))


_BENT = """exp expm1 log log1p sinh cosh tanh asinh acosh atanh asin acos atan erf sine cosine
tangent power_int power_const"""
_VALUES: Mapping[str, Callable[[ca.SX], ca.SX]] = {
    "cosh": ca.cosh,
    "acos": ca.acos,
    "sine": ca.sin,
    "cosine": ca.cos,
    "inverse": lambda a: 1.0 / a,
}


@dataclass(frozen=True, eq=False)
class _Relaxation:
    rounding: Rounding
    variables: Sequence[Lifted]
    _middles: dict[Lifted, tuple[ca.SX, ca.SX]] = field(default_factory=dict)
    _sizes: dict[int, ca.SX] = field(default_factory=dict)

    def walk(self, program: Program, nodes: Sequence[int], given: Sequence[_Term]) -> list[_Term]:
        """Return nodes with their intervals, for variables with theirs."""
        order = needed(program, nodes)
        ends = lift(program, order, [interval for interval, _ in given], self.rounding)
        found: dict[int, _Term] = {}
        for index, z in zip(order, ends, strict=True):
            node = program.nodes[index]
            if node.op == "input":
                found[index] = given[node.number]
                continue
            args = [] if index in program.constants else [found[a] for a in node.args]
            form = None
            if any(a.slopes for _, a in args):
                form = self.operation(node, z, args)
            found[index] = z, self.flat(z) if form is None else form
        return [found[index] for index in nodes]

    def operation(self, node: Node, z: Lifted, args: list[_Term]) -> Affine | None:
        """Return one operation on affine forms, None where it has no form."""
        ends = [interval for interval, _ in args]
        if composes(node.op, ends):
            program = composed(node.op)
            return self.walk(program, program.outputs, args)[0][1]
        if node.op in _LINEAR:
            weights = [ca.SX(w) for w in _LINEAR[node.op]]
            return self.sum(zip(weights, (a for _, a in args), strict=True))
        if node.op == "power_int" and node.number == 2:
            return self.square(z, args[0])
        if node.op in _BENT.split():
            return self.chord(node, z, args)
        form = _FORMS.get(node.op)
        return None if form is None else form(self, z, args)

    def do(self, op: str, *args: Lifted) -> Lifted:
        return combine(op, *args, rounding=self.rounding)

    # -- sums, and what rounding takes ---------------------------------------------------------

    def middle(self, z: Lifted) -> tuple[ca.SX, ca.SX]:
        """Return a number near the middle, and a radius around it that holds the interval."""
        if is_point(z):
            return z.lower, ca.SX(0)
        if z not in self._middles:
            middle = 0.5 * (z.lower + z.upper)
            radius = ca.fmax(z.upper - middle, middle - z.lower)
            self._middles[z] = middle, (1.0 + 2.0 * self.rounding.step) * radius
        return self._middles[z]

    def flat(self, z: Lifted) -> Affine:
        """Return an interval as a form without slopes."""
        return Affine({}, *self.middle(z))

    def size(self, j: int) -> ca.SX:
        if j not in self._sizes:
            self._sizes[j] = self.variables[j].magnitude
        return self._sizes[j]

    @cached_property
    def underflow(self) -> ca.SX:
        """What the underflow of some products takes, slopes times their variables."""
        sizes = [self.size(j) for j, v in enumerate(self.variables) if not is_point(v)]
        return (16.0 * self.rounding.tiny) * sum(sizes, ca.SX(1))

    def total(self, errors: Sequence[ca.SX], lost: Sequence[ca.SX]) -> ca.SX:
        """Add errors, and two roundings of each of some numbers, upwards."""
        errors = [e for e in errors if not ca.SX(e).is_zero()]
        lost = [e for e in lost if not ca.SX(e).is_zero()]
        if lost:
            errors.append((2.0 * self.rounding.step) * sum(lost, ca.SX(0)))
        total = sum(errors, ca.SX(0))
        if not lost and len(errors) < 2:
            return total
        return (1.0 + (len(errors) + 6) * self.rounding.step) * total

    def sum(
        self,
        terms: "Sequence[tuple[ca.SX, Affine]] | zip[tuple[ca.SX, Affine]]",
        centre: ca.SX | float = 0.0,
        errors: Sequence[ca.SX] = (),
        lost: Sequence[ca.SX] = (),
    ) -> Affine:
        """Return weights times forms plus a number."""
        parts: dict[int | None, list[tuple[ca.SX, bool]]] = {None: []}
        errors, lost, small = list(errors), list(lost), False
        for weight, a in terms:
            whole = _scales(weight) and abs(float(weight)) >= 1.0
            for j, value in [(None, a.centre), *a.slopes.items()]:
                exact = _scales(weight) or _scales(value)
                small = small or not (whole or (exact and ca.SX(value).is_constant()))
                parts.setdefault(j, []).append((weight * value, exact))
            small = small or not (whole or ca.SX(a.error).is_zero())
            errors.append(ca.fabs(weight) * a.error)
        parts[None].append((ca.SX(centre), True))
        sums: dict[int | None, ca.SX] = {}
        for j, values in parts.items():
            values = [v for v in values if not v[0].is_zero()]
            sums[j] = sum((v for v, _ in values), ca.SX(0))
            sizes = [ca.fabs(v) for v, exact in values if not exact or len(values) > 2]
            if len(values) == 2 and len(sizes) < 2:
                sizes.append(ca.fabs(sums[j]))
            size = sum(sizes, ca.SX(0))
            lost.append(size if j is None else size * self.size(j))
        if small:
            errors.append(self.underflow)
        middle = sums.pop(None)
        slopes = {j: slope for j, slope in sums.items() if j is not None}
        return Affine(slopes, middle, self.total(errors, lost))

    # -- operations ------------------------------------------------------------------------------

    def line(
        self, z: Lifted, a: Affine, slope: ca.SX, rest: ca.SX, error: ca.SX, trusted: ca.SX | None
    ) -> Affine:
        """Return slope a + rest +- error where that is narrower than the interval of the result."""
        middle, radius = self.middle(z)
        better = error < radius
        if trusted is not None:
            better = ca.logic_and(better, trusted)
        slope, rest = ca.if_else(better, slope, 0.0), ca.if_else(better, rest, middle)
        return self.sum([(slope, a)], rest, [ca.if_else(better, error, radius)])

    def chord(self, node: Node, z: Lifted, args: list[_Term]) -> Affine | None:
        """Return the chord of a function of one variable, on numbers all over its domain."""
        (a, form), exponent = args[0], args[-1][0]
        if not form.slopes:
            return None
        a = clamped(a) if node.op in PARTIAL else a
        units = 2.0 * ULPS
        if node.op in _VALUES:
            left, right = map(_VALUES[node.op], (a.lower, a.upper))
        elif node.op == "power_int":
            left, right = a.lower**node.number, a.upper**node.number
        elif node.op == "power_const":
            if exponent.low != exponent.high:
                return None
            left, right = a.lower**exponent.low, a.upper**exponent.low
        else:
            left, right, units = z.lower, z.upper, 2.0 * units
        return self.bent(node, z, a, form, (left, right), units, exponent, None)

    def bent(
        self,
        node: Node,
        z: Lifted,
        a: Lifted,
        form: Affine,
        ends: tuple[ca.SX, ca.SX],
        units: float,
        exponent: Lifted,
        trusted: ca.SX | None,
    ) -> Affine | None:
        """Return a chord between values at both ends that are good to some units."""
        program = _bend(node.op, node.number)
        (bend,) = lift(program, program.outputs, [a, z, exponent], self.rounding)
        if not (bend.low > -FAR or bend.high < FAR) and ca.SX(bend.lower).is_constant():
            return None
        width = a.upper - a.lower
        slope = (ends[1] - ends[0]) / width
        eighth = 0.125 * width * width
        above = ca.SX(0) if bend.low >= 0.0 else ca.fmax(-bend.lower, 0.0) * eighth
        below = ca.SX(0) if bend.high <= 0.0 else ca.fmax(bend.upper, 0.0) * eighth
        start = slope * a.lower
        rest = (ends[0] - start) + 0.5 * (above - below)
        # both values and the line through them; what underflows makes no slope
        known = (units + 4.0) * (ca.fabs(ends[0]) + ca.fabs(ends[1]))
        small = self.rounding.tiny * (16.0 + width)
        error = self.total([0.5 * above, 0.5 * below, small], [known, 2.0 * ca.fabs(start)])
        return self.line(z, form, slope, rest, error, trusted)

    def square(self, z: Lifted, arg: _Term) -> Affine:
        (a, form), slope = arg, arg[0].lower + arg[0].upper
        rest = -0.5 * (0.25 * slope * slope + a.lower * a.upper)
        width = a.upper - a.lower
        error = self.total(
            [0.125 * width * width, ca.SX(16.0 * self.rounding.tiny)], [4.0 * z.upper]
        )
        return self.sum([(slope, form)], rest, [error])

    def sqrt(self, z: Lifted, args: list[_Term]) -> Affine | None:
        if ca.SX(z.lower).is_constant() and ca.SX(z.upper).is_constant():
            return None
        both, apart = z.lower + z.upper, z.upper - z.lower
        slope = 1.0 / both
        rest = 0.5 * (z.lower * z.upper * slope + 0.25 * both)
        error = self.total(
            [0.125 * apart * apart * slope, ca.SX(16.0 * self.rounding.tiny)], [8.0 * both]
        )
        return self.line(z, args[0][1], slope, rest, error, None)

    def secant(self, a: Lifted, z: Lifted) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Return slope, rest and error of |a|, its interval z; the slope between -1 and 1."""
        low, high = ca.fabs(a.lower), ca.fabs(a.upper)
        slope = ca.fmin(ca.fmax((high - low) / (a.upper - a.lower), -1.0), 1.0)
        most = 0.5 * ca.fmax(low - slope * a.lower, high - slope * a.upper)
        rest = ca.fmax(most, 0.0)
        small = ca.SX(16.0 * self.rounding.tiny)
        return slope, rest, self.total([rest, small], [4.0 * z.upper])

    def absolute(self, z: Lifted, args: list[_Term]) -> Affine:
        a, form = args[0]
        if a.low >= 0.0 or a.high <= 0.0:
            return self.sum([(ca.SX(1 if a.low >= 0.0 else -1), form)])
        return self.line(z, form, *self.secant(a, z), None)

    def extreme(self, sign: float, args: list[_Term]) -> Affine:
        """Return the larger (1) or smaller (-1) of two: half their sum +- half their distance."""
        (a, first), (b, second) = args
        if a.low >= b.high or a.high <= b.low:
            return first if (a.low >= b.high) == (sign > 0.0) else second
        apart = self.do("subtract", a, b)
        slope, rest, error = self.secant(apart, self.do("absolute", apart))
        share = 0.5 + (0.5 * sign) * slope
        lost = [a.magnitude + b.magnitude]
        terms = [(share, first), (1.0 - share, second)]
        return self.sum(terms, (0.5 * sign) * rest, [0.5 * error], lost)

    def select(self, z: Lifted, args: list[_Term]) -> Affine:
        """Return the branch that is taken, and while that is open the mean of both."""
        condition = args[0][0]
        (a, first), (b, second) = args[1], args[2]
        if condition.low > 0.0 or condition.high <= 0.0:
            return first if condition.low > 0.0 else second
        sure, possible = condition.lower > 0.0, condition.upper > 0.0
        share = 0.5 * sure + 0.5 * possible
        apart = self.do("subtract", a, b).magnitude
        open_ = ca.if_else(ca.logic_and(possible, ca.logic_not(sure)), 0.5 * apart, 0.0)
        return self.sum([(share, first), (1.0 - share, second)], 0.0, [open_])

    def product(self, args: list[_Term]) -> Affine:
        (a, first), (b, second) = args
        if not first.slopes:
            (a, first), (b, second) = args[::-1]
        if not second.slopes:
            return self.sum([(second.centre, first)], 0.0, [second.error * a.magnitude])
        (ac, ar), (bc, br) = self.middle(a), self.middle(b)
        both = ac * bc
        return self.sum([(bc, first), (ac, second)], -both, [ar * br], [ca.fabs(both)])

    def divide(self, z: Lifted, args: list[_Term]) -> Affine | None:
        """Multiply with the reciprocal."""
        one, (b, form) = Lifted.number(1.0), args[1]
        if b.low == 0.0 == b.high:
            return None
        r = self.do("divide", one, b)
        inverse: Affine | None = self.flat(r)
        if form.slopes:
            b = clamped(b)
            apart = None
            if not (b.low > 0.0 or b.high < 0.0):
                apart = ca.logic_or(b.lower > 0.0, b.upper < 0.0)
            ends = 1.0 / b.lower, 1.0 / b.upper
            inverse = self.bent(Node("inverse"), r, b, form, ends, 1.0, one, apart)
        return None if inverse is None else self.product([args[0], (r, inverse)])


_LINEAR: Mapping[str, tuple[float, ...]] = {
    "add": (1, 1),
    "subtract": (1, -1),
    "negate": (-1,),
    "twice": (2,),
    "nonnegative": (1,),
}
_FORMS: Mapping[str, Callable[[_Relaxation, Lifted, list[_Term]], Affine | None]] = {
    "multiply": lambda self, z, args: self.product(args),
    "divide": _Relaxation.divide,
    "sqrt": _Relaxation.sqrt,
    "absolute": _Relaxation.absolute,
    "minimum": lambda self, z, args: self.extreme(-1.0, args),
    "maximum": lambda self, z, args: self.extreme(1.0, args),
    "select": _Relaxation.select,
    "if_else_zero": lambda self, z, args: self.select(
        z, [*args, (Lifted.number(0.0), Affine({}, ca.SX(0), ca.SX(0)))]
    ),
}
