"""Sufficient conditions that replace exponentially many vertices by a few per group.

What stands here implies the inequality at every vertex and may ask for more than that; the
loss is measured in ``benchmarks/lmi.py``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from obsynth.designs.lmi.expression import Affine, ExpressionError, constant, symmetric
from obsynth.designs.lmi.problem import Problem
from obsynth.designs.lmi.reductions import present_entries

__all__ = ["relax_sum"]

Matrix = NDArray[np.float64]


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

    Parameters
    ----------
    problem : Problem
        Blocks ``name`` and ``name.g`` are added, with variables ``name.Yg``.
    name : str
        Name of the inequality.
    centre : Affine, shape (n, n)
        Part without uncertainty.
    groups : sequence of Affine or ndarray, each (N_g, n, n)
        Deviations at the vertices of each group.

    Examples
    --------
    >>> t = symmetric("t", 1)
    >>> signs = np.array([[[1.0]], [[-1.0]]])
    >>> problem = Problem("interval")
    >>> relax_sum(problem, "sum", t, [2.0 * signs, 0.5 * signs])
    >>> problem.minimise(t)
    >>> round(problem.solve().objective, 5)
    2.5
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
