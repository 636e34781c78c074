"""Graph of interval operations in which equal sub-expressions are one node."""

from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np

from obsynth.derive.intervals.rules import COMMUTATIVE, RULES
from obsynth.derive.rigour import Interval
from obsynth.derive.rigour.interval import point
from obsynth.symbolic.arrays import FloatArray

_RATIONAL: dict[str, Callable[..., Fraction]] = {
    "add": lambda a, b: a + b,
    "subtract": lambda a, b: a - b,
    "multiply": lambda a, b: a * b,
}


@dataclass(frozen=True)
class Node:
    """One operation: its name, its operands and, for powers and inputs, a number."""

    op: str
    args: tuple[int, ...] = ()
    number: int = 0


@dataclass
class Graph:
    """Nodes in an order in which they can be evaluated, and the values of the constant ones.

    nodes: operands always precede their node
    constants: nodes that do not depend on the box, already evaluated
    memory: what rewrites remember of nodes
    """

    nodes: list[Node] = field(default_factory=list)
    constants: dict[int, Interval] = field(default_factory=dict)
    memory: dict[int, Any] = field(default_factory=dict, repr=False)
    _known: dict[Node, int] = field(default_factory=dict, repr=False)
    _numbers: dict[tuple[float, float], int] = field(default_factory=dict, repr=False)

    def append(self, node: Node) -> int:
        """Return the number of a node, new or known; operations on constants are carried out."""
        if node in self._known:
            return self._known[node]
        index = len(self.nodes)
        if node.op != "input" and all(a in self.constants for a in node.args):
            extra = (node.number,) if node.op == "power_int" else ()
            with np.errstate(all="ignore"):
                lo, hi = RULES[node.op](*(self.constants[a] for a in node.args), *extra)
            if lo[0] != hi[0]:
                lo, hi = self._without_rounding(node, lo, hi)
            if lo[0] == hi[0]:
                return self.number(float(lo[0]), float(hi[0]))
            self.constants[index] = (lo, hi)
        self.nodes.append(node)
        self._known[node] = index
        return index

    def _without_rounding(self, node: Node, lo: FloatArray, hi: FloatArray) -> Interval:
        """Replace the enclosure of an operation on numbers by its result where that is a double.

        An exponent n - 1 has to stay an integer, or a power loses its negative bases.
        """
        known = [self.exact(a) for a in node.args]
        values = [v for v in known if v is not None and np.isfinite(v)]
        if node.op not in _RATIONAL or len(values) < len(known):
            return lo, hi
        result = _RATIONAL[node.op](*map(Fraction, values))
        try:
            nearest = float(result)
        except OverflowError:
            return lo, hi
        if Fraction(nearest) != result:
            return lo, hi
        return point(nearest)

    def number(self, lo: float, hi: float) -> int:
        """Return the node of a constant interval."""
        key = (lo, hi)
        if key not in self._numbers:
            index = len(self.nodes)
            self.nodes.append(Node("constant", (), index))
            self.constants[index] = (np.array([lo]), np.array([hi]))
            self._numbers[key] = index
        return self._numbers[key]

    def exact(self, index: int) -> float | None:
        """Return the number a node is, when it is one and known exactly."""
        if index not in self.constants:
            return None
        lo, hi = self.constants[index]
        return float(lo[0]) if lo[0] == hi[0] else None

    def plain(self, op: str, args: list[int]) -> int:
        """Return the node of an operation as it stands; operands in order where that is free."""
        return self.append(Node(op, tuple(sorted(args) if op in COMMUTATIVE else args)))
