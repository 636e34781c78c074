"""The matrix inequalities of the method, written once for unknowns, enclosures and exact numbers.

Divided by eta they are stated over the enlarged polytopes themselves: with x = c + (x_j - c)/eta
and e = (x_i - c)/eta, eta times Psi(x, e) is the Psi of (24) in Rotondo, Buciakowski and Witczak.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.designs.lmi import he, symmetric_block
from obsynth.designs.qpv.polya import PolyaTerm


@dataclass(frozen=True, eq=False)
class Closed:
    """One Polya term of the closed loop, `total` times what belongs to it.

    total: sum of the weights
    drift: he{P (A + Psi) - Gamma C}
    side: P G - Gamma H, or None without disturbances
    Cz: performance output
    """

    total: Any
    drift: Any
    side: Any
    Cz: Any


def _weighted(weights: Any, blocks: Sequence[Any]) -> Any:
    total: Any = 0
    for weight, block in zip(weights, blocks, strict=True):
        if weight:
            total = block * float(weight) + total
    return total


def close(
    P: Any,
    gains: Sequence[Any],
    term: PolyaTerm,
    A: Sequence[Any],
    psi: Sequence[Any],
    C: Sequence[Any],
    G: Sequence[Any],
    H: Sequence[Any],
    Cz: Sequence[Any],
) -> Closed:
    """Form one term of (49), (50) and (54)."""
    outer = _weighted(term.single, [P @ (a + p) for a, p in zip(A, psi, strict=True)])
    into = _products(term, gains, C)
    side = None
    if G[0].shape[1]:
        side = P @ _weighted(term.single, G) - _products(term, gains, H)
    return Closed(float(term.total), he(outer - into), side, _weighted(term.single, Cz))


def _products(term: PolyaTerm, gains: Sequence[Any], outputs: Sequence[Any]) -> Any:
    """sum_lm w_lm Gamma_l C_m."""
    total: Any = 0
    for weights, gain in zip(term.double, gains, strict=True):
        if weights.any():
            total = gain @ _weighted(weights, outputs) + total
    return total


def decay_block(P: Any, closed: Closed, alpha: Any) -> Any:
    """(22), (49): positive definite when V' + alpha V < 0."""
    return -closed.drift - P * alpha * closed.total


def h2_block(closed: Closed) -> Any:
    """(41), (54): positive definite when V' < w'w."""
    unit = np.eye(closed.side.shape[1]) * closed.total
    return symmetric_block([[-closed.drift], [-closed.side.T, unit]])


def hinf_block(closed: Closed, gamma: Any) -> Any:
    """(23), (50): positive definite when V' + z'z < gamma w'w."""
    unit = np.eye(closed.side.shape[1]) * closed.total
    last = np.eye(closed.Cz.shape[0]) * closed.total
    return symmetric_block([[-closed.drift], [-closed.side.T, gamma * unit], [-closed.Cz, 0, last]])


def noise_block(P: Any, closed: Closed, rate: Any, weights: Any) -> Any:
    """Quadratic boundedness: positive definite when V' < rate (w'W w - V), W = diag(weights)."""
    corner = -closed.drift - P * rate * closed.total
    return symmetric_block([[corner], [-closed.side.T, weights * rate * closed.total]])


def inside_block(P: Any, normals: Any) -> Any:
    """(20) corrected: {e'P e <= 1} lies in the half-space a'e <= 1, a' in `normals`."""
    return symmetric_block([[P], [normals, np.ones((1, 1))]])


def start_block(P: Any, corners: Any) -> Any:
    """(19) corrected: 1 - v'P v, v' in `corners`."""
    return np.ones((1, 1)) - corners @ P @ _transposed(corners)


def _transposed(corners: Any) -> Any:
    return np.swapaxes(corners, -1, -2) if isinstance(corners, np.ndarray) else corners.T
