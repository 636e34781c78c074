"""The textbook algorithm over python-flint's balls, for comparison with `obsynth.derive`.

One expression at a time, best first: natural extension and mean-value form over the box, facets in
variables in which the expression is monotone, bisection of one variable. Balls are reached in two
ways: through Python code that is generated once per expression (``generated``), or by walking
through the instructions of the CasADi function for every box (``interpreted``). The variable that
is cut is the one that the mean-value form loses most by (``loss``) or, as in textbooks, the one
that is widest relative to its range (``widest``).
"""

from __future__ import annotations

import heapq
import operator
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import flint
import numpy as np

__all__ = ["Expression", "Found", "bound_all", "generated", "interpreted"]

Ball = Any
Box = list[tuple[float, float]]
Evaluator = Callable[[list[Ball]], list[Ball]]

_UNARY = {
    ca.OP_ASSIGN: "{0}",
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0}**2",
    ca.OP_TWICE: "{0}+{0}",
    ca.OP_INV: "one/{0}",
    ca.OP_SIN: "{0}.sin()",
    ca.OP_COS: "{0}.cos()",
    ca.OP_TAN: "{0}.tan()",
    ca.OP_EXP: "{0}.exp()",
    ca.OP_SQRT: "{0}.sqrt()",
    ca.OP_LOG: "{0}.log()",
    ca.OP_ATAN: "{0}.atan()",
    ca.OP_ASIN: "{0}.asin()",
    ca.OP_ACOS: "{0}.acos()",
    ca.OP_SINH: "{0}.sinh()",
    ca.OP_COSH: "{0}.cosh()",
    ca.OP_TANH: "{0}.tanh()",
    ca.OP_FABS: "abs({0})",
    ca.OP_SIGN: "{0}.sgn()",
}
_BINARY = {
    ca.OP_ADD: "{0}+{1}",
    ca.OP_SUB: "{0}-{1}",
    ca.OP_MUL: "{0}*{1}",
    ca.OP_DIV: "{0}/{1}",
    ca.OP_POW: "{0}**{1}",
    ca.OP_CONSTPOW: "{0}**{1}",
    ca.OP_FMIN: "{0}.min({1})",
    ca.OP_FMAX: "{0}.max({1})",
}


def generated(function: ca.Function) -> Evaluator:
    """Translate the instructions of an SX function of one column into Python over balls."""
    lines, constants, results = [], [], {}
    for k in range(function.n_instructions()):
        code = function.instruction_id(k)
        out, args = function.instruction_output(k), function.instruction_input(k)
        if code == ca.OP_CONST:
            lines.append(f"w{out[0]} = c[{len(constants)}]")
            constants.append(flint.arb(function.instruction_constant(k)))
        elif code == ca.OP_INPUT:
            lines.append(f"w{out[0]} = x[{args[1]}]")
        elif code == ca.OP_OUTPUT:
            # a register may be used again for something else
            lines.append(f"r{out[0]}_{out[1]} = w{args[0]}")
            results[(out[0], out[1])] = f"r{out[0]}_{out[1]}"
        else:
            text = _UNARY[code] if code in _UNARY else _BINARY[code]
            lines.append(f"w{out[0]} = " + text.format(*(f"w{a}" for a in args)))
    ordered = ", ".join(results[key] for key in sorted(results))
    body = "\n    ".join([*lines, f"return [{ordered}]"])
    space: dict[str, Any] = {"c": constants, "one": flint.arb(1)}
    exec(f"def run(x):\n    {body}", space)
    run: Evaluator = space["run"]
    return run


def _operation(code: int) -> Callable[..., Ball]:
    operators = {
        ca.OP_ADD: operator.add,
        ca.OP_SUB: operator.sub,
        ca.OP_MUL: operator.mul,
        ca.OP_DIV: operator.truediv,
        ca.OP_NEG: operator.neg,
        ca.OP_FABS: operator.abs,
    }
    if code in operators:
        return operators[code]
    text = _UNARY[code].format("a") if code in _UNARY else _BINARY[code].format("a", "b")
    names = "a" if code in _UNARY else "a, b"
    result: Callable[..., Ball] = eval(f"lambda {names}: {text}", {"one": flint.arb(1)})
    return result


def interpreted(function: ca.Function) -> Evaluator:
    """Make a loop over the instructions of an SX function of one column."""
    tape: list[tuple[int, int, int, int, Any]] = []
    for k in range(function.n_instructions()):
        code = function.instruction_id(k)
        out, args = function.instruction_output(k), function.instruction_input(k)
        if code == ca.OP_CONST:
            tape.append((0, out[0], 0, 0, flint.arb(function.instruction_constant(k))))
        elif code == ca.OP_INPUT:
            tape.append((1, out[0], args[1], 0, None))
        elif code == ca.OP_OUTPUT:
            tape.append((2, function.nnz_out(0) * out[0] + out[1], args[0], 0, None))
        elif len(args) == 1:
            tape.append((3, out[0], args[0], 0, _operation(code)))
        else:
            tape.append((4, out[0], args[0], args[1], _operation(code)))
    registers: list[Ball] = [None] * function.sz_w()
    results: list[Ball] = [None] * function.nnz_out()

    def run(x: list[Ball]) -> list[Ball]:
        for kind, out, a, b, what in tape:
            if kind == 4:
                registers[out] = what(registers[a], registers[b])
            elif kind == 3:
                registers[out] = what(registers[a])
            elif kind == 2:
                results[out] = registers[a]
            elif kind == 1:
                registers[out] = x[a]
            else:
                registers[out] = what
        return list(results)

    return run


class Expression:
    """Value and gradient of a scalar SX expression over balls.

    Parameters
    ----------
    expression : casadi.SX
        Scalar.
    variables : casadi.SX
        Column of symbols.
    make : callable
        ``generated`` or ``interpreted``.
    """

    def __init__(
        self, expression: ca.SX, variables: ca.SX, make: Callable[[ca.Function], Evaluator]
    ) -> None:
        gradient = ca.jacobian(expression, variables)
        self.used = [int(j) for j in gradient.sparsity().get_triplet()[1]]
        slopes = ca.vertcat(*(gradient[0, j] for j in self.used)) if self.used else ca.SX(0, 1)
        self.value = make(ca.Function("f", [variables], [expression]))
        self.both = make(ca.Function("fg", [variables], [expression, slopes]))


@dataclass
class Found:
    """Range of one expression.

    Attributes
    ----------
    lower, upper : float
        Guaranteed bounds.
    gap : float
        Guaranteed width minus attained width.
    finished : bool
        Whether the gap is within the tolerance.
    boxes : int
        Boxes looked at.
    """

    lower: float
    upper: float
    gap: float
    finished: bool
    boxes: int


def _ball(lo: float, hi: float) -> Ball:
    return flint.arb(lo) if lo == hi else flint.arb(lo).union(flint.arb(hi))


def _upper(ball: Ball) -> float:
    """Return a double above a ball."""
    return float(np.nextafter(float(ball.upper()), np.inf))


def _lower(ball: Ball) -> float:
    return float(np.nextafter(float(ball.lower()), -np.inf))


class _Goal:
    """Largest value of an expression (sign 1) or of its negative (sign -1)."""

    def __init__(self, expression: Expression, box: Box, sign: int, cut: str) -> None:
        self.expression, self.sign, self.box, self.cut = expression, sign, box, cut
        self.best, self.boxes, self.order = -np.inf, 0, 0
        self.heap: list[tuple[float, int, Box]] = []
        self.closed = -np.inf

    def try_point(self, point: list[float]) -> Ball:
        value = self.sign * self.expression.value([flint.arb(v) for v in point])[0]
        if value.is_finite():
            self.best = max(self.best, _lower(value))
        return value

    def look(self, box: Box, limit: float) -> None:
        """Bound a box and put it on the heap, with the variable that loses most cut in two."""
        self.boxes += 1
        value, *slopes = self.expression.both([_ball(*pair) for pair in box])
        bound = min(limit, _upper(self.sign * value)) if value.is_finite() else limit
        shrunk = list(box)
        for j, slope in zip(self.expression.used, slopes, strict=True):
            lo, hi = box[j]
            if lo < hi and slope.is_finite():
                if self.sign * slope >= 0:
                    shrunk[j] = (hi, hi)
                elif self.sign * slope <= 0:
                    shrunk[j] = (lo, lo)
        centre = [0.5 * (lo + hi) for lo, hi in shrunk]
        total, loss, widest = self.try_point(centre), -1.0, -1
        for j, slope in zip(self.expression.used, slopes, strict=True):
            lo, hi = shrunk[j]
            if lo < hi:
                term = slope * (_ball(lo, hi) - flint.arb(centre[j]))
                total = total + self.sign * term
                if self.cut == "widest":
                    size = (hi - lo) / (self.box[j][1] - self.box[j][0])
                else:
                    size = float(abs(term).upper()) if term.is_finite() else np.inf
                if size > loss:
                    loss, widest = size, j
        if total.is_finite():
            bound = min(bound, _upper(total))
        if widest < 0:
            self.closed = max(self.closed, bound)
            return
        lo, hi = shrunk[widest]
        middle = 0.5 * (lo + hi)
        for part in ((lo, middle), (middle, hi)):
            child = list(shrunk)
            child[widest] = part
            self.order += 1
            heapq.heappush(self.heap, (-bound, self.order, child))

    def run(self, tolerance: Callable[[], float], deadline: float) -> bool:
        self.look(self.box, np.inf)
        while self.heap and -self.heap[0][0] > self.best + tolerance():
            if time.process_time() > deadline:
                return False
            bound, _, box = heapq.heappop(self.heap)
            self.look(box, -bound)
        return True

    @property
    def bound(self) -> float:
        return max(self.closed, -self.heap[0][0] if self.heap else -np.inf)


def bound_all(
    column: ca.SX,
    variables: ca.SX,
    box: Any,
    rtol: float,
    seconds: float,
    make: Callable[[ca.Function], Evaluator] = generated,
    cut: str = "loss",
) -> tuple[list[Found], float, float]:
    """Bound expressions one after the other, until the time is over.

    Parameters
    ----------
    column : casadi.SX
        Expressions.
    variables : casadi.SX
        Column of symbols.
    box : array_like, shape (v, 2)
        Ranges.
    rtol : float
        Wanted gap relative to the attained width, both ends together.
    seconds : float
        Limit; what has not been begun by then is not finished.
    make : callable
        ``generated`` or ``interpreted``.
    cut : {"loss", "widest"}
        Which variable is cut in two.

    Returns
    -------
    (list of Found, float, float)
        One per expression, the time to differentiate and to make evaluators, the time of the
        search.
    """
    begin = time.process_time()
    ranges = [(float(lo), float(hi)) for lo, hi in np.asarray(box)]
    share = np.random.default_rng(0).random((32, len(ranges)))
    share[:16] = np.round(share[:16])
    points = [
        [lo + s * (hi - lo) for s, (lo, hi) in zip(row, ranges, strict=True)] for row in share
    ]
    expressions = [Expression(column[k], variables, make) for k in range(column.numel())]
    start = time.process_time()
    found = []
    for expression in expressions:
        low, high = (_Goal(expression, ranges, sign, cut) for sign in (-1, 1))
        for point in points:
            low.try_point(point)
            high.try_point(point)

        def tolerance(low: _Goal = low, high: _Goal = high) -> float:
            width = low.best + high.best
            return 0.5 * rtol * width + 1e-15 * max(abs(low.best), abs(high.best))

        ended = [goal.run(tolerance, start + seconds) for goal in (low, high)]
        gap = low.bound + high.bound - (low.best + high.best)
        found.append(Found(-low.bound, high.bound, gap, all(ended), low.boxes + high.boxes))
    return found, start - begin, time.process_time() - start
