"""Fewer variables for expressions that see some of them only through one intermediate quantity.

The side force of a tyre depends on speeds and yaw rate only through its slip. Over the box of these
variables the slip runs through an interval, so the expression has the same range when the slip is a
variable of its own. That is more than convenient: seen in the original variables, the largest value
is taken on a whole surface, and no search by boxes gets to the end of a surface.

A quantity d may become a variable when every path from one of its variables to the result leads
through d (d dominates them in the graph of the expression).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from obsynth.derive.intervals.graph import reached
from obsynth.symbolic.arrays import FloatArray

_Key = tuple[int, tuple[int, ...], float | tuple[int, int] | None]

_COMMUTATIVE = frozenset({ca.OP_ADD, ca.OP_MUL, ca.OP_FMIN, ca.OP_FMAX, ca.OP_HYPOT})
_AFFINE = frozenset(
    {ca.OP_ASSIGN, ca.OP_NEG, ca.OP_TWICE, ca.OP_ADD, ca.OP_SUB, ca.OP_MUL, ca.OP_DIV}
)


@dataclass(frozen=True, eq=False)
class Reduction:
    """Expressions in fewer variables, with the positions ``which`` of those that could be reduced.

    quantities: what the new variables, ``symbols``, stand for in the original ones
    used: quantities in each of the reduced expressions
    supports: original variables behind each quantity
    """

    column: ca.SX
    which: list[int]
    quantities: ca.SX
    symbols: ca.SX
    used: list[list[int]]
    supports: list[list[int]]


class SxGraph:
    """Instructions of SX expressions as a graph in which equal operations are one node.

    nodes: CasADi's operation, operands (always earlier nodes), and the value of a constant or which
        input and element
    roots, supports: nodes of the expressions; variables of every node, those in ``extra`` left
        aside
    """

    def __init__(self, column: ca.SX, variables: ca.SX, extra: ca.SX) -> None:
        self._symbols = (variables, extra)
        function = ca.Function("graph", [variables, extra], [column])
        self.nodes: list[_Key] = []
        known: dict[_Key, int] = {}
        work: dict[int, int] = {}
        self.roots: dict[int, int] = {}
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            out, operands = function.instruction_output(k), function.instruction_input(k)
            if code == ca.OP_OUTPUT:
                self.roots[out[1]] = work[operands[0]]
                continue
            key: _Key
            if code == ca.OP_CONST:
                key = (code, (), function.instruction_constant(k))
            elif code == ca.OP_INPUT:
                key = (code, (), (operands[0], operands[1]))
            else:
                args = tuple(work[a] for a in operands)
                key = (code, tuple(sorted(args)) if code in _COMMUTATIVE else args, None)
            if key not in known:
                known[key] = len(self.nodes)
                self.nodes.append(key)
            work[out[0]] = known[key]
        self.supports: list[frozenset[int]] = []
        for _, args, value in self.nodes:
            own = frozenset[int]()
            if isinstance(value, tuple) and value[0] == 0:
                own = frozenset([value[1]])
            self.supports.append(own.union(*(self.supports[a] for a in args)))

    def _live(self, root: int) -> list[int]:
        return sorted(reached([root], lambda k: self.nodes[k][1]), reverse=True)

    def _inside(self, root: int) -> int:
        """Go down through operations with constants that are affine, and so change nothing."""
        while True:
            code, args, _ = self.nodes[root]
            varying = [a for a in args if self.supports[a]]
            upside_down = code == ca.OP_DIV and args[0] not in varying
            if code not in _AFFINE or len(varying) != 1 or upside_down:
                return root
            root = varying[0]

    def _dominators(self, root: int, live: list[int]) -> dict[int, int]:
        """Nearest node through which all paths from a node to the root lead."""
        users: dict[int, list[int]] = {index: [] for index in live}
        for index in live:
            for argument in self.nodes[index][1]:
                users[argument].append(index)
        nearest, depth = {root: root}, {root: 0}
        # users have larger numbers than what they use, so they are done first
        for index in live:
            if index == root:
                continue
            common = users[index][0]
            for other in users[index][1:]:
                while common != other:
                    if depth[common] >= depth[other]:
                        common = nearest[common]
                    else:
                        other = nearest[other]
            nearest[index], depth[index] = common, depth[common] + 1
        return nearest

    def quantities(self, output: int) -> list[int]:
        """List nodes, free of common variables, that may stand for the variables behind them."""
        root = self._inside(self.roots[output])
        live = self._live(root)
        nearest = self._dominators(root, live)
        above: dict[int, list[int]] = {}
        for index in live:
            if self.nodes[index][0] == ca.OP_INPUT and self.supports[index]:
                chain = [index]
                while chain[-1] != root:
                    chain.append(nearest[chain[-1]])
                (variable,) = self.supports[index]
                above[variable] = chain
        passed = {variable: set(chain) for variable, chain in above.items()}
        found: dict[frozenset[int], int] = {}
        for chain in above.values():
            for index in chain:
                support = self.supports[index]
                whole = len(support) > 1 and all(index in passed[v] for v in support)
                # of nodes with the same variables the first one is the simplest
                if index != root and whole and support not in found:
                    found[support] = index
        return [n for s, n in found.items() if not any(s < other for other in found)]

    def expression(self, index: int, given: Mapping[int, ca.SX] | None = None) -> ca.SX:
        """Write a node as an expression again."""
        values = dict(given or {})
        for node in reversed(self._live(index)):
            if node in values:
                continue
            code, args, value = self.nodes[node]
            if isinstance(value, float):
                values[node] = ca.SX(value)
            elif isinstance(value, tuple):
                values[node] = self._symbols[value[0]][value[1]]
            elif len(args) == 1:
                values[node] = ca.SX.unary(code, values[args[0]])
            else:
                values[node] = ca.SX.binary(code, values[args[0]], values[args[1]])
        return values[index]


def reduce_variables(
    column: ca.SX, variables: ca.SX, extra: ca.SX, wanted: list[int]
) -> Reduction | None:
    """Find quantities that can stand for several variables."""
    graph = SxGraph(column, variables, extra)
    numbers: dict[int, int] = {}
    symbols: list[ca.SX] = []
    reduced, which, used = [], [], []
    for output in wanted:
        nodes = graph.quantities(output)
        if not nodes:
            continue
        for node in nodes:
            if node not in numbers:
                numbers[node] = len(symbols)
                symbols.append(ca.SX.sym(f"z{len(symbols)}"))
        given = {node: symbols[numbers[node]] for node in nodes}
        reduced.append(graph.expression(graph.roots[output], given))
        which.append(output)
        used.append([numbers[node] for node in nodes])
    if not reduced:
        return None
    return Reduction(
        ca.vertcat(*reduced),
        which,
        ca.vertcat(*[graph.expression(node) for node in numbers]),
        ca.vertcat(*symbols),
        used,
        [sorted(graph.supports[node]) for node in numbers],
    )


def preimage(
    function: ca.Function, number: int, value: float, low_at: FloatArray, high_at: FloatArray
) -> FloatArray:
    """Find where a quantity takes a value, on the way between its smallest and largest value."""
    from scipy.optimize import brentq

    def off(share: float) -> float:
        there = low_at + share * (high_at - low_at)
        # zero where it is no number: any point will do there, nothing is attained at it
        return float(np.nan_to_num(float(function(there).nonzeros()[number]) - value))

    if off(0.0) >= 0.0:
        return low_at
    if off(1.0) <= 0.0:
        return high_at
    share = float(brentq(off, 0.0, 1.0, xtol=1e-16, rtol=1e-15))
    return low_at + share * (high_at - low_at)
