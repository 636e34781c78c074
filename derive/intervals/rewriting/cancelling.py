"""Factors that cancel: x**2/sqrt(x) is x sqrt(x), which has no division and is defined at zero.

CasADi differentiates x**(5/2) = x**2 sqrt(x) by the product rule, and the quotient by a root that
comes out of it has no bound where the root is zero. Products and quotients are therefore seen as
powers, in halves, of what they are made of.
"""

from dataclasses import dataclass, field

from obsynth.derive.intervals.graph import Graph, Node

_MOST = 12


@dataclass
class Factors:
    """A node as a product.

    number: sign and power of two
    halves: twice the exponent of every factor
    roots: factors of which a root is taken, so that they may not be negative
    constants: nodes that do not depend on the box, with 1 above the line and -1 below. They never
        cancel: equal enclosures may stand for numbers that differ
    """

    number: float = 1.0
    halves: dict[int, int] = field(default_factory=dict)
    roots: set[int] = field(default_factory=set)
    constants: list[tuple[int, int]] = field(default_factory=list)

    def times(self, other: "Factors", power: int) -> "Factors":
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
        return Factors(constants=[(index, 1)])
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
    if not common:
        return None
    product = first.times(second, power)
    if any(not product.halves[factor] and factor in product.roots for factor in common):
        # all that would be left of a root is that its operand may not be negative
        return None
    sides: dict[int, list[int]] = {1: [], -1: []}
    for node, side in product.constants:
        sides[side].append(node)
    for factor, half in product.halves.items():
        if half:
            sides[1 if half > 0 else -1] += _powers(graph, factor, abs(half), product.roots)
    if product.number != 1.0:
        sides[1].append(graph.number(product.number, product.number))
    top, bottom = (_product(graph, sides[side]) for side in (1, -1))
    return graph.plain("divide", [top, bottom]) if sides[-1] else top


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
