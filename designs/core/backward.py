"""Contraction of a box by what is known of nodes of a program: forward, then backward (HC4-revise).

Every operation is enclosed over the box (`lifted`), met with what is known of it, and solved for
each of its operands in reverse order. No point of the box whose nodes lie in what is told is lost,
in floating point: cuts are rounded outwards, and an end that is not a number, infinite or `FAR`
cuts nothing. Where an operation has no unique inverse its operands are left alone, and one that may
be undefined is inverted only if a told node needs its value: below a choice it may not be taken.

With v = (x, f, rest) of the instant before and v' of this one: docs/step.md, The contractor, 6.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce

import casadi as ca
import numpy as np

from obsynth.derive.intervals.functions import ULPS
from obsynth.derive.intervals.graph import Node
from obsynth.derive.intervals.program import Program
from obsynth.derive.intervals.rules import PARTIAL, RULES
from obsynth.derive.rigour.interval import UNIT
from obsynth.designs.core.boxes import FAR, Ends, Lifted, Rounding
from obsynth.designs.core.contractor import SWEEPS, Contractor
from obsynth.designs.core.equations import Before
from obsynth.designs.core.lifted import combine, is_point, lift, needed
from obsynth.symbolic.arrays import FloatArray

_HALF, _PI = 0.5 * np.pi, np.pi  # below what they stand for
_UNITS = 2.0 * ULPS
_LOGARITHM = 745.0  # of any double, in size
_Map = Callable[[ca.SX], ca.SX]
_OPEN = {"select": (1, 2), "if_else_zero": (1,), "meet": (0, 1)}
_PAIRS = (("exp", ca.log), ("expm1", ca.log1p), ("log", ca.exp), ("log1p", ca.expm1))
_HYPERBOLIC = (("sinh", ca.asinh), ("asinh", ca.sinh), ("tanh", ca.atanh), ("atanh", ca.tanh))
_OWN = ("power_int", "power_const", "select", "cosine", "atan")


def contract(
    program: Program, told: Mapping[int, Lifted], variables: Sequence[Lifted], rounding: Rounding
) -> tuple[list[Lifted], ca.SX]:
    """Return the variables cut by intervals of nodes, and 1 where something told is empty."""
    nodes = needed(program, list(told))
    found = dict(zip(nodes, lift(program, nodes, variables, rounding), strict=True))
    found |= {index: _meet(found[index], known, rounding) for index, known in told.items()}
    loose: set[int] = set()  # what does not depend on known numbers alone
    for index in nodes:
        node = program.nodes[index]
        if not is_point(variables[node.number]) if node.op == "input" else loose & {*node.args}:
            loose.add(index)
    cut, sure, backward = set(told), set(told), _Backward(rounding)
    for index in reversed(nodes):
        node = program.nodes[index]
        for k, operand in enumerate(node.args):
            if index in sure and k not in _OPEN.get(node.op, ()):
                sure.add(operand)
            args = [found[a] for a in node.args]
            if index in cut and operand in loose and (index in sure or _defined(node, args)):
                value = backward.operand(node, k, found[index], args)
                if value is not None:
                    found[operand] = _meet(found[operand], value, rounding)
                    cut.add(operand)
    inputs = {program.nodes[k].number: k for k in cut if program.nodes[k].op == "input"}
    seen = [found[k] for k in sorted({*told, *inputs.values()})]
    empty = reduce(ca.logic_or, [a.lower > a.upper for a in seen], ca.SX(0))
    return [found[inputs[j]] if j in inputs else v for j, v in enumerate(variables)], empty


def composed(op: str, args: Sequence[Lifted]) -> Program | None:
    """Return an operation of two operands as others that have its values between the numbers."""
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    if op == "power" and args[0].low > 0.0:
        form = ca.exp(b * ca.log(a))
    elif op == "arctangent2" and args[1].low > 0.0:
        form = ca.atan(a / b)
    elif op == "hypotenuse":
        form = ca.sqrt(a * a + b * b)
    else:
        return None
    return Program.from_casadi(ca.Function(op, [a, b], [form]))


def _defined(node: Node, args: list[Lifted]) -> bool:
    """Whether an operation is defined all over the numbers of its operands."""
    if node.op not in PARTIAL or node.op == "divide":
        return node.op != "divide" or args[1].low > 0.0 or args[1].high < 0.0
    with np.errstate(all="ignore"):
        ends = RULES[node.op](*((np.array([a.low]), np.array([a.high])) for a in args))
    return not np.isnan(ends).any()


def _meet(a: Lifted, b: Lifted, rounding: Rounding) -> Lifted:
    """Cut an interval; its numbers change only where they gain a sign."""
    lower, upper = ca.fmax(a.lower, b.lower), ca.fmin(a.upper, b.upper)
    low, high = a.low, a.high
    if low <= 0.0 <= b.low != low:
        low, lower = b.low, ca.fmax(lower, rounding.around(b.low, b.low)[0])
    if high >= 0.0 >= b.high != high:
        high, upper = b.high, ca.fmin(upper, rounding.around(b.high, b.high)[1])
    return Lifted(lower, upper, low, high)


def _clipped(a: Lifted, low: float, high: float) -> Lifted:
    """Keep the part of an interval between numbers between which the value is known to lie."""
    lower = ca.fmax(a.lower, low) if a.low < low else a.lower
    upper = ca.fmin(a.upper, high) if a.high > high else a.upper
    return Lifted(lower, upper, max(a.low, low), min(a.high, high))


def _negative(a: Lifted) -> Lifted:
    return Lifted(-a.upper, -a.lower, -a.high, -a.low)


def _unless(condition: ca.SX) -> ca.SX:
    """Return what takes a bound away unless a condition holds."""
    return ca.if_else(ca.logic_not(condition), np.inf, 0.0)


def _where(condition: ca.SX, a: Lifted) -> Lifted:
    """Keep a cut where a condition holds."""
    slack = _unless(condition)
    return Lifted(a.lower - slack, a.upper + slack)


def _inside(a: Lifted, limit: float) -> ca.SX:
    """Whether an interval is between -limit and limit; 1 where its numbers say so."""
    if a.low >= -limit and a.high <= limit:
        return ca.SX(1)
    return ca.logic_and(a.lower >= -limit, a.upper <= limit)


def _either(a: Lifted, size: Lifted) -> Lifted:
    """Return where a number is whose absolute value is known, by the side on which it is known."""
    if a.low >= 0.0 or a.high <= 0.0:
        return size if a.low >= 0.0 else _negative(size)
    lower = ca.if_else(a.lower > -size.lower, size.lower, -size.upper)
    return Lifted(lower, ca.if_else(a.upper < size.lower, -size.lower, size.upper))


@dataclass(frozen=True, eq=False)
class _Backward:
    rounding: Rounding

    def operand(self, node: Node, k: int, z: Lifted, args: list[Lifted]) -> Lifted | None:
        """Return what the result of an operation says of its operand k, or nothing."""
        program, form = composed(node.op, args), _INVERSES.get(node.op)
        if program is not None:
            return contract(program, {program.outputs[0]: z}, args, self.rounding)[0][k]
        return None if form is None else form(self, k, z, args, node.number)

    def within(self, a: Lifted, limit: float) -> ca.SX:
        """Whether an interval is between -limit and limit, which is rounded."""
        return _inside(a, limit * (1.0 - self.rounding.step))

    def do(self, op: str, *args: Lifted, number: int = 0) -> Lifted:
        return combine(op, *args, rounding=self.rounding, number=number)

    def quotient(self, z: Lifted, b: Lifted) -> Lifted:
        """Return a where z = a b: nothing where b and z may both be zero."""
        if b.high <= 0.0 and b.low < 0.0:
            return self.quotient(_negative(z), _negative(b))
        if b.low != 0.0:
            return self.do("divide", z, b)
        least = self.rounding.tiny
        size = Lifted(ca.fmax(b.lower, least), ca.fmax(b.upper, least), least, b.high)
        found, apart = self.do("divide", z, size), b.lower >= least
        lower = found.lower - _unless(ca.logic_or(apart, z.lower > 0.0))
        return Lifted(lower, found.upper + _unless(ca.logic_or(apart, z.upper < 0.0)))

    def monotone(self, function: _Map, z: Lifted, units: float = _UNITS, sign: int = 1) -> Lifted:
        """Return what an inverse makes of both ends; it falls if the sign is -1."""
        lower, upper, far = z.lower, z.upper, self.rounding.limits.far
        lower = lower - ca.if_else(lower <= -far, np.inf, 0.0) if z.low <= -FAR else lower
        upper = upper + ca.if_else(upper >= far, np.inf, 0.0) if z.high >= FAR else upper
        ends = [function(lower), function(upper)][::sign]
        return self.rounding.interval(ends[0], ends[1], -FAR, FAR, units)

    def root(self, z: Lifted, least: float, most: float, sign: int = 1) -> Lifted:
        """Take powers of ends, signs kept; the size of the exponent is between positive numbers."""
        exponent = 0.5 * least + 0.5 * most
        unknown = (most - least) / (UNIT[self.rounding.precision] * exponent) + 1.0
        units = _UNITS + 0.6 * _LOGARITHM * exponent * unknown if exponent != 0.5 else 1.0

        def power(end: ca.SX) -> ca.SX:
            size = (ca.fabs(end) if z.low < 0.0 else end) ** (sign * exponent)
            return ca.sign(end) * size if z.low < 0.0 else size

        return self.monotone(power, z, units, sign)

    def power_int(self, k: int, z: Lifted, args: list[Lifted], n: int) -> Lifted:
        found = self.root(z, 1.0 / n, 1.0 / n)
        return found if n % 2 else _either(args[0], found)

    def power_const(self, k: int, z: Lifted, args: list[Lifted], n: int) -> Lifted | None:
        low, high = sorted((args[1].low, args[1].high), key=abs)
        if k or low * high <= 0.0:
            return None
        sign = 1 if low > 0.0 else -1
        return self.root(_clipped(z, 0.0, FAR), 1.0 / abs(high), 1.0 / abs(low), sign)

    def least(self, k: int, z: Lifted, args: list[Lifted], n: int) -> Lifted:
        """Solve z = min(a, b): above z both, at z the one whose other is above."""
        return Lifted(z.lower, z.upper + _unless(args[1 - k].lower > z.upper), z.low)

    def most(self, k: int, z: Lifted, args: list[Lifted], n: int) -> Lifted:
        return _negative(self.least(k, _negative(z), [_negative(a) for a in args], n))

    def select(self, k: int, z: Lifted, args: list[Lifted], n: int) -> Lifted | None:
        c = args[0]
        if k == 0 or c.low > 0.0 or c.high <= 0.0:
            return z if k == (1 if c.low > 0.0 else 2) else None
        return _where(c.lower > 0.0 if k == 1 else c.upper <= 0.0, z)

    def cosine(self, k: int, z: Lifted, args: list[Lifted], n: int) -> Lifted:
        size = self.monotone(ca.acos, z, sign=-1)
        return _where(self.within(args[0], _PI), _either(args[0], size))

    def atan(self, k: int, z: Lifted, args: list[Lifted], n: int) -> Lifted:
        return _where(self.within(z, _HALF), self.monotone(ca.tan, z))


_Form = Callable[[_Backward, int, Lifted, list[Lifted], int], Lifted | None]


def _through(inverse: _Map, low: float = -FAR, high: float = FAR, sign: int = 1) -> _Form:
    """Return the form of a monotone operation with values between two numbers."""
    return lambda self, k, z, *_: self.monotone(inverse, _clipped(z, low, high), sign=sign)


def _branch(inverse: _Map) -> _Form:
    """Return the form of a circular function that increases up to a quarter of a period."""
    return lambda self, k, z, args, n: _where(
        self.within(args[0], _HALF), self.monotone(inverse, z)
    )


_INVERSES: Mapping[str, _Form] = {
    "add": lambda self, k, z, args, n: self.do("subtract", z, args[1 - k]),
    "subtract": lambda self, k, z, args, n: (
        self.do("subtract", args[0], z) if k else self.do("add", z, args[1])
    ),
    "negate": lambda self, k, z, args, n: _negative(z),
    "twice": lambda self, k, z, args, n: self.monotone(lambda end: 0.5 * end, z, 0.0),
    "multiply": lambda self, k, z, args, n: self.quotient(z, args[1 - k]),
    "divide": lambda self, k, z, args, n: (
        self.quotient(args[0], z) if k else self.do("multiply", z, args[1])
    ),
    "sqrt": lambda self, k, z, args, n: self.do("power_int", _clipped(z, 0.0, FAR), number=2),
    "nonnegative": lambda self, k, z, args, n: _clipped(z, 0.0, FAR),
    "absolute": lambda self, k, z, args, n: _either(args[0], z),
    "cosh": lambda self, k, z, args, n: _either(args[0], self.monotone(ca.acosh, z)),
    "minimum": _Backward.least,
    "maximum": _Backward.most,
    "if_else_zero": _Backward.select,
    "acosh": _through(ca.cosh, 0.0),
    "asin": _through(ca.sin, -_HALF, _HALF),
    "acos": _through(ca.cos, 0.0, _PI, -1),
    "sine": _branch(ca.asin),
    "tangent": _branch(ca.atan),
    **{op: getattr(_Backward, op) for op in _OWN},
    **{op: _through(inverse) for op, inverse in _PAIRS + _HYPERBOLIC},
}


@dataclass(frozen=True, eq=False)
class Pair:
    """Boxes of the instant before and of this one; empty: 1 where the readings contradict them."""

    before: Before
    now: Before
    empty: ca.SX


class Sweeps:
    """What the equations say in both directions, by rows, ranges and rates of a contractor."""

    def __init__(self, contractor: Contractor) -> None:
        self.contractor = contractor
        self.equations = contractor.equations
        self.rounding = contractor.rounding
        self.n, self.n_f = self.equations.n, self.equations.n_f

    @cached_property
    def declared(self) -> FloatArray:
        """Ranges of the rest, (n_rest, 2)."""
        return self.equations.box[self.n + self.n_f :]

    @cached_property
    def constant(self) -> list[int]:
        """Places of the parameters in the rest that do not change."""
        plant = self.contractor.plant
        start = len(plant.d) + len(plant.w)
        return [start + k for k, s in enumerate(plant.p) if s.constant]

    @cached_property
    def carried(self) -> list[int]:
        """Places in the rest of what is remembered."""
        first = self.n + self.n_f
        in_rows = {j for _, j in self.equations.entries}
        both = {j - first for j in in_rows & self.equations.shown if j >= first}
        return sorted(both | set(self.constant))

    def rest(self, lower: ca.SX, upper: ca.SX) -> Ends:
        """Return the rest of the instant before: what was remembered, ranges of all else."""
        found = Ends.of(self.declared, self.contractor.precision)
        low, high = ca.SX(found.lower), ca.SX(found.upper)
        for k, j in enumerate(self.carried):
            low[j], high[j] = lower[k], upper[k]
        return Ends(low, high)

    def kept(self, rest: Ends) -> Ends:
        """Return what is remembered of the rest."""
        lower, upper = ([end[j] for j in self.carried] for end in (rest.lower, rest.upper))
        return Ends(ca.vertcat(ca.SX(0, 1), *lower), ca.vertcat(ca.SX(0, 1), *upper))

    def run(
        self, before: Before, now: Before, have: ca.SX, y: ca.SX, used: Sequence[ca.SX]
    ) -> Pair:
        """Cut the boxes of two instants with equations and readings; have: 1 if there were two."""
        now = replace(now, rest=self._still(before, now))
        empty = ca.SX(0)
        for _ in range(SWEEPS):
            now, wrong = self._shown(now, y, used)
            back, against = self._moved(before, now)
            before = back.where(have, before)
            empty = ca.logic_or(empty, ca.logic_or(wrong, ca.logic_and(have, against)))
            image = now.states
            if "image" in self.contractor.cuts:
                image = image.meet(self.contractor.image(before)).where(have, image)
            faults = now.faults.meet(self.contractor.drift(before.faults)).where(have, now.faults)
            now = Before(image, faults, now.known, self._still(before, now))
        return Pair(before, now, empty)

    def _still(self, before: Before, now: Before) -> Ends:
        """Return the rest of this instant, parameters cut with what is remembered of them."""
        low, high = ca.SX(now.rest.lower), ca.SX(now.rest.upper)
        met = now.rest.meet(before.rest)
        for j in self.constant:
            low[j], high[j] = met.lower[j], met.upper[j]
        return Ends(low, high)

    def _shown(self, now: Before, y: ca.SX, used: Sequence[ca.SX]) -> tuple[Before, ca.SX]:
        """Cut with the readings."""
        program = self.equations.outputs
        told, far = {}, self.rounding.limits.far
        for i, node in enumerate(program.outputs):
            if node not in program.constants:
                low, high = ca.if_else(used[i], y[i], -far), ca.if_else(used[i], y[i], far)
                told[node] = Lifted(low, high)
        variables = self.equations.variables(now)
        found, empty = contract(program, told, variables, self.rounding)
        return self._read(found, now), empty

    def _moved(self, before: Before, now: Before) -> tuple[Before, ca.SX]:
        """Cut the instant before with where the states are now, and its faults with theirs."""
        program = self.equations.program
        told = {}
        for i in range(self.n):
            node = program.outputs[i]
            if self.equations.small[i] and node not in program.constants:
                told[node] = Lifted(now.states.lower[i], now.states.upper[i])
        variables = self.equations.variables(before)
        found, empty = contract(program, told, variables, self.rounding)
        cut = self._read(found, before)
        return replace(cut, faults=cut.faults.meet(self.contractor.drift(now.faults))), empty

    def _read(self, variables: Sequence[Lifted], given: Before) -> Before:
        """Take variables apart into states, faults and rest."""
        lower = ca.vertcat(*(v.lower for v in variables))
        upper = ca.vertcat(*(v.upper for v in variables))
        n, n_f, n_v = self.n, self.n_f, self.equations.n_v
        parts = [Ends(lower[a:b], upper[a:b]) for a, b in ((0, n), (n, n + n_f), (n + n_f, n_v))]
        return Before(parts[0], parts[1], given.known, parts[2])
