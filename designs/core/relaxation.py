"""Affine enclosures of the nodes of a program over a box, in code.

A node is ``sum_j slopes[j] v_j + centre + err`` with ``|err| <= error`` for all v in the box, by
the rules of docs/methods/set_membership_observer.md, Step, 2. Whatever has no such form, and a
chord that is worse, is its interval: slope zero. Slopes are the numbers of the code: what they, the
centre and the error itself lose by rounding is in the error.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from obsynth.derive.intervals.functions import ULPS
from obsynth.derive.intervals.program import Program
from obsynth.derive.intervals.rules import PARTIAL
from obsynth.designs.core.backward import composed
from obsynth.designs.core.boxes import Lifted, Rounding
from obsynth.designs.core.lifted import clamped as between
from obsynth.designs.core.lifted import combine, is_point, lift, needed


@dataclass(frozen=True, eq=False)
class Affine:
    """An affine enclosure: slopes by variable, centre and the largest error, `far` for none."""

    slopes: dict[int, ca.SX]
    centre: ca.SX
    error: ca.SX


@dataclass(frozen=True, eq=False)
class _Form(Affine):
    """An affine enclosure on the way: the sum of the sizes of its terms, `depth` times rounded."""

    size: ca.SX
    depth: int = 0


_Term = tuple[Lifted, _Form]
_Weighted = Sequence[tuple[ca.SX, _Form]]
_NONE = ca.SX(0)


def relax(
    program: Program, nodes: Sequence[int], variables: Sequence[Lifted], rounding: Rounding
) -> list[Affine]:
    """Return affine enclosures of nodes over a box; variables that are points are in the centre."""
    variables = [rounding.signal(v) for v in variables]
    sizes = [v.magnitude for v in variables]
    relaxation = _Relaxation(rounding, 16.0 * rounding.tiny * sum(sizes, ca.SX(1)))
    given = [
        (v, relaxation.flat(v) if is_point(v) else _Form({j: ca.SX(1)}, _NONE, _NONE, sizes[j]))
        for j, v in enumerate(variables)
    ]
    return [relaxation.known(a) for _, a in relaxation.walk(program, nodes, given)]


def _whole(value: ca.SX) -> bool:
    """Whether products with a number are not rounded and do not underflow."""
    size = abs(float(value)) if value.is_constant() else 3.0
    return size == 0.0 or (size >= 1.0 and np.frexp(size)[0] == 0.5)


def _bend(op: str, n: int) -> Program | None:
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
    return Program.from_casadi(ca.Function(op, [a, z, p], [forms[op]])) if op in forms else None


@dataclass(frozen=True, eq=False)
class _Relaxation:
    rounding: Rounding
    underflow: ca.SX
    middles: dict[Lifted, tuple[ca.SX, ca.SX]] = field(default_factory=dict)

    def walk(self, program: Program, nodes: Sequence[int], given: Sequence[_Term]) -> list[_Term]:
        """Return nodes with their intervals, for variables with theirs."""
        order = needed(program, nodes)
        ends = lift(program, order, [interval for interval, _ in given], self.rounding)
        found: dict[int, _Term] = {}
        for index, z in zip(order, ends, strict=True):
            node, form = program.nodes[index], None
            args = [found[a] for a in node.args if index not in program.constants]
            if node.op == "input":
                form = given[node.number][1]
            elif any(a.slopes for _, a in args):
                form = self.operation(node.op, node.number, z, args)
            found[index] = z, self.flat(z) if form is None else form
        return [found[index] for index in nodes]

    def operation(self, op: str, number: int, z: Lifted, args: list[_Term]) -> _Form | None:
        """Return one operation on affine forms, None where it has no form."""
        program = composed(op, [interval for interval, _ in args])
        if program is not None:
            return self.walk(program, program.outputs, args)[0][1]
        if op in _LINEAR:
            return self.sum([(ca.SX(w), a) for w, (_, a) in zip(_LINEAR[op], args, strict=True)])
        if op in _FORMS:
            return _FORMS[op](self, z, args)
        a, exponent = (
            between(args[0][0], self.rounding) if op in PARTIAL else args[0][0],
            args[-1][0],
        )
        if op == "power_int" and number == 2:
            return self.square(z, args)
        if not args[0][1].slopes or (op == "power_const" and exponent.low != exponent.high):
            return None
        return self.chord(op, number, z, (a, args[0][1]), exponent)

    def do(self, op: str, *args: Lifted) -> Lifted:
        return combine(op, *args, rounding=self.rounding)

    # -- sums, and what rounding takes ---------------------------------------------------------

    def middle(self, z: Lifted) -> tuple[ca.SX, ca.SX]:
        """Return a number near the middle, and a radius around it that holds the interval."""
        if is_point(z):
            return z.lower, _NONE
        if z not in self.middles:
            middle = 0.5 * (z.lower + z.upper)
            radius = ca.fmax(z.upper - middle, middle - z.lower)
            self.middles[z] = middle, (1.0 + 2.0 * self.rounding.step) * radius
        return self.middles[z]

    def flat(self, z: Lifted) -> _Form:
        """Return an interval as a form without slopes."""
        middle, radius = self.middle(z)
        return _Form({}, middle, radius, ca.fabs(middle))

    def known(self, a: _Form) -> Affine:
        """Add what rounding has taken, and say `Limits.far` where there is no bound or no number.

        A node with weights w of others has lost two roundings of its size T = sum |w_i| T_i + |q|
        and |w_i| times what these have; T holds every slope times its variable, and the centre.
        """
        step = self.rounding.step
        error = (1.0 + (8 + 12 * a.depth) * step) * (a.error + (2.0 * a.depth * step) * a.size)
        error = error if a.depth else a.error
        limits = self.rounding.limits
        known = error < limits.huge
        slopes = {j: ca.if_else(known, s, 0.0) for j, s in a.slopes.items()}
        return Affine(
            slopes, ca.if_else(known, a.centre, 0.0), ca.if_else(known, error, limits.far)
        )

    def total(self, error: ca.SX, lost: ca.SX) -> ca.SX:
        """Add two roundings of some numbers and what underflow takes to an error, upwards."""
        step = self.rounding.step
        return (1.0 + 8.0 * step) * (error + (2.0 * step) * lost + self.underflow)

    def sum(
        self, terms: _Weighted, centre: ca.SX = _NONE, error: ca.SX = _NONE, small: bool = False
    ) -> _Form:
        """Return weights times forms plus a number; it or the error may be products if `small`."""
        sums, size, exact = {-1: centre}, ca.fabs(centre), True
        for weight, a in terms:
            for j, value in [(-1, a.centre), *a.slopes.items()]:
                before = sums.get(j, _NONE)
                exact &= before.is_zero() or value.is_zero()
                small |= not (_whole(weight) or _whole(value))
                sums[j] = before + weight * value
            exact &= error.is_zero() or a.error.is_zero()
            small |= not (_whole(weight) or a.error.is_zero())
            error, size = error + ca.fabs(weight) * a.error, size + ca.fabs(weight) * a.size
        depth = max(a.depth for _, a in terms) + (small or not exact)
        return _Form(sums, sums.pop(-1), error + self.underflow if small else error, size, depth)

    # -- operations ------------------------------------------------------------------------------

    def line(self, z: Lifted, a: _Form, slope: ca.SX, rest: ca.SX, error: ca.SX) -> _Form:
        """Return slope a + rest +- error where that is narrower than the interval of the result."""
        middle, radius = self.middle(z)
        better = error < radius
        slope, rest = ca.if_else(better, slope, 0.0), ca.if_else(better, rest, middle)
        return self.sum([(slope, a)], rest, ca.fmin(error, radius))

    def chord(self, op: str, number: int, z: Lifted, arg: _Term, exponent: Lifted) -> _Form | None:
        """Return the chord of a function of one variable, on numbers all over its domain."""
        (a, form), program, value = arg, _bend(op, number), _VALUES.get(op)
        if program is None or (value is None and z.lower.is_constant()):
            return None
        (bend,) = lift(program, program.outputs, [a, z, exponent], self.rounding)
        left, right, width = z.lower, z.upper, a.upper - a.lower
        if value is not None:
            left, right = (value(end, number, exponent.low) for end in (a.lower, a.upper))
        slope, eighth = (right - left) / width, 0.125 * width * width
        above = _NONE if bend.low >= 0.0 else ca.fmax(-bend.lower, 0.0) * eighth
        below = _NONE if bend.high <= 0.0 else ca.fmax(bend.upper, 0.0) * eighth
        start = slope * a.lower
        rest = (left - start) + 0.5 * (above - below)
        # values at both ends and the line through them; where a slope underflows, all of the width
        lost = (4.0 * ULPS + 4.0) * (ca.fabs(left) + ca.fabs(right)) + 2.0 * ca.fabs(start)
        error = self.total(0.5 * (above + below) + self.rounding.tiny * width, lost)
        return self.line(z, form, slope, rest, error)

    def square(self, z: Lifted, args: list[_Term]) -> _Form:
        (a, form), slope = args[0], args[0][0].lower + args[0][0].upper
        width, rest = a.upper - a.lower, -0.5 * (0.25 * slope * slope + a.lower * a.upper)
        error = self.total(0.125 * width * width, 4.0 * z.upper)
        return self.sum([(slope, form)], rest, error)

    def sqrt(self, z: Lifted, args: list[_Term]) -> _Form:
        both, apart = z.lower + z.upper, z.upper - z.lower
        slope = 1.0 / both
        rest = 0.5 * (z.lower * z.upper * slope + 0.25 * both)
        error = self.total(0.125 * apart * apart * slope, 8.0 * both)
        return self.line(z, args[0][1], slope, rest, error)

    def secant(self, a: Lifted) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Return slope, rest and error of |a|; the slope between -1 and 1."""
        low, high = ca.fabs(a.lower), ca.fabs(a.upper)
        slope = ca.fmin(ca.fmax((high - low) / (a.upper - a.lower), -1.0), 1.0)
        rest = 0.5 * ca.fmax(low - slope * a.lower, 0.0)  # the same at the other end
        return slope, rest, self.total(rest, 4.0 * (low + high))

    def absolute(self, z: Lifted, args: list[_Term]) -> _Form:
        a, form = args[0]
        if a.low >= 0.0 or a.high <= 0.0:
            return self.sum([(ca.SX(1 if a.low >= 0.0 else -1), form)])
        return self.line(z, form, *self.secant(a))

    def extreme(self, sign: float, args: list[_Term]) -> _Form:
        """Return the larger (1) or smaller (-1) of two: half their sum +- half their distance."""
        (a, first), (b, second) = args
        if a.low >= b.high or a.high <= b.low:
            return first if (a.low >= b.high) == (sign > 0.0) else second
        slope, rest, error = self.secant(self.do("subtract", a, b))
        share = 0.5 + (0.5 * sign) * slope
        error = self.total(0.5 * error, a.magnitude + b.magnitude)
        return self.sum([(share, first), (1.0 - share, second)], (0.5 * sign) * rest, error)

    def select(self, args: list[_Term]) -> _Form:
        """Return the branch that is taken, and while that is open the mean of both."""
        condition, (a, first), (b, second) = args[0][0], args[1], args[2]
        if condition.low > 0.0 or condition.high <= 0.0:
            return first if condition.low > 0.0 else second
        true, false = condition.lower > 0.0, condition.upper <= 0.0
        share = 0.5 * true + 0.5 * ca.logic_not(false)
        apart = 0.5 * self.do("subtract", a, b).magnitude
        error = ca.if_else(ca.logic_or(true, false), 0.0, apart)
        return self.sum([(share, first), (1.0 - share, second)], error=error)

    def product(self, args: list[_Term]) -> _Form:
        (a, first), (b, second) = args if args[0][1].slopes else args[::-1]
        (ac, ar), (bc, br) = self.middle(a), self.middle(b)
        if not second.slopes:
            return self.sum([(bc, first)], error=br * a.magnitude, small=not br.is_zero())
        return self.sum([(bc, first), (ac, second)], -ac * bc, ar * br, small=True)

    def divide(self, args: list[_Term]) -> _Form | None:
        """Multiply with the reciprocal."""
        one, (b, form) = Lifted.number(1.0), args[1]
        r = self.do("divide", one, b)
        inverse: _Form | None = self.flat(r)
        if form.slopes:
            inverse = self.chord("inverse", 0, r, (between(b, self.rounding), form), one)
        return None if inverse is None else self.product([args[0], (r, inverse)])


_ZERO = Lifted.number(0.0), _Form({}, _NONE, _NONE, _NONE)
_LINEAR = {"add": (1, 1), "subtract": (1, -1), "negate": (-1,), "twice": (2,), "nonnegative": (1,)}
_FORMS: Mapping[str, Callable[[_Relaxation, Lifted, list[_Term]], _Form | None]] = {
    "multiply": lambda self, z, args: self.product(args),
    "divide": lambda self, z, args: self.divide(args),
    "sqrt": _Relaxation.sqrt,
    "absolute": _Relaxation.absolute,
    "minimum": lambda self, z, args: self.extreme(-1.0, args),
    "maximum": lambda self, z, args: self.extreme(1.0, args),
    "select": lambda self, z, args: self.select(args),
    "if_else_zero": lambda self, z, args: self.select([*args, _ZERO]),
}
_VALUES: Mapping[str, Callable[[ca.SX, int, float], ca.SX]] = {
    "cosh": lambda a, n, p: ca.cosh(a),
    "acos": lambda a, n, p: ca.acos(a),
    "sine": lambda a, n, p: ca.sin(a),
    "cosine": lambda a, n, p: ca.cos(a),
    "inverse": lambda a, n, p: 1.0 / a,
    "power_int": lambda a, n, p: a**n,
    "power_const": lambda a, n, p: a**p,
}
"""Functions that do not increase, or that have no lifted form."""
