"""Vertices of a bounded polytope from its half-spaces, exactly, by walking along its edges.

A vertex of a simple polytope lies on exactly n faces; letting go of one of them leads along an edge
to a neighbour. The graph of vertices and edges is connected, so the walk sees every vertex, and
that the list is complete needs no further proof. Everything is computed in rational numbers.
"""

from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from obsynth.derive.errors import DerivationError

Vector = list[Fraction]
_STARTS = 24


class Degenerate(Exception):
    """More than n faces meet in a vertex, so that edges cannot be followed without a choice."""


def _solve(matrix: list[Vector]) -> list[Vector] | None:
    """Invert a small matrix of rational numbers; None if it is singular."""
    n = len(matrix)
    rows = [[*row, *(Fraction(int(i == j)) for j in range(n))] for i, row in enumerate(matrix)]
    for k in range(n):
        pivot = next((i for i in range(k, n) if rows[i][k] != 0), None)
        if pivot is None:
            return None
        rows[k], rows[pivot] = rows[pivot], rows[k]
        head = rows[k][k]
        rows[k] = [value / head for value in rows[k]]
        for i in range(n):
            factor = rows[i][k]
            if i != k and factor != 0:
                rows[i] = [a - factor * b for a, b in zip(rows[i], rows[k], strict=True)]
    return [row[n:] for row in rows]


def _dot(a: Sequence[Fraction], b: Sequence[Fraction]) -> Fraction:
    return sum((x * y for x, y in zip(a, b, strict=True)), Fraction(0))


def walk_vertices(normals: list[Vector], offsets: Vector) -> dict[tuple[int, ...], Vector]:
    """List the vertices of {x : normals x <= offsets}."""
    start = _start(normals, offsets)
    found: dict[tuple[int, ...], Vector] = {}
    stack = [start]
    while stack:
        active = stack.pop()
        if active in found:
            continue
        inverse = _solve([normals[i] for i in active])
        if inverse is None:
            raise Degenerate
        point = [_dot(row, [offsets[i] for i in active]) for row in inverse]
        slacks = [b - _dot(a, point) for a, b in zip(normals, offsets, strict=True)]
        if any(slack <= 0 for i, slack in enumerate(slacks) if i not in active):
            raise Degenerate
        found[active] = point
        for position, leaving in enumerate(active):
            along = [-row[position] for row in inverse]
            steps: list[tuple[Fraction, int]] = []
            for i, normal in enumerate(normals):
                rise = _dot(normal, along)
                if i not in active and rise > 0:
                    steps.append((slacks[i] / rise, i))
            if not steps:
                raise DerivationError(
                    "the half-spaces do not bound a polytope: an edge leads to infinity. Add "
                    "bounds of every coordinate",
                    direction=tuple(float(v) for v in along),
                )
            length, entering = min(steps)
            if sum(1 for step, _ in steps if step == length) > 1:
                raise Degenerate
            stack.append(tuple(sorted({*active, entering} - {leaving})))
    return found


def _start(normals: list[Vector], offsets: Vector) -> tuple[int, ...]:
    """Faces of some vertex, from a linear program in doubles, checked exactly."""
    from scipy.optimize import linprog

    matrix = np.array([[float(v) for v in row] for row in normals])
    right = np.array([float(v) for v in offsets])
    n = matrix.shape[1]
    rng = np.random.default_rng(0)
    for _ in range(_STARTS):
        result = linprog(rng.normal(size=n), matrix, right, bounds=(None, None), method="highs-ds")
        if result.status in (2, 3):
            what = "is empty" if result.status == 2 else "is not bounded"
            raise DerivationError(f"the polytope of these {len(right)} half-spaces {what}")
        if result.x is None:
            continue
        active = _independent(matrix, np.argsort(right - matrix @ result.x, kind="stable"))
        inverse = None if active is None else _solve([normals[i] for i in active])
        if active is None or inverse is None:
            continue
        point = [_dot(row, [offsets[i] for i in active]) for row in inverse]
        if all(_dot(a, point) <= b for a, b in zip(normals, offsets, strict=True)):
            return active
    raise Degenerate


def _independent(matrix: NDArray[np.float64], order: NDArray[np.intp]) -> tuple[int, ...] | None:
    chosen: list[int] = []
    for i in order.tolist():
        rows = matrix[[*chosen, i]]
        size = np.linalg.norm(rows, axis=1, keepdims=True)
        if np.linalg.matrix_rank(rows / np.where(size > 0.0, size, 1.0), tol=1e-9) > len(chosen):
            chosen.append(i)
        if len(chosen) == matrix.shape[1]:
            return tuple(sorted(chosen))
    return None
