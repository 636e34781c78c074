"""Fewer and smaller matrix inequalities that say the same.

Everything here is exact: the reduced inequalities hold if and only if the given ones do.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import scipy.sparse as sparse
from numpy.typing import ArrayLike, NDArray

from obsynth.designs.lmi.expression import Affine, IntArray, symmetric
from obsynth.designs.lmi.problem import block
from obsynth.symbolic.errors import ObsynthError


@dataclass(frozen=True, eq=False)
class Extremes:
    """Extreme points by row, and weights of kept or dropped rows that give the others exactly."""

    kept: IntArray
    weights: Mapping[int, Mapping[int, Fraction]]


def extreme_points(points: ArrayLike) -> Extremes:
    """Drop points that are convex combinations of others, and what stands twice, exactly."""
    # Adding zero makes one zero of the two, so that equal rows have equal bytes.
    array = np.asarray(points, dtype=float) + 0.0
    if array.ndim != 2 or not np.isfinite(array).all():
        raise ObsynthError(f"points of shape {array.shape}: finite rows (N, k) are needed")
    _, first, inverse = np.unique(array, axis=0, return_index=True, return_inverse=True)
    weights: dict[int, Mapping[int, Fraction]] = {}
    for row, group in enumerate(inverse.ravel()):
        if first[group] != row:
            weights[row] = {int(first[group]): Fraction(1)}
    alive = sorted(int(i) for i in first)
    certain = _certainly_extreme(array, alive)
    for row in [i for i in alive if i not in certain]:
        others = [i for i in alive if i != row]
        combination = _midpoint(array, row, others) or _convex_combination(array, row, others)
        if combination is not None:
            weights[row] = combination
            alive = others
    return Extremes(np.array(alive, dtype=np.intp), weights)


@dataclass(frozen=True, eq=False)
class SplitFamily:
    """One common inequality, or None, one per vertex, its rows, and those that both share."""

    common: Affine | None
    members: Affine
    rows: IntArray
    shared: IntArray


def split_common(family: Affine, slack: str) -> SplitFamily:
    """Split the common rows of a family of inequalities ``F_i >= 0`` from those that vary.

    With J the rows that hold every entry that depends on i, and S the rows of J that the
    others K couple with, all F_i >= 0 if and only if some symmetric Z satisfies
    ``[Z, F_SK; F_KS, F_KK] >= 0`` and ``F_i[J, J] - Z >= 0`` for all i (Z in the rows S): the
    first forces Z above the Schur complement F_SK F_KK^+ F_KS, and this value serves all i.
    """
    n = family.shape[0]
    varies, present = _varying_entries(family), present_entries(family)
    varying = varies.any(axis=0) | varies.any(axis=1)
    rows, rest = np.flatnonzero(varying), np.flatnonzero(~varying)
    if not len(rest) or not len(rows):
        return SplitFamily(None, family, np.arange(n), np.zeros(0, dtype=np.intp))
    coupled = present[np.ix_(rows, rest)].any(axis=1)
    shared = rows[coupled]
    inner = _rows_of(family, rows)
    first = family.member(0)
    if not len(shared):
        return SplitFamily(_rows_of(first, rest), inner, rows, shared)
    Z = symmetric(slack, len(shared))
    place = np.eye(len(rows))[:, coupled]
    selected = first[shared, :][:, rest]
    common = block([[Z, selected], [selected.T, _rows_of(first, rest)]])
    return SplitFamily(common, inner - place @ Z @ place.T, rows, shared)


def _rows_of(expression: Affine, rows: IntArray) -> Affine:
    return expression[rows, :][:, rows]


def _varying_entries(family: Affine) -> NDArray[np.bool_]:
    """Entries that are not the same at all vertices."""
    n = family.shape[0]
    count = family.members or 1
    constant = family.constant.reshape(count, n, n)
    varies = (constant != constant[0]).any(axis=0)
    for operator in family.terms.values():
        first = sparse.csr_array(operator[: n * n])
        repeated = sparse.csr_array(sparse.kron(np.ones((count, 1)), first))
        difference = (operator - repeated).tocoo()
        changed = difference.row[difference.data != 0] % (n * n)
        varies[changed % n, changed // n] = True
    return np.asarray(varies | varies.T)


def present_entries(family: Affine) -> NDArray[np.bool_]:
    """Find the entries of a symmetric family that are not zero at all vertices."""
    n = family.shape[0]
    present = (family.constant.reshape(-1, n, n) != 0).any(axis=0)
    for operator in family.terms.values():
        entries = operator.tocoo()
        found = entries.row[entries.data != 0] % (n * n)
        present[found % n, found // n] = True
    return np.asarray(present | present.T)


def _certainly_extreme(points: NDArray[np.float64], rows: list[int]) -> set[int]:
    """Rows that alone maximise some direction, so that they need no closer look."""
    directions = np.random.default_rng(0).normal(size=(points.shape[1], 64 * points.shape[1]))
    heights = points[rows] @ directions
    return {rows[int(k)] for k in np.unique(heights.argmax(axis=0))}


def _midpoint(
    points: NDArray[np.float64], row: int, others: list[int]
) -> dict[int, Fraction] | None:
    """Two other rows with a given row exactly in the middle, as grids have them."""
    known = {points[i].tobytes(): i for i in others}
    mirrored = 2.0 * points[row] - points[others] + 0.0
    for first, mirror in zip(others, mirrored, strict=True):
        second = known.get(mirror.tobytes())
        if second is not None and all(
            Fraction(a) + Fraction(b) == 2 * Fraction(c)
            for a, b, c in zip(points[first], points[second], points[row], strict=True)
        ):
            half = Fraction(1, 2)
            return {first: half, second: half}
    return None


def _convex_combination(
    points: NDArray[np.float64], row: int, others: list[int]
) -> dict[int, Fraction] | None:
    """Exact weights of other rows that give a row, or None."""
    candidates = [others]
    while candidates:
        allowed = candidates.pop(0)
        support, columns, target = _support(points, row, allowed)
        if not support:
            continue
        weights = _exact_weights(columns, target, support)
        if weights is not None:
            return weights
        # Rounding spoils this combination; another one may be exact.
        if allowed is others:
            candidates = [[i for i in others if i != k] for k in support]
    return None


def _support(
    points: NDArray[np.float64], row: int, others: list[int]
) -> tuple[list[int], NDArray[np.float64], NDArray[np.float64]]:
    """Few rows of which a row is a convex combination up to rounding, none if there are none."""
    from scipy.optimize import linprog

    target = np.append(points[row], 1.0)
    columns = np.vstack([points[others].T, np.ones(len(others))])
    if len(others) < 2:
        return [], columns, target
    found = linprog(np.zeros(len(others)), A_eq=columns, b_eq=target, method="highs-ds")
    if not found.success:
        return [], columns, target
    used = np.flatnonzero(found.x > 1e-12)
    return [others[i] for i in used], columns[:, used], target


def _exact_weights(
    columns: NDArray[np.float64], target: NDArray[np.float64], rows: list[int]
) -> dict[int, Fraction] | None:
    """Solve for the weights on a support in rational arithmetic and check their signs."""
    from obsynth.derive.rigour import ExactMatrix

    system = ExactMatrix.of(np.column_stack([columns, target]))
    reduced, rank = system.entries.rref()
    count = len(rows)
    solution: list[Any] = [Fraction(0)] * count
    for i in range(rank):
        pivot = next(j for j in range(count + 1) if reduced[i, j] != 0)
        if pivot == count:
            return None
        value = reduced[i, count]
        solution[pivot] = Fraction(int(value.p), int(value.q))
    if any(weight < 0 for weight in solution):
        return None
    return {k: weight for k, weight in zip(rows, solution, strict=True) if weight}
