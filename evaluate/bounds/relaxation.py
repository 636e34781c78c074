"""Linear inequalities that hold for every value a program can take on boxes, at every instant.

Every node of the program is a variable of its own between the ends of its interval. A sum, a
difference and a multiple are equalities; a product lies between the four planes of McCormick (1976)
through its corners, a quotient is a product solved for a factor; a function of one variable that
bends one way lies between its chord and tangents, any other between two lines whose slope is the
middle of its derivative. What has no such form is its interval alone. Slopes are the numbers of
the inequality; what they and the right-hand side lose by rounding is in the latter.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache

import casadi as ca
import numpy as np

from obsynth.derive.intervals.graph import Node
from obsynth.derive.intervals.program import Program, evaluate
from obsynth.derive.rigour import Interval, middle_and_radius, up
from obsynth.derive.rigour import interval as ar
from obsynth.symbolic.arrays import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class Row:
    """``sum_j factors[j] node_j <= right`` at every instant; equality where it says so.

    nodes: of the program
    factors, right: (T,) each; an infinite right-hand side says nothing
    """

    nodes: tuple[int, ...]
    factors: tuple[FloatArray, ...]
    right: FloatArray
    equal: bool = False


def relax(program: Program, nodes: Sequence[int], ranges: Mapping[int, Interval]) -> list[Row]:
    """Return the inequalities of nodes, operands first, with their operands; (T,) intervals.

    A product whose factors are multiples of those of one before is a multiple of it.
    """
    rows: list[Row] = []
    multiples: dict[int, tuple[float, int]] = {}
    products: dict[tuple[int, ...], tuple[Fraction, int]] = {}
    for index in nodes:
        node, ones = program.nodes[index], np.ones_like(ranges[index][0])
        multiple = _multiple(program, node, multiples)
        if multiple is None and node.op == "multiply":
            (c, a), (d, b) = (multiples.get(k, (1.0, k)) for k in node.args)
            scale = Fraction(c) * Fraction(d)
            known, first = products.setdefault(tuple(sorted((a, b))), (scale, index))
            ratio = float(scale / known) if known else 0.0
            if first != index and Fraction(ratio) * known == scale:
                multiple = ratio, first
        if multiple is None:
            with np.errstate(all="ignore"):
                rows += _operation(program, index, ranges)
        else:
            factor, base = multiple
            multiples[index] = multiple
            rows.append(Row((index, base), (ones, -factor * ones), 0.0 * ones, equal=True))
    return rows


def _multiple(
    program: Program, node: Node, known: Mapping[int, tuple[float, int]]
) -> tuple[float, int] | None:
    """Return factor and node of which a node is an exact multiple."""
    if node.op in ("twice", "negate"):
        factor, of = (2.0 if node.op == "twice" else -1.0), node.args[0]
    elif node.op == "multiply" and any(program.exact(a) is not None for a in node.args):
        number, of = node.args if program.exact(node.args[0]) is not None else node.args[::-1]
        factor = float(program.exact(number) or 0.0)
    else:
        return None
    before, base = known.get(of, (1.0, of))
    product = factor * before
    exact = Fraction(product) == Fraction(factor) * Fraction(before)
    return (product, base) if exact else (factor, of)


def _operation(program: Program, index: int, ranges: Mapping[int, Interval]) -> list[Row]:
    """Return the inequalities of one node."""
    node = program.nodes[index]
    args, z = node.args, ranges[index]
    ones = np.ones_like(z[0])
    if node.op in _LINEAR:
        weights = [ones, *(-w * ones for w in _LINEAR[node.op])]
        return [Row((index, *args), tuple(weights), 0.0 * ones, equal=True)]
    if node.op == "multiply":
        return _product((index, *args), ranges)
    if node.op == "divide":
        return _product((args[0], index, args[1]), ranges)
    if node.op in ("minimum", "maximum"):
        sign = 1.0 if node.op == "minimum" else -1.0
        return [Row((index, a), (sign * ones, -sign * ones), 0.0 * ones) for a in args]
    known = _function(program, node)
    return [] if known is None else _curve(index, args[0], known, ranges)


_LINEAR: Mapping[str, tuple[float, ...]] = {
    "add": (1.0, 1.0),
    "subtract": (1.0, -1.0),
    "nonnegative": (1.0,),
    "assign": (1.0,),
}


def _product(nodes: tuple[int, ...], ranges: Mapping[int, Interval]) -> list[Row]:
    """Return the planes of z = a b through the corners of a and b."""
    _, a, b = nodes
    rows = []
    for above, p, q in ((1, 0, 1), (1, 1, 0), (-1, 0, 0), (-1, 1, 1)):
        # (a - p)(b - q) has the sign -above
        x, y = ranges[a][p], ranges[b][q]
        corner = ar.multiply((-above * x, -above * x), (y, y))[1]
        rows.append(_row(nodes, (above + 0.0 * x, -above * y, -above * x), corner))
    return rows


def _row(nodes: tuple[int, ...], factors: tuple[FloatArray, ...], right: FloatArray) -> Row:
    """Return a row with equal nodes added up, saying nothing where a number is not finite."""
    fine = np.isfinite(right) & np.all(np.isfinite(factors), axis=0)
    if len(set(nodes)) < len(nodes):  # x x is a square elsewhere; here it says nothing
        fine = np.zeros_like(fine)
    clean = tuple(np.where(fine, factor, 0.0) for factor in factors)
    return Row(nodes, clean, np.where(fine, right, np.inf))


@dataclass(frozen=True, eq=False)
class _Known:
    """A function of one variable: itself, its first and second derivative; how it always bends."""

    program: Program
    bend: int = 0


_SMOOTH: Mapping[str, tuple[Callable[[ca.SX], ca.SX], int]] = {
    "exp": (ca.exp, 1),
    "expm1": (ca.expm1, 1),
    "log": (ca.log, -1),
    "log1p": (ca.log1p, -1),
    "sqrt": (ca.sqrt, -1),
    "cosh": (ca.cosh, 1),
    "sine": (ca.sin, 0),
    "cosine": (ca.cos, 0),
    "tangent": (ca.tan, 0),
    "asin": (ca.asin, 0),
    "acos": (ca.acos, 0),
    "atan": (ca.atan, 0),
    "sinh": (ca.sinh, 0),
    "tanh": (ca.tanh, 0),
    "asinh": (ca.asinh, 0),
    "acosh": (ca.acosh, -1),
    "atanh": (ca.atanh, 0),
    "erf": (ca.erf, 0),
    "absolute": (ca.fabs, 1),
}


@cache
def _derivatives(op: str, number: int, exponent: float) -> _Known | None:
    a = ca.SX.sym("a")
    if op == "power_int":
        value, bend = a**number, int(number % 2 == 0 and number > 0)
    elif op == "power_const":
        value, bend = a**exponent, 0
    elif op in _SMOOTH:
        function, bend = _SMOOTH[op]
        value = function(a)
    else:
        return None
    first = ca.jacobian(value, a)
    return _Known(
        Program.from_casadi(ca.Function(op, [a], [value, first, ca.jacobian(first, a)])), bend
    )


def _function(program: Program, node: Node) -> _Known | None:
    """Return what is known of an operation on one variable."""
    exponent = 0.0
    if node.op == "power_const":
        found = program.exact(node.args[1])
        if found is None:
            return None
        exponent = found
    return _derivatives(node.op, node.number, exponent)


def _curve(z: int, a: int, known: _Known, ranges: Mapping[int, Interval]) -> list[Row]:
    """Return chord and tangents, or a pair of lines, of a function of one variable."""
    ends = ranges[a]
    _, _, second = _over(known, ends)
    convex, concave = second[0] >= 0.0, second[1] <= 0.0
    if known.bend:
        convex, concave = np.full((2, len(convex)), [[known.bend > 0], [known.bend < 0]])
    middle = 0.5 * ends[0] + 0.5 * ends[1]
    rows = _chord(z, a, known, ends, convex, concave)
    for point in (ends[0], middle, ends[1]):
        value, derivative, _ = _over(known, (point, point))
        rows += _touching(z, a, ends, point, value, derivative, convex, concave)
    # the mean value form, where nothing is known of how it bends
    value, derivative = _over(known, (middle, middle))[0], _over(known, ends)[1]
    open_ = ~(convex | concave)
    return rows + _touching(z, a, ends, middle, value, derivative, open_, open_)


def _over(known: _Known, ends: Interval) -> list[Interval]:
    lower, upper = evaluate(known.program, ends[0][None], ends[1][None])
    return list(zip(lower, upper, strict=True))


def _above(value: Interval, slope: FloatArray, at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Enclose ``value - slope at``."""
    found: Interval = ar.subtract(value, ar.multiply((slope, slope), (at, at)))
    return found


def _chord(
    z: int, a: int, known: _Known, ends: Interval, convex: BoolArray, concave: BoolArray
) -> list[Row]:
    """Return the line through both ends, above what is convex, below what is concave."""
    low, high = (_over(known, (end, end))[0] for end in ends)
    width = ends[1] - ends[0]
    slope = np.where(width > 0.0, (high[0] - low[0]) / np.where(width > 0.0, width, 1.0), 0.0)
    left, right = _above(low, slope, ends[0]), _above(high, slope, ends[1])
    most = np.where(convex, np.maximum(left[1], right[1]), np.inf)
    least = np.where(concave, np.minimum(left[0], right[0]), -np.inf)
    return _between(z, a, slope, least, most)


def _touching(
    z: int,
    a: int,
    ends: Interval,
    point: FloatArray,
    value: Interval,
    derivative: Interval,
    below: BoolArray,
    above: BoolArray,
) -> list[Row]:
    """Return lines through a point below and above, for a derivative that is in an interval."""
    slope, radius = middle_and_radius(*derivative)
    reach = up(np.maximum(ends[1] - point, point - ends[0]))
    lost = ar.multiply((0.0 * radius, radius), (0.0 * reach, reach))[1]
    start = _above(value, slope, point)
    most = np.where(above, up(start[1] + lost), np.inf)
    least = np.where(below, -up(lost - start[0]), -np.inf)
    return _between(z, a, slope, least, most)


def _between(z: int, a: int, slope: FloatArray, least: FloatArray, most: FloatArray) -> list[Row]:
    """Return ``least <= z - slope a <= most``."""
    one = np.ones_like(slope)
    return [_row((z, a), (one, -slope), most), _row((z, a), (-one, slope), -least)]
