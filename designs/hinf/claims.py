"""Proofs of the attenuation level, for the gains and matrices as they are stored."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np

from obsynth.derive.rigour import ExactMatrix, is_positive_definite, prove_positive_definite
from obsynth.designs.core.certificate import Claim
from obsynth.designs.hinf.lmis import (
    PrintedLoop,
    decay_block,
    dissipation_block,
    loop_of_filter,
    printed_block,
    printed_bound,
)
from obsynth.designs.hinf.record import HinfDesign
from obsynth.designs.hinf.system import Arithmetic, FilterData, lift

RUMP = "floating-point Cholesky after Rump, formation of the blocks enclosed"
EXACT = "exact rational elimination at the worst vertex"
# What rounding F and H may leave of the fault, relative to what they take away.
RESIDUAL = 1e-12


def proof_blocks(
    design: HinfDesign, arithmetic: Arithmetic, data: FilterData | None = None
) -> dict[str, Any]:
    """Form every matrix that has to be positive definite, in an arithmetic."""
    data = design.data if data is None else data
    bound = design.bound

    def number(value: float) -> Any:
        return lift(np.array([[value]]), arithmetic)

    mu = number(bound.mu)
    P = lift(bound.P, arithmetic)
    if bound.printed.size:
        loop = PrintedLoop.of(data, design.gains, arithmetic)
        alpha, beta, Q = number(bound.printed[0]), number(bound.printed[1]), bound.Q
        N = P @ lift(design.gains.K, arithmetic)
        return {
            "lmi": printed_block(loop, P, N, lift(Q, arithmetic), alpha, beta, mu @ mu),
            "lipschitz": printed_bound(loop, P, alpha),
            "Q": lift(Q, arithmetic),
        }
    error = loop_of_filter(data, design.gains, P, arithmetic)
    tau = [number(value) for value in bound.tau]
    blocks = {"lmi": dissipation_block(error, mu @ mu, data.sector, tau)}
    if bound.decay is not None:
        extra = [number(value) for value in (() if bound.tau_decay is None else bound.tau_decay)]
        blocks["decay"] = decay_block(error, number(bound.decay), data.sector, extra)
    return blocks


def prove_level(design: HinfDesign) -> tuple[Claim, ...]:
    """Prove every matrix inequality behind the level."""
    data, bound = design.data, design.bound
    count = data.count
    printed = bool(bound.printed.size)
    where = (
        f"at all {count} vertices of the Jacobian set"
        if data.sector is None
        else f"for every nonlinearity in the sector ({data.sector.groups} multipliers)"
    )
    level = f"V+ - V + |f - fhat|^2 < mu^2 |w|^2 with mu = {bound.mu:.9g}"
    statements = {
        "lmi": f"{level} {where}" + (", by (45)" if printed else ""),
        "lipschitz": "(37): P > alpha M'M",
        "Q": "Q > 0",
        "decay": f"V+ < {bound.decay} V where w = 0, {where}",
    }
    exact = {}
    claims = []
    for name, block in proof_blocks(design, "enclosure").items():
        result = prove_positive_definite(block)
        worst = int(result.worst()[0]) if data.sector is None else 0
        if worst not in exact:
            exact[worst] = proof_blocks(design, "exact", data.vertex(worst))
        confirmed = is_positive_definite(_symmetric(exact[worst][name]))
        claims.append(
            Claim(
                name,
                statements[name],
                bool(result.all_proved and confirmed),
                float(result.relative.min()),
                f"{RUMP}; {EXACT}",
            )
        )
    if printed:
        least = float(min(bound.printed[0], bound.printed[1]))
        # (45) knows neither an output feedthrough D nor a decay rate.
        plain = not design.gains.D.any() and bound.decay is None
        claims.append(
            Claim(
                "multipliers",
                "alpha > 0, beta > 0, D = 0",
                bool(least > 0.0 and plain),
                least,
                "comparison",
            )
        )
    return tuple(claims)


def _symmetric(matrix: ExactMatrix) -> ExactMatrix:
    return (matrix + matrix.T) * Fraction(1, 2)


def decoupling_residual(design: HinfDesign) -> tuple[float, float]:
    """Return the largest entries of (I - F C) L and of H C L - [I, 0], computed exactly."""
    F, H, C, L = (
        ExactMatrix.of(value) for value in (design.gains.F, design.gains.H, design.C, design.L)
    )
    n_f, s = len(design.gains.H), design.L.shape[1]
    CL = C @ L
    state = (L - F @ CL).to_floats()
    fault = (H @ CL - ExactMatrix.of(np.eye(n_f, s))).to_floats()
    return float(np.abs(state).max()), float(np.abs(fault).max())


def prove_decoupling(design: HinfDesign) -> Claim:
    """Prove that the faults themselves drop out of both errors."""
    state, fault = decoupling_residual(design)
    size = float(np.abs(design.L).max())
    exact = state == 0.0 and fault == 0.0
    return Claim(
        "decoupling",
        "(I - F C) L = 0 and H C L = I: the errors do not depend on the faults"
        if exact
        else f"|(I - F C) L| <= {state:.1e} and |H C L - I| <= {fault:.1e}: what rounding leaves "
        "of the faults",
        bool(state <= RESIDUAL * size and fault <= RESIDUAL),
        0.0 - max(state / size, fault),
        "exact rational arithmetic on the stored F, H, C, L",
    )
