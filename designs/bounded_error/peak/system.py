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
from numpy.typing import ArrayLike

from obsynth.derive.rigour import Enclosure, ExactMatrix
from obsynth.designs.bounded_error.peak.channels import Channels, split_channels
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

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

    Buciakowski et al., "A bounded-error approach to simultaneous state and
    actuator fault estimation for a class of nonlinear systems", eqs. (10)-(16).
    """
    A = _array("A", A, 2)
    n = A.shape[0]
    C = _array("C", C, 2)
    m = C.shape[0]
    B_f, D, W1 = (_columns(k, v, n) for k, v in (("B_f", B_f), ("D", D), ("W1", W1)))
    n_f, q, n_w = B_f.shape[1], D.shape[1], W1.shape[1]
    W2, K, F = _columns("W2", W2, m), _columns("K", K, n), _array("F", F, 2).reshape(-1, m)
    constant = _array("constant", constant, 2)
    directions = _array("directions", directions, 3).reshape(-1, n, n)
    ranges = _array("ranges", ranges, 2).reshape(-1, 2)
    radius = np.zeros((n, n)) if radius is None else _array("radius", radius, 2)
    E = _decoupling(C, D) if E is None else _columns("E", E, n)
    expected = {
        "A": (A, (n, n)),
        "C": (C, (m, n)),
        "W2": (W2, (m, n_w)),
        "K": (K, (n, m)),
        "F": (F, (n_f, m)),
        "E": (E, (n, m)),
        "constant": (constant, (n, n)),
        "ranges": (ranges, (directions.shape[0], 2)),
        "radius": (radius, (n, n)),
    }
    for name, (value, shape) in expected.items():
        if value.shape != shape:
            raise ObsynthError(
                f"{name} has shape {value.shape}; with {n} states, {m} outputs, {n_f} faults, {q} "
                f"unknown inputs and {n_w} disturbances it has to be {shape}",
                argument=name,
                shape=value.shape,
                expected=shape,
            )
    if np.any(ranges[:, 0] > ranges[:, 1]):
        worst = int(np.argmax(ranges[:, 0] - ranges[:, 1]))
        raise ObsynthError(
            f"ranges[{worst}] = {ranges[worst].tolist()} is empty: lower bound first", index=worst
        )
    if np.any(radius < 0):
        raise ObsynthError("radius has a negative entry; it is a bound of an absolute value")

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
    eE, eC = of(_array("E", E, 2)), of(_array("C", C, 2))
    T = of(np.eye(eE.shape[0])) + eE @ eC
    Pi = of(np.eye(eC.shape[0])) + eC @ eE
    F = _array("F", F, 2).reshape(-1, eC.shape[0])
    return Enclosure.of(T @ of(_array("K", K, 2)) @ Pi).mid, Enclosure.of(of(F) @ Pi).mid


def _array(name: str, value: ArrayLike, dimensions: int) -> FloatArray:
    array = np.asarray(value, dtype=float)
    if array.ndim != dimensions and array.size:
        raise ObsynthError(
            f"{name} has {array.ndim} dimensions, it has to have {dimensions}", argument=name
        )
    if not np.all(np.isfinite(array)):
        where = np.argwhere(~np.isfinite(array))[0].tolist()
        raise ObsynthError(f"{name}{where} = {array[tuple(where)]} is not finite", argument=name)
    return array


def _columns(name: str, value: ArrayLike, rows: int) -> FloatArray:
    array = _array(name, value, 2)
    if array.size == 0:
        return np.zeros((rows, 0))
    if array.shape[0] != rows:
        raise ObsynthError(
            f"{name} has shape {array.shape}; it has to have {rows} rows",
            argument=name,
            shape=array.shape,
        )
    return array


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
