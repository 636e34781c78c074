"""The coordinates z = S x in which the bounds move, and the plant in them.

    z' = D z + (S A - D S - L C) x + L (C x) + S (B u + offset + G theta + W1 w)

for any S, D and L: docs/methods/set_adaptive_observer.md, Other coordinates.
"""

from dataclasses import dataclass
from typing import Annotated

import casadi as ca
import numpy as np

from obsynth.derive.rigour import exact, inverse, nearest
from obsynth.designs.core.errors import CertificateError
from obsynth.designs.core.record import Record
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError


@dataclass(frozen=True, eq=False)
class Coordinates(Record):
    """What is stored of coordinates: S and D of the equation above.

    rate, input_rate: ranges of the derivatives of all states, as those of the outputs in `System`
    """

    S: Annotated[FloatArray, "n n"]
    D: Annotated[FloatArray, "n n"]
    rate: Annotated[FloatArray, "n 2"]
    input_rate: Annotated[FloatArray, "n n_u"]

    def check(self) -> None:
        """Refuse coordinates that do not tell the states apart."""
        try:
            inverse(exact(self.S))
        except ObsynthError as error:
            raise CertificateError("S of the stored design has no inverse") from error


@dataclass(frozen=True, eq=False)
class Frame:
    """The plant in the coordinates of the bounds: exact in S, L and D, every number rounded once.

    C (m, n), G (n, n_f), W1 (n, n_w): of z, C S^-1, S G and S W1
    back, own (n, n): S^-1 and D S + L C, by what A differs from which the drive is
    """

    C: FloatArray
    G: FloatArray
    W1: FloatArray
    back: FloatArray | None = None
    own: FloatArray | None = None


def read_coordinates(rows: tuple[tuple[float, ...], ...], names: tuple[str, ...]) -> None:
    """Refuse an S that is not square, or that does not tell the states apart."""
    S, n = np.array(rows), len(names)
    if S.shape != (n, n):
        raise ObsynthError(
            f"coordinates has shape {S.shape}; S of z = S x has a row and a column for each of "
            f"{', '.join(names)}",
            option="coordinates",
        )
    try:
        inverse(exact(S))
    except ObsynthError as error:
        raise ObsynthError(
            f"coordinates do not tell {', '.join(names)} apart: S has no inverse",
            option="coordinates",
        ) from error


def build_frame(
    C: FloatArray, G: FloatArray, W1: FloatArray, L: FloatArray, given: Coordinates | None
) -> Frame:
    """Return the frame of a plant's own coordinates, or of others."""
    if given is None:
        return Frame(C, G, W1)
    S, D = exact(given.S), exact(given.D)
    back, shown = inverse(S), exact(C)
    rows = (shown @ back, S @ exact(G), S @ exact(W1), back, D @ S + exact(L) @ shown)
    return Frame(*map(nearest, rows))


def image(matrix: FloatArray, low: ca.SX, high: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return the ends of M a for every a between two ends, columns or matrices."""
    plus, minus = ca.DM(np.maximum(matrix, 0.0)), ca.DM(np.minimum(matrix, 0.0))
    return plus @ low + minus @ high, plus @ high + minus @ low


def carried(
    matrix: FloatArray | None, low: ca.SX, high: ca.SX, share: float
) -> tuple[ca.SX, ca.SX]:
    """Return the ends of M a outside of what rounding may do, a share of the terms' magnitudes."""
    if matrix is None:
        return low, high
    first, second = image(matrix, low, high)
    slack = share * (ca.DM(np.abs(matrix)) @ ca.fmax(ca.fabs(low), ca.fabs(high)))
    return first - slack, second + slack


def product(M: tuple[ca.SX, ca.SX], x: tuple[ca.SX, ca.SX]) -> tuple[ca.SX, ca.SX]:
    """Return the ends of M x, column, for a matrix and a column between two ends each."""
    ends: tuple[list[ca.SX], list[ca.SX]] = ([], [])
    for i in range(M[0].shape[0]):
        low, high = ca.SX(0), ca.SX(0)
        for j in range(M[0].shape[1]):
            corners = [a[i, j] * b[j] for a in M for b in x]
            low = low + ca.fmin(ca.fmin(*corners[:2]), ca.fmin(*corners[2:]))
            high = high + ca.fmax(ca.fmax(*corners[:2]), ca.fmax(*corners[2:]))
        ends[0].append(low)
        ends[1].append(high)
    return ca.vertcat(*ends[0]), ca.vertcat(*ends[1])
