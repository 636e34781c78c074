"""Decoupling of the unknown input: the matrices E, T and Pi, computed exactly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.derive.errors import StructureError
from obsynth.symbolic.arrays import FloatArray


def _exact(values: Any) -> Any:
    """Return the exact rational matrix of an array of doubles (`flint.fmpq_mat`)."""
    from flint import fmpq, fmpq_mat

    array = np.atleast_2d(np.asarray(values, dtype=float))
    rows, columns = array.shape
    entries = [fmpq(*float(value).as_integer_ratio()) for value in array.ravel()]
    return fmpq_mat(rows, columns, entries)


def _rounded(matrix: Any) -> FloatArray:
    """Return the nearest doubles of an exact rational matrix."""
    rows, columns = matrix.nrows(), matrix.ncols()
    return np.array(
        [[int(matrix[i, j].p) / int(matrix[i, j].q) for j in range(columns)] for i in range(rows)],
        dtype=float,
    ).reshape(rows, columns)


@dataclass(frozen=True, eq=False)
class Decoupling:
    """Matrices that remove the unknown input from the estimation error.

    Attributes
    ----------
    E : ndarray of shape (n, m)
        Eq. (13), as stored.
    T : ndarray of shape (n, n)
        ``I + E C`` rounded to doubles.
    Pi : ndarray of shape (m, m)
        ``I + C E`` rounded to doubles.
    rank : int
        Rank of D and of C D: the number q of unknown inputs.
    residual : float
        Largest entry of ``|(I + E C) D|`` for the stored doubles, computed
        exactly: 0 where the decoupling is exact.
    projector : bool
        Whether ``I + E C`` of the stored doubles is exactly a projector and
        equal to `T`.
    """

    E: FloatArray
    T: FloatArray
    Pi: FloatArray
    rank: int
    residual: float
    projector: bool


def decouple(C: FloatArray, D: FloatArray) -> Decoupling:
    """Compute E, T and Pi in exact arithmetic and round them to doubles.

    Parameters
    ----------
    C : ndarray of shape (m, n)
    D : ndarray of shape (n, q)
        With ``rank(C D) = q``; q = 0 gives E = 0.

    Returns
    -------
    Decoupling

    Raises
    ------
    StructureError
        If C D has no full column rank.

    Notes
    -----
    Buciakowski et al., eqs. (13)-(14).

    Examples
    --------
    >>> import numpy as np
    >>> d = decouple(np.eye(2), np.array([[0.0], [1.0]]))
    >>> d.T.tolist(), d.residual
    ([[1.0, 0.0], [0.0, 0.0]], 0.0)
    """
    from flint import fmpq_mat

    C = np.asarray(C, dtype=float)
    m, n = C.shape
    q = D.shape[1]
    if q == 0:
        return Decoupling(np.zeros((n, m)), np.eye(n), np.eye(m), 0, 0.0, True)
    exact_C, exact_D = _exact(C), _exact(D)
    CD = exact_C * exact_D
    gram = CD.transpose() * CD
    if gram.det() == 0:
        raise StructureError(
            f"rank(C D) is {CD.rank()} but there are {q} unknown inputs: an unknown input does "
            "not reach the outputs within one step, so it cannot be decoupled; measure a state "
            "that it enters",
            rank=CD.rank(),
            required=q,
        )
    E = _rounded(exact_D * gram.inv() * CD.transpose() * -1)
    exact_E = _exact(E)
    eye_n = fmpq_mat(n, n, [int(i == j) for i in range(n) for j in range(n)])
    eye_m = fmpq_mat(m, m, [int(i == j) for i in range(m) for j in range(m)])
    exact_T = eye_n + exact_E * exact_C
    T = _rounded(exact_T)
    Pi = _rounded(eye_m + exact_C * exact_E)
    residual = float(np.max(np.abs(_rounded(exact_T * exact_D)), initial=0.0))
    projector = exact_T * exact_T == exact_T and _exact(T) == exact_T
    return Decoupling(E, T, Pi, q, residual, bool(projector))
