"""Exact proof that the printed LMI (51) has no solution: a fixed point of the error map.

At a vertex M of the Jacobian bounds take an augmented error ``ebar = (e, e_f)``
and a value ``s`` of the nonlinearity with

    C e = 0 ,   T (A e + B_f e_f + s) = e ,
    q1 = e'M e - s'e >= 0 ,   q2 = |M e|^2 - |s|^2 >= 0 .

No gain sees this error (C e = 0), and the error map sends it to itself, so V
does not change; yet s satisfies both inequalities that (51) allows it
(Assumptions 1 and 2). The quadratic form of (31) at this point with v = 0 is
``gamma V + 2 alpha q1 + beta q2 > 0`` for every gamma, alpha, beta > 0 and
every P, K: (51) is infeasible whatever the solver says.
"""

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from obsynth.symbolic.arrays import FloatArray


@dataclass(frozen=True)
class FixedPoint:
    """An error that no gain removes, in exact rational numbers.

    e, e_f, s: state error (n,), fault error (n_f,) and value of the nonlinearity (n,)
    q1, q2: the two quadratic constraints of (51) at this point; both are >= 0
    vertex: number of the vertex M at which they were evaluated
    """

    e: tuple[Fraction, ...]
    e_f: tuple[Fraction, ...]
    s: tuple[Fraction, ...]
    q1: Fraction
    q2: Fraction
    vertex: int

    def __str__(self) -> str:
        def row(values: tuple[Fraction, ...]) -> str:
            return "(" + ", ".join(str(value) for value in values) + ")"

        return (
            f"at vertex {self.vertex}: e = {row(self.e)}, e_f = {row(self.e_f)}, "
            f"s = {row(self.s)} is a fixed point of the error for every gain, with "
            f"q1 = {self.q1} and q2 = {self.q2}, both >= 0"
        )


def _fractions(values: Any) -> list[list[Fraction]]:
    array = np.atleast_2d(np.asarray(values, dtype=object))
    return [[Fraction(value) for value in row] for row in array]


def _times(matrix: list[list[Fraction]], vector: list[Fraction]) -> list[Fraction]:
    return [sum((a * b for a, b in zip(row, vector, strict=True)), Fraction(0)) for row in matrix]


def _dot(a: list[Fraction], b: list[Fraction]) -> Fraction:
    return sum((x * y for x, y in zip(a, b, strict=True)), Fraction(0))


def verify_fixed_point(
    A: Any,
    B_f: Any,
    C: Any,
    T: Any,
    M: Any,
    e: tuple[Fraction, ...],
    e_f: tuple[Fraction, ...],
    s: tuple[Fraction, ...],
) -> tuple[Fraction, Fraction] | None:
    """Check a fixed point in exact arithmetic."""
    A, B_f, C, T, M = (_fractions(matrix) for matrix in (A, B_f, C, T, M))
    error, fault, value = list(e), list(e_f), list(s)
    if not any(error) or any(_times(C, error)):
        return None
    parts = zip(_times(A, error), _times(B_f, fault), value, strict=True)
    if _times(T, [a + b + c for a, b, c in parts]) != error:
        return None
    Me = _times(M, error)
    q1 = _dot(error, Me) - _dot(value, error)
    q2 = _dot(Me, Me) - _dot(value, value)
    return (q1, q2) if q1 >= 0 and q2 >= 0 else None


def _solution_space(A: Any, B_f: Any, C: Any, T: Any) -> list[list[Fraction]]:
    """Basis of all (e, e_f, s) with C e = 0 and T (A e + B_f e_f + s) = e, exactly."""
    T, A, B_f, C = (np.array(_fractions(m), dtype=object) for m in (T, A, B_f, C))
    n, n_f, m = A.shape[0], B_f.shape[1], C.shape[0]
    eye = np.array([[Fraction(int(i == j)) for j in range(n)] for i in range(n)], dtype=object)
    rows = np.full((m + n, 2 * n + n_f), Fraction(0), dtype=object)
    rows[:m, :n] = C
    rows[m:, :n] = T @ A - eye
    rows[m:, n : n + n_f] = T @ B_f
    rows[m:, n + n_f :] = T
    return _null_space(rows)


def _null_space(rows: Any) -> list[list[Fraction]]:
    from flint import fmpq, fmpq_mat

    m, n = rows.shape
    matrix = fmpq_mat(m, n, [fmpq(v.numerator, v.denominator) for v in rows.ravel()])
    reduced, rank = matrix.rref()
    pivots = [next(j for j in range(n) if reduced[i, j] != 0) for i in range(rank)]
    basis = []
    for free in (j for j in range(n) if j not in pivots):
        vector = [Fraction(0)] * n
        vector[free] = Fraction(1)
        for i, pivot in enumerate(pivots):
            entry = reduced[i, free]
            vector[pivot] = -Fraction(int(entry.p), int(entry.q))
        basis.append(vector)
    return basis


def find_fixed_point(
    A: Any,
    B_f: Any,
    C: Any,
    T: Any,
    vertices: Any,
    seed: int = 0,
    starts: int = 12,
) -> FixedPoint | None:
    """Search every vertex for a fixed point that makes (51) infeasible.

    Shapes: vertices (N, n, n).

    The largest ``min(q1, q2)`` over the exact space of solutions is searched
    numerically; its coordinates are then rounded to short rationals and the
    conditions are checked in exact arithmetic.
    """
    from scipy.optimize import minimize

    space = _solution_space(A, B_f, C, T)
    if not space:
        return None
    n, n_f = len(_fractions(A)), len(_fractions(B_f)[0])
    basis = np.array([[float(value) for value in row] for row in space]).T
    rng = np.random.default_rng(seed)
    numeric = [
        np.array([[float(v) for v in row] for row in _fractions(M)], dtype=float) for M in vertices
    ]
    # directions that do not move e only cost |s|^2: start without them
    moves = np.abs(basis[:n]).max(axis=0)
    for _ in range(starts):
        c0 = np.where(moves > 0, rng.standard_normal(len(space)) / np.maximum(moves, 1e-3), 0.0)
        for number, M in enumerate(numeric):
            found = minimize(
                _shortfall, c0, (basis, M, n_f), method="Nelder-Mead", options={"maxfev": 400}
            )
            if found.fun >= 0.0:
                continue
            data = (A, B_f, C, T, vertices[number])
            point = _rounded_point(found.x, space, n, n_f, data, number)
            if point is not None:
                return point
    return None


def _shortfall(c: FloatArray, basis: FloatArray, M: FloatArray, n_f: int) -> float:
    """Return ``-min(q1, q2)``, each relative to ``|e|`` and the size of M."""
    vector = basis @ c
    n = len(M)
    e, s = vector[:n], vector[n + n_f :]
    length = float(e @ e)
    if length < 1e-12:
        return 1.0
    Me = M @ e
    unit = max(float(np.abs(M).max()), 1e-12)
    q1, q2 = float(e @ Me - s @ e) / length, float(Me @ Me - s @ s) / length
    return -min(q1 / unit, q2 / unit**2)


def _rounded_point(
    c: FloatArray,
    space: list[list[Fraction]],
    n: int,
    n_f: int,
    data: tuple[Any, Any, Any, Any, Any],
    vertex: int,
) -> FixedPoint | None:
    """Round the coordinates to ever longer rationals until the exact check passes."""
    largest = float(np.abs(c).max())
    for denominator in (10, 100, 1000, 10**4, 10**6, 10**9):
        coordinates = [Fraction(float(x / largest)).limit_denominator(denominator) for x in c]
        vector = [
            sum((q * row[i] for q, row in zip(coordinates, space, strict=True)), Fraction(0))
            for i in range(2 * n + n_f)
        ]
        unit = max(vector[:n], key=abs)
        if unit == 0:
            continue
        vector = [value / unit for value in vector]
        e, e_f, s = tuple(vector[:n]), tuple(vector[n : n + n_f]), tuple(vector[n + n_f :])
        quadratics = verify_fixed_point(*data, e, e_f, s)
        if quadratics is not None:
            return FixedPoint(e, e_f, s, *quadratics, vertex)
    return None
