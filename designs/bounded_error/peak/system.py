"""The error system behind the peak (l1) bounds of the bounded-error observer.

The plant is ``x+ = A x + B u + D d + B_f f + g(x, u) + W1 w``, ``y = C x + W2 w``,
``f+ = f + eps``; the observer, with ``T = I + E C``,

    z+ = T (A xhat + B u + B_f fhat + g(xhat, u)) + K (y - C xhat),  xhat = z - E y,
    fhat+ = fhat + F (y - C xhat).

Put zeta = T x - z and e_f = f - fhat. Then x - xhat = zeta + E W2 w, in which
only the present w occurs, and with g(x, u) - g(xhat, u) = M_k (x - xhat)

    zeta+ = (T (A + M_k) - K C) zeta + T B_f e_f
            + (T (A + M_k) E W2 + T W1 - K Pi W2) w + T D d,          Pi = I + C E,
    e_f+  = e_f - F C zeta - F Pi W2 w + eps.

Nothing here uses T T = T or T D = 0, so the system is right for an E that had
to be rounded; T D is formed exactly and, where it is not zero, remains as an
input (Buciakowski et al., eqs. (10)-(16), with the error shifted by E y).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from obsynth.derive.rigour import Enclosure, ExactMatrix
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Channels:
    """Rank-one uncertainties ``delta_j b_j c_j'``, ``|delta_j| <= r_j``, of the Jacobian.

    columns: the b_j
    rows: the c_j'
    radii: the r_j, rounded up
    source: which direction of the affine family a channel comes from. A direction that is not of
        rank one makes one channel for each of its columns
    """

    columns: FloatArray
    rows: FloatArray
    radii: FloatArray
    source: IntArray

    def __len__(self) -> int:
        return int(self.radii.size)


def split_channels(directions: FloatArray, ranges: FloatArray, middle: FloatArray) -> Channels:
    """Turn the directions of an affine family into rank-one channels, without rounding."""
    n = directions.shape[-1]
    columns, rows, radii, source = [], [], [], []
    half = np.maximum(ranges[:, 1] - middle, middle - ranges[:, 0])
    for k, direction in enumerate(directions):
        if ranges[k, 0] == ranges[k, 1] or not np.any(direction):
            continue
        for column, row in _rank_one_parts(direction):
            columns.append(column)
            rows.append(row)
            radii.append(np.nextafter(half[k], np.inf))
            source.append(k)
    return Channels(
        columns=np.array(columns).reshape(-1, n).T,
        rows=np.array(rows).reshape(-1, n),
        radii=np.array(radii),
        source=np.array(source, dtype=np.int64),
    )


def _rank_one_parts(direction: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Split a matrix into b c' without rounding: one part where that is exact, else columns."""
    i, j = np.unravel_index(np.argmax(np.abs(direction)), direction.shape)
    column, row, pivot = direction[:, j], direction[i], direction[i, j]
    given = ExactMatrix.of(direction).to_fractions()
    for left, right in ((column, row / pivot), (column / pivot, row)):
        product = ExactMatrix.of(left[:, None]) @ ExactMatrix.of(right[None, :])
        if product.to_fractions() == given:
            return [(left, right)]
    eye = np.eye(direction.shape[1])
    return [(direction[:, k], eye[k]) for k in np.flatnonzero(np.any(direction, axis=0))]


DATA = (
    *("A", "B_f", "C", "D", "W1", "W2", "E", "K", "F"),
    *("constant", "directions", "ranges", "radius"),
)


@dataclass(frozen=True, eq=False)
class PeakSystem:
    """The error system at the midpoint of the Jacobians, enclosed, and its uncertainty.

    With N = n + n_f and xi = [zeta; e_f],

        xi+ = (A0 + sum_j delta_j B_p,j c_j' [I 0]) xi + B_w w + [0; I] eps + ...

    The outputs are the N errors [x - xhat; e_f], followed by ``c_j' (x - xhat)``
    for every channel whose row has more than one entry: bounding those directly
    is narrower than adding up bounds of the single errors.

    A, B_f, C, D, W1, W2, E, K, F: the data, shapes (n, n), (n, n_f), (m, n), (n, q), (n, n_w), (m,
        n_w), (n, m), (n, m), (n_f, m)
    constant, directions, ranges, radius: the affine family of Jacobians, shapes (n, n), (k, n, n),
        (k, 2), (n, n)
    T: ``I + E C``. An observer that runs with ``T.mid`` has to count ``T.rad |A xhat + ...|`` among
        its rounding errors
    residual: at least ``|T D|``; zero where the decoupling is exact
    A0, B_w, B_p, B_m, D_w: shapes (N, N), (N, n_w), (N, J), (N, n), (N, n_w): the system at the
        midpoint, the inputs of w, of the channels and of an entrywise uncertainty, and the
        feedthrough ``[E W2; 0]`` of w to the errors
    outputs: rows of the outputs
    seen: ``|c_j' (x - xhat)| <= seen_j p`` where p bounds the outputs
    """

    A: FloatArray
    B_f: FloatArray
    C: FloatArray
    D: FloatArray
    W1: FloatArray
    W2: FloatArray
    E: FloatArray
    K: FloatArray
    F: FloatArray
    constant: FloatArray
    directions: FloatArray
    ranges: FloatArray
    radius: FloatArray
    T: Enclosure
    residual: FloatArray
    A0: Enclosure
    B_w: Enclosure
    B_p: Enclosure
    B_m: Enclosure
    D_w: Enclosure
    channels: Channels
    outputs: FloatArray
    seen: FloatArray

    @property
    def n(self) -> int:
        """Number of states."""
        return int(self.A.shape[0])

    @property
    def n_f(self) -> int:
        """Number of faults."""
        return int(self.B_f.shape[1])

    @property
    def data(self) -> dict[str, FloatArray]:
        """Everything that `peak_system` needs to form the same system again."""
        return {name: getattr(self, name) for name in DATA}

    def with_gains(self, K: ArrayLike, F: ArrayLike) -> PeakSystem:
        """Return the system of the same plant with other gains."""
        return peak_system(**{**self.data, "K": K, "F": F})


def peak_system(
    *,
    A: ArrayLike,
    B_f: ArrayLike,
    C: ArrayLike,
    D: ArrayLike,
    W1: ArrayLike,
    W2: ArrayLike,
    K: ArrayLike,
    F: ArrayLike,
    constant: ArrayLike,
    directions: ArrayLike,
    ranges: ArrayLike,
    radius: ArrayLike | None = None,
    E: ArrayLike | None = None,
) -> PeakSystem:
    """Form the error system of an observer in exact arithmetic and round it with its error.

    Buciakowski et al., eqs. (10)-(16). The numbers are those of a record that was read; see
    `UioDesign` for the shapes.
    """
    A, C, constant = (np.asarray(v, dtype=float) for v in (A, C, constant))
    n, m = len(A), len(C)
    B_f, D, W1, K = (np.asarray(v, dtype=float).reshape(n, -1) for v in (B_f, D, W1, K))
    W2, F = np.asarray(W2, dtype=float).reshape(m, -1), np.asarray(F, dtype=float).reshape(-1, m)
    n_f, n_w = B_f.shape[1], W1.shape[1]
    directions = np.asarray(directions, dtype=float).reshape(-1, n, n)
    ranges = np.asarray(ranges, dtype=float).reshape(-1, 2)
    radius = np.zeros((n, n)) if radius is None else np.asarray(radius, dtype=float)
    E = _decoupling(C, D) if E is None else np.asarray(E, dtype=float)
    middle = ranges.mean(axis=1)
    channels = split_channels(directions, ranges, middle)
    of = ExactMatrix.of
    eA, eB, eC, eD, eE, eK, eF, eW1, eW2 = (of(v) for v in (A, B_f, C, D, E, K, F, W1, W2))
    jacobian = of(constant)
    for value, direction in zip(middle, directions, strict=True):
        jacobian = jacobian + of(value) * of(direction)
    T = of(np.eye(n)) + eE @ eC
    Pi_W2 = eW2 + eC @ (eE @ eW2)
    TA = T @ (eA + jacobian)
    outputs, seen = _outputs(channels, n, n_f)
    return PeakSystem(
        A=A,
        B_f=B_f,
        C=C,
        D=D,
        W1=W1,
        W2=W2,
        E=E,
        K=K,
        F=F,
        constant=constant,
        directions=directions,
        ranges=ranges,
        radius=radius,
        T=Enclosure.of(T),
        residual=_magnitude(Enclosure.of(T @ eD)),
        A0=_blocks([[TA - eK @ eC, T @ eB], [-(eF @ eC), of(np.eye(n_f))]]),
        B_w=_blocks([[TA @ (eE @ eW2) + T @ eW1 - eK @ Pi_W2], [-(eF @ Pi_W2)]]),
        B_p=_blocks([[T @ of(channels.columns)], [of(np.zeros((n_f, len(channels))))]]),
        B_m=_blocks([[T], [of(np.zeros((n_f, n)))]]),
        D_w=_blocks([[eE @ eW2], [of(np.zeros((n_f, n_w)))]]),
        channels=channels,
        outputs=outputs,
        seen=seen,
    )


def projected_gains(
    K: ArrayLike, F: ArrayLike, E: ArrayLike, C: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Return ``T K Pi`` and ``F Pi``, the part of the gains that has an effect.

    From the second instant on the innovation lies in the range of Pi, and what
    a gain adds outside the range of T only keeps alive an error that the
    decoupling would have removed.
    """
    of = ExactMatrix.of
    eE, eC = of(np.asarray(E)), of(np.asarray(C))
    T = of(np.eye(eE.shape[0])) + eE @ eC
    Pi = of(np.eye(eC.shape[0])) + eC @ eE
    F = np.asarray(F, dtype=float).reshape(-1, eC.shape[0])
    return Enclosure.of(T @ of(np.asarray(K, dtype=float)) @ Pi).mid, Enclosure.of(of(F) @ Pi).mid


def _decoupling(C: FloatArray, D: FloatArray) -> FloatArray:
    q = D.shape[1]
    if q == 0:
        return np.zeros(C.T.shape)
    CD = C @ D
    if np.linalg.matrix_rank(CD) < q:
        raise ObsynthError(
            f"rank(C D) is {np.linalg.matrix_rank(CD)}, but there are {q} unknown inputs: one of "
            "them does not reach the outputs in one step; measure a state that it enters",
            rank=int(np.linalg.matrix_rank(CD)),
            required=q,
        )
    return np.asarray(-D @ np.linalg.solve(CD.T @ CD, CD.T))


def _blocks(rows: Sequence[Sequence[ExactMatrix]]) -> Enclosure:
    table = [[Enclosure.of(cell) for cell in row] for row in rows]
    mid = np.block([[cell.mid for cell in row] for row in table])
    rad = np.block([[cell.rad for cell in row] for row in table])
    return Enclosure(mid, rad)


def _magnitude(value: Enclosure) -> FloatArray:
    total: FloatArray = np.abs(value.mid) + value.rad
    return np.where(value.rad > 0, np.nextafter(total, np.inf), total)


def _outputs(channels: Channels, n: int, n_f: int) -> tuple[FloatArray, FloatArray]:
    """Return the rows of the outputs and how the channels see them."""
    size = n + n_f
    several = [j for j, row in enumerate(channels.rows) if np.count_nonzero(row) > 1]
    outputs = np.zeros((size + len(several), size))
    outputs[:size] = np.eye(size)
    outputs[size:, :n] = channels.rows[several]
    seen = np.zeros((len(channels), len(outputs)))
    seen[:, :n] = np.abs(channels.rows)
    for position, j in enumerate(several):
        seen[j] = 0.0
        seen[j, size + position] = 1.0
    return outputs, seen
