"""Rewrites with the same value wherever the original is defined, and a narrower range.

Every function takes the graph and the operands of an operation of CasADi and returns the node that
stands for it. Products and quotients are seen as powers, in halves, of what they are made of:
x**2/sqrt(x) is x sqrt(x), which is defined at zero. e/(c + k e) with e = exp(z) is 1/(c exp(-z) +
k), which is narrower and does not overflow: derivatives of logistic functions are such products.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from obsynth.derive.intervals.graph import Graph, Node

_MOST = 12
_DEEP = 6


@dataclass
class Factors:
    """A node as a product: a number (sign and power of two), and factors by twice their exponents.

    roots: factors of which a root is taken, so that they may not be negative
    constants: nodes that do not depend on the box, with 1 above the line and -1 below. They never
        cancel: equal enclosures may stand for numbers that differ
    """

    number: float = 1.0
    halves: dict[int, int] = field(default_factory=dict)
    roots: set[int] = field(default_factory=set)
    constants: list[tuple[int, int]] = field(default_factory=list)

    def times(self, other: Factors, power: int) -> Factors:
        """Return the product with a power (1 or -1) of another."""
        halves = dict(self.halves)
        for factor, half in other.halves.items():
            halves[factor] = halves.get(factor, 0) + power * half
        return Factors(
            self.number * other.number**power,
            halves,
            self.roots | other.roots,
            [*self.constants, *((node, power * side) for node, side in other.constants)],
        )


def factors(graph: Graph, index: int) -> Factors:
    """Take a node apart into factors; remembered in the graph."""
    known: dict[int, Factors] = graph.memory
    if index not in known:
        found = _apart(graph, index)
        if len(found.halves) + len(found.constants) > _MOST:
            found = Factors(halves={index: 2})
        known[index] = found
    return known[index]


def _apart(graph: Graph, index: int) -> Factors:
    node = graph.nodes[index]
    if index in graph.constants:
        return Factors() if graph.exact(index) == 1.0 else Factors(constants=[(index, 1)])
    if node.op == "negate":
        return Factors(-1.0).times(factors(graph, node.args[0]), 1)
    if node.op == "twice":
        return Factors(2.0).times(factors(graph, node.args[0]), 1)
    if node.op in ("multiply", "divide"):
        power = 1 if node.op == "multiply" else -1
        return factors(graph, node.args[0]).times(factors(graph, node.args[1]), power)
    if node.op == "power_int":
        inner = factors(graph, node.args[0])
        if inner.constants or inner.number != 1.0:
            return Factors(halves={node.args[0]: 2 * node.number})
        halves = {factor: half * node.number for factor, half in inner.halves.items()}
        return Factors(halves=halves, roots=inner.roots)
    if node.op in ("sqrt", "nonnegative"):
        half = 1 if node.op == "sqrt" else 2
        return Factors(halves={node.args[0]: half}, roots={node.args[0]})
    return Factors(halves={index: 2})


def cancelled(graph: Graph, a: int, b: int, power: int) -> int | None:
    """Return a * b or a / b without the factors that cancel."""
    first, second = factors(graph, a), factors(graph, b)
    common = [
        factor
        for factor, half in second.halves.items()
        if half * power * first.halves.get(factor, 0) < 0
    ]
    product = first.times(second, power)
    if not _saturate(graph, product.halves) and not common:
        return None
    if any(not product.halves[factor] and factor in product.roots for factor in common):
        # all that would be left of a root is that its operand may not be negative
        return None
    return _rebuilt(graph, product, product.halves)


def _rebuilt(graph: Graph, product: Factors, halves: dict[int, int]) -> int:
    """Return the number and the constants of a product, times powers."""
    sides: dict[int, list[int]] = {1: [], -1: []}
    for node, side in product.constants:
        sides[side].append(node)
    for factor, half in halves.items():
        if half:
            sides[1 if half > 0 else -1] += _powers(graph, factor, abs(half), product.roots)
    if product.number != 1.0:
        sides[1].append(graph.number(product.number, product.number))
    top, bottom = (_product(graph, sides[side]) for side in (1, -1))
    return graph.plain("divide", [top, bottom]) if sides[-1] else top


def _saturate(graph: Graph, halves: dict[int, int]) -> bool:
    """Divide sums c + k e below a product by the exponentials e above it."""
    changed = False
    for e in [k for k, half in halves.items() if half > 1 and graph.nodes[k].op == "exp"]:
        for total in [k for k, half in halves.items() if half < -1]:
            for c, share in _splits(graph, total):
                product = factors(graph, share)
                if c not in graph.constants or product.halves != {e: 2}:
                    continue
                whole = min(halves[e], -halves[total]) // 2
                inverse = graph.plain("exp", [_negate(graph, [graph.nodes[e].args[0]])])
                parts = [_multiply(graph, [c, inverse]), _rebuilt(graph, product, {})]
                saturated = _add(graph, parts)
                halves[e] -= 2 * whole
                halves[total] += 2 * whole
                halves[saturated] = halves.get(saturated, 0) - 2 * whole
                changed = True
    return changed


def _splits(graph: Graph, index: int) -> list[tuple[int, int]]:
    node = graph.nodes[index]
    if node.op != "add":
        return []
    a, b = node.args
    return [(a, b), (b, a)]


def _powers(graph: Graph, factor: int, half: int, roots: set[int]) -> list[int]:
    whole, odd = divmod(half, 2)
    parts = []
    if whole:
        base = graph.append(Node("nonnegative", (factor,))) if factor in roots else factor
        parts.append(base if whole == 1 else graph.append(Node("power_int", (base,), whole)))
    if odd:
        parts.append(graph.append(Node("sqrt", (factor,))))
    return parts


def _product(graph: Graph, nodes: list[int]) -> int:
    if not nodes:
        return graph.number(1.0, 1.0)
    result = nodes[0]
    for node in nodes[1:]:
        result = graph.plain("multiply", [result, node])
    return result


def _split_power(graph: Graph, index: int) -> tuple[int, int]:
    node = graph.nodes[index]
    return (node.args[0], node.number) if node.op == "power_int" else (index, 1)


def _power(graph: Graph, base: int, n: int) -> int:
    node = graph.nodes[base]
    if node.op == "power_int":
        base, n = node.args[0], n * node.number
        node = graph.nodes[base]
    if n % 2 == 0 and node.op in ("absolute", "negate"):
        base = node.args[0]
        node = graph.nodes[base]
    if node.op == "sqrt":
        inner = graph.append(Node("nonnegative", node.args))
        return _power(graph, inner, n // 2) if n > 2 and n % 2 == 0 else _half(graph, inner, n)
    return base if n == 1 else graph.append(Node("power_int", (base,), n))


def _half(graph: Graph, inner: int, n: int) -> int:
    """Return sqrt(a)**n for an a known to be nonnegative."""
    whole = inner if n // 2 == 1 else graph.append(Node("power_int", (inner,), n // 2))
    if n % 2 == 0:
        return whole
    root = graph.append(Node("sqrt", graph.nodes[inner].args))
    return graph.plain("multiply", [whole, root])


def _multiply(graph: Graph, args: list[int]) -> int:
    a, b = args
    shorter = cancelled(graph, a, b, 1)
    if shorter is not None:
        return shorter
    for first, second in ((a, b), (b, a)):
        value = graph.exact(first)
        if value == 1.0:
            return second
        if value == -1.0:
            return _negate(graph, [second])
        if value == 2.0:
            return graph.append(Node("twice", (second,)))
        inner = graph.nodes[second]
        if graph.nodes[first].op == "sign":
            if inner.op == "multiply" and first in inner.args:
                other = inner.args[1] if inner.args[0] == first else inner.args[0]
                return graph.plain("multiply", [other, _power(graph, first, 2)])
            if graph.nodes[first].args[0] == second:
                return graph.append(Node("absolute", (second,)))
            argument = graph.nodes[first].args[0]
            if inner.op == "multiply" and argument in inner.args:
                other = inner.args[1] if inner.args[0] == argument else inner.args[0]
                return graph.plain("multiply", [other, _absolute(graph, [argument])])
        if inner.op == "multiply":
            for k in (0, 1):
                sign = graph.nodes[inner.args[k]]
                if sign.op == "sign" and sign.args[0] == first:
                    size = _absolute(graph, [first])
                    return graph.plain("multiply", [inner.args[1 - k], size])
    (base, n), (other, m) = _split_power(graph, a), _split_power(graph, b)
    if base == other and base not in graph.constants:
        return _power(graph, base, n + m)
    return graph.plain("multiply", args)


def _divide(graph: Graph, args: list[int]) -> int:
    a, b = args
    if graph.exact(b) == 1.0:
        return a
    shorter = cancelled(graph, a, b, -1)
    if shorter is not None:
        return shorter
    top, bottom = graph.nodes[a], graph.nodes[b]
    if top.op == "less_equal" and bottom.op == "add" and a in bottom.args:
        other = bottom.args[1] if bottom.args[0] == a else bottom.args[0]
        mirrored = graph.nodes[other]
        if mirrored.op == "less_equal" and mirrored.args == top.args[::-1]:
            return graph.append(Node("boundary_weight", top.args))
    return graph.plain("divide", args)


def _add(graph: Graph, args: list[int]) -> int:
    a, b = args
    for first, second in ((a, b), (b, a)):
        if graph.exact(first) == 0.0:
            return second
        if graph.nodes[first].op == "negate":
            return _subtract(graph, [second, graph.nodes[first].args[0]])
        yes, no = graph.nodes[first], graph.nodes[second]
        if yes.op == no.op == "if_else_zero":
            opposite = graph.nodes[no.args[0]]
            if opposite.op == "logical_not" and opposite.args[0] == yes.args[0]:
                return graph.append(Node("select", (yes.args[0], yes.args[1], no.args[1])))
    choice = _weighted(graph, a, b, 1)
    if choice is not None:
        return choice
    if a == b:
        return graph.append(Node("twice", (a,)))
    return graph.plain("add", args)


def _weighted(graph: Graph, a: int, b: int, sign: int) -> int | None:
    """Join w a +- (1 - w) b, with the weights of a min or max, to a choice between a and +-b."""
    for i, weight in enumerate(_weights(graph, a)):
        for j, other in enumerate(_weights(graph, b)):
            if graph.nodes[other].args == graph.nodes[weight].args[::-1]:
                yes, no = _without(graph, a, [i]), _without(graph, b, [j])
                no = no if sign > 0 else _negate(graph, [no])
                return graph.append(Node("select", (weight, yes, no)))
    return None


def _weights(graph: Graph, index: int, depth: int = _DEEP) -> list[int]:
    """List the weights among the factors of a node, from left to right."""
    node = graph.nodes[index]
    if node.op == "boundary_weight":
        return [index]
    if not depth or node.op not in ("multiply", "twice", "negate"):
        return []
    return [w for argument in node.args for w in _weights(graph, argument, depth - 1)]


def _without(graph: Graph, index: int, place: list[int], depth: int = _DEEP) -> int:
    """Return a product without one of its weights, the one that ``place`` counts down to."""
    node = graph.nodes[index]
    if node.op == "boundary_weight":
        place[0] -= 1
        return graph.number(1.0, 1.0) if place[0] == -1 else index
    if not _weights(graph, index, depth):
        return index
    rest = [_without(graph, argument, place, depth - 1) for argument in node.args]
    return REWRITES[node.op](graph, rest)


def _subtract(graph: Graph, args: list[int]) -> int:
    a, b = args
    if graph.exact(b) == 0.0:
        return a
    if graph.exact(a) == 0.0:
        return _negate(graph, [b])
    if graph.nodes[b].op == "negate":
        return _add(graph, [a, graph.nodes[b].args[0]])
    choice = _weighted(graph, a, b, -1)
    return graph.plain("subtract", args) if choice is None else choice


def _negate(graph: Graph, args: list[int]) -> int:
    node = graph.nodes[args[0]]
    if node.op == "negate":
        return node.args[0]
    if node.op == "subtract":
        return _subtract(graph, [node.args[1], node.args[0]])
    return graph.plain("negate", args)


def _sqrt(graph: Graph, args: list[int]) -> int:
    node = graph.nodes[args[0]]
    if node.op == "power_int" and node.number % 2 == 0:
        inner = graph.append(Node("absolute", node.args))
        return _power(graph, inner, node.number // 2)
    return graph.plain("sqrt", args)


def _absolute(graph: Graph, args: list[int]) -> int:
    node = graph.nodes[args[0]]
    if node.op == "absolute" or (node.op == "power_int" and node.number % 2 == 0):
        return args[0]
    if node.op == "negate":
        return _absolute(graph, [node.args[0]])
    return graph.plain("absolute", args)


def _power_const(graph: Graph, args: list[int]) -> int:
    exponent = graph.exact(args[1])
    if exponent is not None and exponent == int(exponent):
        n = int(exponent)
        if n == 0:
            return graph.number(1.0, 1.0)
        positive = _power(graph, args[0], abs(n))
        return positive if n > 0 else _inverse(graph, [positive])
    if exponent == 0.5:
        return _sqrt(graph, [args[0]])
    if exponent == -0.5:
        return _inverse(graph, [_sqrt(graph, [args[0]])])
    name = "power_const" if args[1] in graph.constants else "power"
    return graph.plain(name, args)


def _inverse(graph: Graph, args: list[int]) -> int:
    return _divide(graph, [graph.number(1.0, 1.0), args[0]])


REWRITES: dict[str, Callable[[Graph, list[int]], int]] = {
    "square": lambda graph, args: _power(graph, args[0], 2),
    "multiply": _multiply,
    "divide": _divide,
    "add": _add,
    "subtract": _subtract,
    "negate": _negate,
    "sqrt": _sqrt,
    "absolute": _absolute,
    "power": _power_const,
    "power_const": _power_const,
    "inverse": _inverse,
    "not_equal": lambda graph, args: graph.append(
        Node("logical_not", (graph.plain("equal", args),))
    ),
    "twice": lambda graph, args: graph.append(Node("twice", (args[0],))),
    "assign": lambda _graph, args: args[0],
}
