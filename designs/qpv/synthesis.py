"""Gains and ellipsoids by linear matrix inequalities: solved here, proved elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from obsynth.designs.lmi import (
    Affine,
    MarginSolution,
    Problem,
    cap_gain,
    full,
    scalar,
    solve_reliably,
    solve_with_margin,
    split_common,
    symmetric,
    symmetric_block,
    trace,
)
from obsynth.designs.qpv.data import VertexData
from obsynth.designs.qpv.error_matrix import ErrorSets
from obsynth.designs.qpv.lmis import (
    Closed,
    close,
    decay_block,
    h2_block,
    hinf_block,
    inside_block,
    noise_block,
    start_block,
)
from obsynth.designs.qpv.polya import PolyaTerm
from obsynth.symbolic.arrays import FloatArray

Norm = Literal["h2", "hinf"]

# Part of the largest margin that phase 2 keeps; the objective loses about as much, relatively.
_FRACTION = 1e-5

# What a search tolerates: the smallest eigenvalue, where the sets have size one, and the gap.
_ROUGH = -1e-5
_ROUGH_GAP = 1e-3


@dataclass(frozen=True, eq=False)
class Setting:
    """Everything that the inequalities depend on besides the unknowns.

    alpha: decay rate of V = e'P e
    alpha_q: rate of quadratic boundedness
    noise (n_v,) or None: weights of the disturbances, w'W w <= 1
    gain_cap: largest singular value of every L_l
    printed: whether (19) and (20) are taken as printed
    half (n,): units of the error
    """

    data: VertexData
    sets: ErrorSets
    norm: Norm
    alpha: float
    alpha_q: float | None
    noise: FloatArray | None
    polya: int | None
    gain_cap: float | None
    printed: bool
    half: FloatArray

    @property
    def terms(self) -> tuple[PolyaTerm, ...]:
        """Terms of the double polytopic sums."""
        return self.data.terms(self.polya)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """P, the Gamma_l = P L_l and mu or gamma, in units of `Setting.half`."""

    P: FloatArray
    gains: FloatArray
    level: float

    @classmethod
    def read(cls, values: Mapping[str, FloatArray], setting: Setting, gains: Any) -> Unknowns:
        """Take values by name to the coordinates of the plant, gains as L_l."""
        half = setting.half
        P = values["P"] / np.outer(half, half)
        if gains is None:
            found = [
                half[:, None] * np.linalg.solve(values["P"], values[f"Gamma{k}"])
                for k in range(len(setting.data.A))
            ]
            gains = np.stack(found)
        level = float(np.trace(values["Z"])) if "Z" in values else float(values["gamma"].item())
        return cls(0.5 * (P + P.T), gains, level)


def state_problem(setting: Setting, gains: FloatArray | None = None) -> Problem:
    """State the design problem, or with gains L_l given the analysis problem.

    Shapes: gains (V, n, m).
    """
    half, n = setting.half, setting.data.sizes[0]
    data = setting.data.scaled(half)
    psi = setting.data.psi(setting.sets) * half / half[:, None]
    problem = Problem("QPV observer")
    P = symmetric("P", n)
    if gains is None:
        m = data.sizes[1]
        gammas = [full(f"Gamma{k}", n, m) for k in range(len(data.A))]
    else:
        gammas = [P @ (gain / half[:, None]) for gain in gains]
    level = scalar("gamma") if setting.norm == "hinf" else None
    for number, term in enumerate(setting.terms):
        closed = close(
            P, gammas, term, *(list(b) for b in (data.A, psi, data.C, data.G, data.H, data.Cz))
        )
        _state_term(problem, setting, P, closed, level, number)
    _state_sets(problem, setting, P)
    if setting.gain_cap is not None and gains is None:
        inverse = np.diag(1.0 / half)
        for k, gamma in enumerate(gammas):
            cap_gain(problem, inverse @ P @ inverse, inverse @ gamma, setting.gain_cap, f"L{k}")
    if level is None:
        Z = symmetric("Z", data.Cz.shape[1])
        for number, Cz in enumerate(_distinct(data.Cz)):
            problem.add_lmi(f"trace {number}", symmetric_block([[P], [Cz, Z]]), ">>")
        problem.minimise(trace(Z))
    else:
        problem.minimise(level)
    return problem


def _state_term(
    problem: Problem,
    setting: Setting,
    P: Affine,
    closed: Closed,
    level: Affine | None,
    number: int,
) -> None:
    bounded = setting.alpha_q is not None and setting.noise is not None
    if not (bounded and setting.alpha <= (setting.alpha_q or 0.0)):
        problem.add_lmi(f"decay {number}", decay_block(P, closed, setting.alpha), ">>")
    blocks: dict[str, Any] = {}
    if closed.side is not None:
        if bounded:
            weights = np.diag(np.asarray(setting.noise))
            blocks["noise"] = noise_block(P, closed, setting.alpha_q, weights)
        elif setting.norm == "h2":
            blocks["h2"] = h2_block(closed)
        if setting.norm == "hinf":
            blocks["hinf"] = hinf_block(closed, level)
    for name, block in blocks.items():
        parts = split_common(block, f"{name}.slack{number}")
        if parts.common is not None:
            problem.add_lmi(f"{name} {number}, common", parts.common, ">>")
        problem.add_lmi(f"{name} {number}", parts.members, ">>")


def _state_sets(problem: Problem, setting: Setting, P: Affine) -> None:
    half = setting.half
    normals, corners = setting.sets.normals.mid, setting.sets.start[:, None, :]
    if setting.printed:
        problem.add_lmi("start", inside_block(P, corners * half), ">>")
        problem.add_lmi("error set", start_block(P, normals / half), ">>")
        return
    problem.add_lmi("start", start_block(P, corners / half), ">>")
    problem.add_lmi("error set", inside_block(P, normals * half), ">>")


def _distinct(matrices: FloatArray) -> FloatArray:
    return np.unique(matrices, axis=0)


def rough_objective(setting: Setting, gains: FloatArray | None = None) -> float:
    """Return the optimum without margin and proof, for searches."""
    problem = state_problem(setting, gains)
    return solve_reliably(problem, floor=_ROUGH, gap=_ROUGH_GAP).objective


def solve(
    setting: Setting,
    prove: Callable[[Unknowns], Any],
    gains: FloatArray | None = None,
) -> tuple[Unknowns, MarginSolution]:
    """Solve with a margin and back off until `prove` accepts the numbers as stored.

    Shapes: gains (V, n, m).
    """
    problem = state_problem(setting, gains)
    found = solve_with_margin(
        problem,
        prove=lambda values: prove(Unknowns.read(values, setting, gains)),
        fraction=_FRACTION,
    )
    return Unknowns.read(found.values, setting, gains), found
