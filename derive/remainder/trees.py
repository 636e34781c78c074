"""Rooted trees: by which derivatives a Runge-Kutta step differs from the solution.

Solution and step are series in the elementary differentials F of rooted trees, with the
coefficients 1 / (sigma gamma) and phi / sigma (Hairer, Norsett, Wanner, Solving Ordinary
Differential Equations I, chapter II.2). Their difference, order by order, has exact rational
coefficients. The difference of two derivatives computed on their own would have the same value, but
its parts are far larger than the whole, and interval bounds do not see that they cancel.

A tree is the sorted tuple of the subtrees at its root; the single node is ().
"""

from collections.abc import Iterator
from fractions import Fraction
from math import factorial
from typing import Any

import casadi as ca

Tree = tuple[Any, ...]

_HALVES = ((0, 0, 0, 0), (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 2, 0))
TABLEAUS: dict[str, tuple[list[list[Fraction]], list[Fraction]]] = {
    "euler": ([[Fraction(0)]], [Fraction(1)]),
    "rk4": (
        [[Fraction(a, 2) for a in row] for row in _HALVES],
        [Fraction(b, 6) for b in (1, 2, 2, 1)],
    ),
}
"""Coefficients A and b of the methods."""


def trees(order: int) -> list[Tree]:
    """List the rooted trees with a number of nodes."""
    if order == 1:
        return [()]
    return sorted({grown for tree in trees(order - 1) for grown in _grown(tree)})


def _grown(tree: Tree) -> Iterator[Tree]:
    """Add a node to a tree, at every node of it."""
    yield tuple(sorted((*tree, ())))
    for k, child in enumerate(tree):
        for grown in _grown(child):
            yield tuple(sorted((*tree[:k], grown, *tree[k + 1 :])))


def _nodes(tree: Tree) -> int:
    return 1 + sum(_nodes(child) for child in tree)


def _density(tree: Tree) -> int:
    result = _nodes(tree)
    for child in tree:
        result *= _density(child)
    return result


def _symmetry(tree: Tree) -> int:
    result = 1
    for child in set(tree):
        count = tree.count(child)
        result *= factorial(count) * _symmetry(child) ** count
    return result


def _stages(tree: Tree, A: list[list[Fraction]]) -> list[Fraction]:
    """Weight of a tree at every stage of a method."""
    result = [Fraction(1)] * len(A)
    for child in tree:
        inner = _stages(child, A)
        for i, row in enumerate(A):
            result[i] *= sum((a * w for a, w in zip(row, inner, strict=True)), Fraction(0))
    return result


def _coefficient(tree: Tree, method: str) -> Fraction:
    """Return k! times what the solution has more of F(tree) than a step, k nodes."""
    # a Taylor polynomial has nothing of the orders that it leaves out
    A, b = TABLEAUS.get(method, ([], []))
    weight = sum((c * w for c, w in zip(b, _stages(tree, A), strict=True)), Fraction(0))
    difference = Fraction(1, _density(tree)) - weight
    return factorial(_nodes(tree)) * difference / _symmetry(tree)


class _Differentials:
    """Elementary differentials of a right-hand side, each formed once."""

    def __init__(self, x: ca.SX, rhs: ca.SX) -> None:
        self._x, self._rhs = x, rhs
        self._known: dict[Tree, ca.SX] = {(): rhs}
        self._forms: list[tuple[list[ca.SX], ca.SX]] = [([], rhs)]

    def form(self, degree: int) -> tuple[list[ca.SX], ca.SX]:
        """Return the derivative of a degree as a multilinear form of symbols."""
        while len(self._forms) <= degree:
            directions, value = self._forms[-1]
            new = ca.SX.sym(f"a{len(self._forms)}", self._x.numel())
            self._forms.append(([*directions, new], ca.cse(ca.jtimes(value, self._x, new))))
        return self._forms[degree]

    def of(self, tree: Tree) -> ca.SX:
        if tree not in self._known:
            symbols, value = self.form(len(tree))
            arguments = [self.of(child) for child in tree]
            self._known[tree] = ca.substitute([value], symbols, arguments)[0]
        return self._known[tree]


def difference_term(x: ca.SX, rhs: ca.SX, method: str, order: int) -> ca.SX:
    """D_k - S_k at s = 0: derivative of the solution minus derivative of the step."""
    differentials = _Differentials(x, rhs)
    total = ca.SX(rhs.numel(), 1)
    for tree in trees(order):
        coefficient = _coefficient(tree, method)
        if coefficient:
            part = differentials.of(tree)
            # numerator and denominator on their own stay exact in the interval program
            total = total + coefficient.numerator * part / coefficient.denominator
    return ca.cse(total)
