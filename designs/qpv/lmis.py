"""The matrix inequalities of the method, written once for unknowns, enclosures and exact numbers.

Divided by eta they are stated over the enlarged polytopes themselves (see the method's page).
Double polytopic sums are finitely many terms, by Polya's relaxation or its exact collapse:
sum_l sum_m mu_l mu_m F_lm < 0 on the simplex follows from the coefficients of (sum mu)^(s-2) times
it, one for every multi-index of s vertices. With k_l the multiplicity of vertex l the coefficient
is, up to a positive factor, sum_lm k_l (k_m - [l = m]) / (s (s - 1)) F_lm: (47)-(49) put right.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.designs.lmi.problem import he, symmetric_block, transpose
from obsynth.symbolic.errors import ObsynthError


@dataclass(frozen=True, eq=False)
class PolyaTerm:
    """Weights of one term: `single`, and of products `double`; total s (s - 1), or 1."""

    total: int
    single: NDArray[np.int64]
    double: NDArray[np.int64]


def collapsed_terms(vertices: int) -> tuple[PolyaTerm, ...]:
    """One term per vertex: exact when the second factor of the products does not vary."""
    units = np.eye(vertices, dtype=np.int64)
    return tuple(PolyaTerm(1, unit, np.diag(unit)) for unit in units)


def polya_terms(vertices: int, order: int) -> tuple[PolyaTerm, ...]:
    """All terms of order s, C(N + s - 1, s) of them."""
    if isinstance(order, bool) or not isinstance(order, int) or order < 2:
        raise ObsynthError(
            f"polya is {order!r}; the order s of the relaxation is an integer from 2 on",
            option="polya",
        )
    terms = []
    for chosen in itertools.combinations_with_replacement(range(vertices), order):
        k = np.bincount(chosen, minlength=vertices).astype(np.int64)
        double = np.outer(k, k) - np.diag(k)
        terms.append(PolyaTerm(order * (order - 1), k * (order - 1), double))
    return tuple(terms)


@dataclass(frozen=True, eq=False)
class Closed:
    """One term, times total: he{P (A + Psi) - Gamma C}, P G - Gamma H or None, Cz."""

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
    return np.ones((1, 1)) - corners @ P @ transpose(corners)
