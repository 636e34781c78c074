"""Sufficient conditions that replace exponentially many vertices by a few per row.

What stands here implies the inequality at every vertex and may ask for more than that; the
loss is measured in ``lmi.py``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.designs.lmi.expression import (
    Affine,
    ExpressionError,
    Matrix,
    constant,
    full,
    scalar,
    symmetric,
)
from obsynth.designs.lmi.problem import Problem, block, he, transpose
from obsynth.designs.lmi.reductions import present_entries


@dataclass(frozen=True, eq=False)
class UncertainRow:
    """One row of an uncertain matrix: which of its entries are uncertain, and their corners.

    row: its number
    columns: columns of the uncertain entries
    corners: their values at the vertices of this row alone
    """

    row: int
    columns: tuple[int, ...]
    corners: Matrix

    @property
    def unit(self) -> float:
        """Power of two near the largest entry: s is measured in it, so that scales agree."""
        largest = float(np.abs(self.corners).max())
        return float(2.0 ** np.round(np.log2(largest))) if largest else 1.0

    @property
    def vertices(self) -> Matrix:
        """Corners in the unit, as a family of rows (N, 1, c) for :func:`corner_block`."""
        return self.corners[:, None, :] / self.unit


@dataclass(frozen=True, eq=False)
class RowMultipliers:
    """Multipliers that stand for ``rows s = M x`` with M anywhere in its box.

    For every M with rows between their corners, ``[x; s]' [Q, S; S', -R] [x; s] >= 0``.

    Q, S, R (n, n), (n, k), (k, k): in any arithmetic; k is the number of uncertain rows
    rows: puts s into the rows that are uncertain, times the unit of each
    """

    Q: Any
    S: Any
    R: Any
    rows: Matrix

    @classmethod
    def assemble(
        cls,
        uncertain: Sequence[UncertainRow],
        values: Mapping[str, Any],
        name: str,
        size: tuple[int, int],
        lift: Any,
    ) -> RowMultipliers:
        """Put the multipliers of single rows together, in the arithmetic of ``lift``."""
        n_rows, n = size
        Q: Any = 0
        columns: list[Any] = []
        for item in uncertain:
            place = np.eye(n)[:, list(item.columns)]
            Q = Q + lift(place) @ values[f"{name}.Q{item.row}"] @ lift(place.T)
            columns.append(lift(place) @ values[f"{name}.S{item.row}"])
        count = len(uncertain)
        diagonal = [
            [values[f"{name}.R{uncertain[i].row}"] if i == j else 0 for j in range(count)]
            for i in range(count)
        ]
        rows = np.zeros((n_rows, count))
        for k, item in enumerate(uncertain):
            rows[item.row, k] = item.unit
        return cls(Q, block([columns]), block(diagonal), rows)


def row_multipliers(
    problem: Problem, name: str, uncertain: Sequence[UncertainRow], size: tuple[int, int]
) -> RowMultipliers:
    """Multipliers for an uncertain matrix M, row by row (full-block S-procedure).

    An inequality in ``x`` and ``rows s = M x`` holds for every M if it holds for all x and s with
    ``[x; s]' [Q, S; S', -R] [x; s]`` subtracted, where the multipliers of every row r satisfy
    ``Q + S m' + m S' - R m m' >= 0`` at the corners m of that row: two to the number of
    uncertain entries *of one row* small inequalities, in place of two to their number in all.
    C. W. Scherer, "LPV control and full block multipliers", Automatica 37 (2001).
    """
    unknowns: dict[str, Affine] = {}
    for item in uncertain:
        count = len(item.columns)
        if item.corners.shape[1:] != (count,) or not count:
            raise ExpressionError(
                f"{name}: row {item.row} has corners of shape {item.corners.shape} for "
                f"{count} columns",
                row=item.row,
            )
        Q, S, R = (
            symmetric(f"{name}.Q{item.row}", count),
            full(f"{name}.S{item.row}", count, 1),
            scalar(f"{name}.R{item.row}"),
        )
        unknowns |= {f"{name}.Q{item.row}": Q, f"{name}.S{item.row}": S, f"{name}.R{item.row}": R}
        problem.add_lmi(f"{name}.{item.row}", corner_block(Q, S, R, item.vertices), ">>")
    return RowMultipliers.assemble(uncertain, unknowns, name, size, lambda matrix: matrix)


def corner_block(Q: Any, S: Any, R: Any, vertices: Any) -> Any:
    """Condition on the multipliers of one row at its corners, >= 0, in any arithmetic.

    Shapes: Q, S, R (c, c), (c, 1), (1, 1).
    """
    return Q + he(S @ vertices) - R * (transpose(vertices) @ vertices)


def relax_sum(
    problem: Problem, name: str, centre: Affine, groups: Sequence[Affine | Matrix]
) -> None:
    """State ``centre + sum_g G_g >= 0`` for every choice of a member from each group.

    With symmetric Y_g, ``G_g + Y_g >= 0`` at every member of g and
    ``centre - sum_g Y_g >= 0`` imply it: as many inequalities as the groups have members
    together, in place of their product. Y_g has only the rows that G_g has, which loses
    nothing. One group per row of an uncertain matrix gives the row relaxation; one group per
    uncertain entry the relaxation of A. Ben-Tal, A. Nemirovski, "On tractable approximations
    of uncertain linear matrix inequalities", SIAM J. Optim. 12 (2002).
    """
    n = centre.shape[0]
    remaining = centre
    for g, group in enumerate(map(constant, groups)):
        if group.shape != (n, n):
            raise ExpressionError(f"{name}: group {g} has shape {group.shape}, not {(n, n)}")
        rows = np.flatnonzero(present_entries(group).any(axis=0))
        if not len(rows):
            continue
        Y = symmetric(f"{name}.Y{g}", len(rows))
        place = np.eye(n)[:, rows]
        problem.add_lmi(f"{name}.{g}", group[rows, :][:, rows] + Y, ">>")
        remaining = remaining - place @ Y @ place.T
    problem.add_lmi(name, remaining, ">>")
