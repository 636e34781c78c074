"""The graph of interval operations, in which equal sub-expressions are one node, and its order.

A call of NumPy costs as much as the work on some hundreds of boxes, and branch and bound mostly has
fewer than that. So all products whose factors are known are taken in one call, on arrays with one
row per product and one column per box, then all sums that have become possible, and so on.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np

from obsynth.derive.intervals.rules import COMMUTATIVE, PARTIAL, RULES, uncertain
from obsynth.derive.rigour import Interval
from obsynth.symbolic.arrays import BoolArray, FloatArray, IntArray


def reached(starts: Iterable[int], onwards: Callable[[int], Iterable[int]]) -> set[int]:
    """Collect what is met on the way from some nodes, these among it."""
    found: set[int] = set()
    stack = list(starts)
    while stack:
        node = stack.pop()
        if node not in found:
            found.add(node)
            stack.extend(onwards(node))
    return found


@dataclass(frozen=True)
class Node:
    """One operation: its name, its operands and, for powers and inputs, a number."""

    op: str
    args: tuple[int, ...] = ()
    number: int = 0


@dataclass
class Graph:
    """Nodes, operands before what is made of them, with the values of the constant ones.

    What rewrites remember of nodes is their ``memory``.
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
            if node.op == "multiply":
                # an exponent 3 n has to stay an integer, or a power loses its negative bases
                a, b = (self.exact(k) for k in node.args)
                if a and b and np.isfinite(a * b) and Fraction(a) * Fraction(b) == a * b:
                    return self.number(a * b, a * b)
            if lo[0] == hi[0]:
                return self.number(float(lo[0]), float(hi[0]))
            self.constants[index] = (lo, hi)
        self.nodes.append(node)
        self._known[node] = index
        return index

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


Rows = slice | IntArray

# Numbers in the working memory of a program, and limits of the boxes done together.
_BLOCK = 1_000_000
_NARROWEST, _WIDEST = 512, 4_096


@dataclass(frozen=True, eq=False)
class _Step:
    """One operation on several rows at once."""

    rule: Callable[..., Interval]
    target: slice
    operands: tuple[Rows, ...]
    extra: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Values:
    """Ends of the ranges of the nodes that were asked for over a batch, with the row of each."""

    table: FloatArray
    row: dict[int, int]

    def of(self, node: int) -> Interval:
        """Return the range of a node, two arrays of shape (N,)."""
        k = self.row[node]
        return self.table[0, k], self.table[1, k]


class Schedule:
    """Order of the nodes behind those that are wanted; ``breaks``: those that may jump."""

    def __init__(
        self,
        graph: Graph,
        live: Sequence[int],
        wanted: Sequence[int],
        breaks: Sequence[Sequence[int]] = (),
    ) -> None:
        constants = [k for k in live if k in graph.constants]
        inputs = [k for k in live if graph.nodes[k].op == "input"]
        self._row = {node: k for k, node in enumerate([*constants, *inputs])}
        self._constants = np.array(
            [[float(graph.constants[k][side][0]) for k in constants] for side in (0, 1)]
        ).reshape(2, len(constants), 1)
        self._inputs = np.array([graph.nodes[k].number for k in inputs], dtype=np.int64)
        self._steps = [self._step(graph, group) for group in _groups(graph, live, set(self._row))]
        self.count = len(self._steps)
        self._block = min(max(_BLOCK // max(len(self._row), 1), _NARROWEST), _WIDEST)
        judged = sorted({k for some in breaks for k in some})
        kept = [*wanted, *judged, *(a for k in judged for a in graph.nodes[k].args)]
        self.row = {node: k for k, node in enumerate(dict.fromkeys(kept))}
        self._kept = np.array([self._row[node] for node in self.row], dtype=np.int64)
        self._judge(graph, breaks)

    def _step(self, graph: Graph, group: list[int]) -> _Step:
        start = len(self._row)
        for node in group:
            self._row[node] = len(self._row)
        first = graph.nodes[group[0]]
        operands = tuple(
            _rows([self._row[graph.nodes[node].args[k]] for node in group])
            for k in range(len(first.args))
        )
        extra = (first.number,) if first.op == "power_int" else ()
        return _Step(RULES[first.op], slice(start, len(self._row)), operands, extra)

    def _judge(self, graph: Graph, breaks: Sequence[Sequence[int]]) -> None:
        """Note which nodes decide whether an output is smooth."""
        nodes = sorted({k for some in breaks for k in some})
        partial = [k for k in nodes if graph.nodes[k].op in PARTIAL]
        others = [k for k in nodes if graph.nodes[k].op not in PARTIAL]
        self._partial = np.array([self.row[k] for k in partial], dtype=np.int64)
        self._others = [
            (graph.nodes[k].op, self.row[k], [self.row[a] for a in graph.nodes[k].args])
            for k in others
        ]
        position = {k: n for n, k in enumerate([*partial, *others])}
        self._under = [np.array([position[k] for k in some], dtype=np.int64) for some in breaks]

    def run(self, lower: FloatArray, upper: FloatArray) -> Values:
        """Enclose nodes over every box of a batch."""
        n = lower.shape[1]
        size = min(n, self._block)
        first, second = self._constants.shape[1], self._constants.shape[1] + len(self._inputs)
        buffer = np.empty((2, len(self._row), size))
        buffer[:, :first] = self._constants
        table = np.empty((2, len(self._kept), n))
        with np.errstate(all="ignore"):
            for start in range(0, n, max(size, 1)):
                columns = slice(start, min(start + size, n))
                part = buffer[:, :, : columns.stop - start]
                part[0, first:second] = lower[self._inputs, columns]
                part[1, first:second] = upper[self._inputs, columns]
                self._fill(part)
                table[:, :, columns] = part[:, self._kept]
        return Values(table, self.row)

    def _fill(self, table: FloatArray) -> None:
        for step in self._steps:
            operands = [table[:, rows] for rows in step.operands]
            found = step.rule(*((a[0], a[1]) for a in operands), *step.extra)
            table[0, step.target], table[1, step.target] = found

    def rough(self, values: Values) -> BoolArray:
        """Tell where an output may jump or be undefined in a box."""
        n = values.table.shape[2]
        result = np.zeros((len(self._under), n), dtype=bool)
        if not len(self._partial) and not self._others:
            return result
        table = values.table
        doubtful = np.empty((len(self._partial) + len(self._others), n), dtype=bool)
        doubtful[: len(self._partial)] = ~np.isfinite(table[:, self._partial]).all(axis=0)
        for k, (op, row, args) in enumerate(self._others, len(self._partial)):
            operands = [(table[0, a], table[1, a]) for a in args]
            doubtful[k] = uncertain(op, (table[0, row], table[1, row]), operands)
        if doubtful.any():
            for k, under in enumerate(self._under):
                result[k] = doubtful[under].any(axis=0)
        return result


def _rows(rows: list[int]) -> Rows:
    """Take rows that follow each other as a view, others as a copy."""
    if rows == list(range(rows[0], rows[0] + len(rows))):
        return slice(rows[0], rows[0] + len(rows))
    return np.array(rows, dtype=np.int64)


def _groups(graph: Graph, live: Sequence[int], done: set[int]) -> list[list[int]]:
    """Arrange nodes in groups of one operation, always the largest group that is ready."""
    missing: dict[int, int] = {}
    users: dict[int, list[int]] = {}
    ready: dict[tuple[str, int], list[int]] = {}

    def offer(node: int) -> None:
        found = graph.nodes[node]
        number = found.number if found.op == "power_int" else 0
        ready.setdefault((found.op, number), []).append(node)

    for node in live:
        if node in done:
            continue
        awaited = {a for a in graph.nodes[node].args if a not in done}
        for argument in awaited:
            users.setdefault(argument, []).append(node)
        missing[node] = len(awaited)
        if not awaited:
            offer(node)
    result = []
    while ready:
        key = max(ready, key=lambda k: len(ready[k]))
        group = ready.pop(key)
        result.append(group)
        for node in group:
            for user in users.get(node, ()):
                missing[user] -= 1
                if not missing[user]:
                    offer(user)
    return result
