"""The matrix inequalities of the method, each written once for expressions and enclosures.

All are returned as a matrix that has to be positive definite.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.designs.hinf.system import Filter, FilterData, Sector
from obsynth.designs.lmi.problem import Arithmetic, lift, symmetric_block
from obsynth.symbolic.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class Loop:
    """The error system with P multiplied in: P (I - F C), P K C, H C, D C, A or a family, W."""

    P: Any
    PG: Any
    PKC: Any
    HC: Any
    DC: Any
    A: Any
    W: Any

    @property
    def X(self) -> Any:
        """P times the matrix from e to e+."""
        return self.PG @ self.A - self.PKC


def loop_of_filter(
    data: FilterData, gains: Filter, P: Any, arithmetic: Arithmetic = "float"
) -> Loop:
    """Form the error system of given gains."""
    K, F, H, D = (lift(value, arithmetic) for value in (gains.K, gains.F, gains.H, gains.D))
    C = lift(data.C, arithmetic)
    return Loop(
        P=P,
        PG=P @ (lift(np.eye(len(data.A)), arithmetic) - F @ C),
        PKC=P @ (K @ C),
        HC=H @ C,
        DC=D @ C,
        A=data.dynamics(arithmetic),
        W=lift(data.W, arithmetic, data.W_radius),
    )


def _weighted(sector: Sector, tau: Sequence[Any]) -> tuple[Any, Any]:
    """Sum tau_g diag(R_g) and T."""
    total: Any = 0
    T: Any = 0
    for number, value in enumerate(tau):
        total = value * np.diag(sector.R[number]) + total
        T = value * sector.mask(number) + T
    return total, T


def dissipation_block(
    loop: Loop, mu2: Any, sector: Sector | None = None, tau: Sequence[Any] = ()
) -> Any:
    """V+ - V + |f - fhat|^2 < mu^2 |w|^2 for every value of the nonlinearity, mu2 (1, 1).

    (26) put right, with one multiplier per group of the sector: the method's page, Conditions; at
    every vertex, without multipliers, where there is no sector.
    """
    n_f, n_w = loop.HC.shape[0], loop.W.shape[1]
    c = loop.HC @ loop.A + loop.DC
    energy = mu2 * np.eye(n_w)
    last = [loop.PG @ loop.W, loop.P], [loop.HC @ loop.W, 0, np.eye(n_f)]
    if sector is None:
        return symmetric_block([[loop.P], [0, energy], [loop.X, *last[0]], [c, *last[1]]])
    total, T = _weighted(sector, tau)
    return symmetric_block(
        [
            [loop.P - total],
            [0, T],
            [0, 0, energy],
            [loop.X, loop.PG @ sector.E, *last[0]],
            [c, loop.HC @ sector.E, *last[1]],
        ]
    )


def decay_block(
    loop: Loop, keep: Any, sector: Sector | None = None, tau: Sequence[Any] = ()
) -> Any:
    """V+ < keep V where w = 0, for every value of the nonlinearity."""
    if sector is None:
        return symmetric_block([[loop.P * keep], [loop.X, loop.P]])
    total, T = _weighted(sector, tau)
    return symmetric_block([[loop.P * keep - total], [0, T], [loop.X, loop.PG @ sector.E, loop.P]])


@dataclass(frozen=True, eq=False)
class PrintedLoop:
    """What (45) is printed with: A, Abar, C, G, W, Hbar and M'M."""

    A: Any
    Abar: Any
    C: Any
    G: Any
    W: Any
    Hbar: Any
    MM: FloatArray

    @classmethod
    def of(
        cls, data: FilterData, gains: Filter | None = None, arithmetic: Arithmetic = "float"
    ) -> PrintedLoop:
        """Form them from the data, and from the stored F and H where gains are given."""
        if data.sector is None:
            raise ValueError("(45) needs M'M")
        A = data.dynamics(arithmetic)
        C = lift(data.C, arithmetic)
        W = lift(data.W, arithmetic, data.W_radius)
        F = data.L @ data.H if gains is None else gains.F
        H = data.H[: data.n_f] if gains is None else gains.H
        HC = lift(H, arithmetic) @ C
        G = lift(np.eye(len(data.A)), arithmetic) - lift(F, arithmetic) @ C
        return cls(A, G @ A, C, G, W, HC.T @ HC, np.diag(data.sector.R.sum(axis=0)))


def printed_block(
    loop: PrintedLoop, P: Any, N: Any, Q: Any, alpha: Any, beta: Any, mu2: Any
) -> Any:
    """Inequality (45) as printed, times -1."""
    n, n_w = loop.W.shape
    A, C, G, W, Hbar = loop.A, loop.C, loop.G, loop.W, loop.Hbar
    eye = np.eye(n)
    return symmetric_block(
        [
            [P - A.T @ Hbar @ A - beta * loop.MM],
            [-(Hbar @ A), Q + beta * eye - Hbar],
            [-(W.T @ Hbar @ A), -(W.T @ Hbar), mu2 * np.eye(n_w) - W.T @ Hbar @ W],
            [0, 0, 0, alpha * eye - Q],
            [N @ C - P @ loop.Abar, -(P @ G), -(P @ (G @ W)), 0, P * 0.5],
        ]
    )


def printed_bound(loop: PrintedLoop, P: Any, alpha: Any) -> Any:
    """Inequality (37): P - alpha M'M."""
    return P - alpha * loop.MM
