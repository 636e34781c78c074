"""Smaller matrix inequalities that say the same: they hold if and only if the given ones do."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from obsynth.designs.lmi.expression import Affine, IntArray, symmetric
from obsynth.designs.lmi.problem import block


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
