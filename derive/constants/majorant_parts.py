"""The pieces of a majorant: one row of g, or rows that share states."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import sympy as sp

from obsynth.derive.algebra.connected import connected
from obsynth.derive.constants.eigenvalue_search import Maximum
from obsynth.derive.constants.matrix_maximum import matrix_maximum
from obsynth.derive.errors import DerivationError, UnboundedError
from obsynth.derive.jacobian.matrix_entries import MatrixEntries, matrix_entries
from obsynth.derive.rigour import rational, up
from obsynth.symbolic.arrays import FloatArray

UP = 1.0 + 2.0**-50
"""Covers the rounding of a few operations."""


@dataclass(frozen=True, eq=False)
class RowMajorant:
    """phi^2 <= e' R e for one row of g: phi = g_i(a) - g_i(b), e = a - b, R diagonal.

    entries (n,): guaranteed bounds of |dg_i/dx_j|; largest: sup of sum_j (dg_i/dx_j)^2 / R_jj, at
    most 1
    """

    row: int
    diagonal: FloatArray
    entries: FloatArray
    largest: Maximum


def is_rounding(entry: sp.Expr, coefficient: float) -> bool:
    """Tell whether an entry is only what the rounding of A left over."""
    if entry == 0 or entry.free_symbols or coefficient == 0.0:
        return False
    return bool(abs(sp.N(entry, 30)) <= 2.0**-52 * abs(coefficient))


def connected_groups(sizes: FloatArray) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Collect rows and columns that hang together."""
    groups = sorted(connected(np.flatnonzero(row).tolist() for row in sizes))
    return [
        (tuple(rows), tuple(np.flatnonzero(sizes[rows].any(axis=0)).tolist()))
        for rows in groups
        if sizes[rows].any()
    ]


def largest_value(
    expression: ca.SX, entries: MatrixEntries, rtol: float, effort: str, method: str
) -> Maximum:
    """Bound the largest value of an expression in the entries."""
    found = entries.search(rtol, effort, expression)
    for failure in found.failures:
        rows = tuple(sorted({entries.model.names("x")[i] for i, _ in entries.places}))
        raise UnboundedError(
            f"no finite bound for the {method} of the row of {', '.join(rows)} "
            f"({failure.operation}); scale the states, or keep their ranges smaller",
            entries=rows,
            operation=failure.operation,
            sub_box=failure.box(entries.names),
        )
    return Maximum(
        float(found.upper[0]),
        float(found.attained_upper[0]),
        entries.named(found.points_upper[0]),
        found.status_upper[0],
        method,
        found.boxes,
    )


def row_majorant(
    entries: MatrixEntries,
    sizes: FloatArray,
    row: int,
    fixed: Mapping[int, float],
    names: tuple[str, ...],
    rtol: float,
    effort: str,
) -> RowMajorant:
    """Find R of one row: the smallest multiple of a direction, some elements fixed."""
    chosen = entries.take([k for k, place in enumerate(entries.places) if place[0] == row])
    values = {j: chosen.values[k] for k, (_, j) in enumerate(chosen.places)}
    free = [j for j in values if j not in fixed]
    taken = sum((values[j] ** 2 / d for j, d in fixed.items()), ca.SX(0))
    diagonal = np.zeros(len(sizes))
    for j, d in fixed.items():
        diagonal[j] = d
    if fixed:
        share = largest_value(taken, chosen, rtol, effort, "range of the fixed part")
        if share.upper > 1.0 or (free and share.upper >= 1.0):
            listed = ", ".join(f"{names[j]}: {d:.6g}" for j, d in fixed.items())
            raise DerivationError(
                f"the fixed elements ({listed}) are too small for the row of {names[row]}: "
                f"sum of a_j^2 / d_j reaches {share.attained:.6g}; multiply them by more than "
                "that, or leave one of them free",
                symbols=tuple(names[j] for j in fixed),
                row=names[row],
                factor=share.upper,
            )
        if not free:
            return RowMajorant(row, diagonal, sizes, share)
    # in units of the largest entry, a power of two: squares neither overflow nor vanish
    unit = 2.0 ** (int(np.frexp(sizes[free].max())[1]) - 1)
    parts = np.maximum(sizes / unit, 2.0**-200)
    direction = {j: float(parts[j]) * float(parts[free].sum()) for j in free}
    wanted = sum(((values[j] / unit) ** 2 / direction[j] for j in free), ca.SX(0))
    if fixed:
        wanted = wanted / (1 - taken)
    found = largest_value(wanted, chosen, rtol, effort, "range of sum_j a_j^2 / d_j")
    for j in free:
        diagonal[j] = up(found.upper * direction[j] * UP * unit * unit)
    # with S the free part and B the fixed one, S / (1 - B) = t at the point of the largest value
    # gives S / t + B = 1 for t itself, and at least attained / t for what is attained
    return RowMajorant(row, diagonal, sizes, scaled(found, 1.0 / (found.upper * UP)))


def scaled(found: Maximum, factor: float) -> Maximum:
    """Return a maximum of at most 1 times a factor."""
    upper = min(1.0, found.upper * factor * UP)
    return replace(found, upper=upper, attained=found.attained * factor / UP)


def largest_together(
    entries: MatrixEntries,
    sizes: FloatArray,
    rows: tuple[int, ...],
    diagonal: FloatArray,
    rtol: float,
    effort: str,
) -> Maximum:
    """Bound the largest eigenvalue of D^(-1/2) J'J D^(-1/2), D the diagonal given, rows given."""
    n = len(diagonal)
    scale = {j: float(1.0 / np.sqrt(d)) for j, d in enumerate(diagonal) if d > 0.0}
    scaled = {
        (i, n + j): expression * rational(scale[j])
        for (i, j), expression in entries.exact.items()
        if i in rows
    }
    chosen = matrix_entries(scaled, entries.model)
    ranges = chosen.ranges(min(rtol, 1e-6), effort, "scaled dg/dx")
    norm = matrix_maximum(chosen, ranges, np.zeros((2 * n, 2 * n)), None, rtol, effort)
    return replace(norm, upper=norm.upper**2 * UP, attained=max(norm.attained, 0.0) ** 2 / UP)
