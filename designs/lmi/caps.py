"""Caps on the gain and on the conditioning of a design, as matrix inequalities."""

from typing import Any

import numpy as np

from obsynth.designs.lmi.blocks import symmetric_block
from obsynth.designs.lmi.expression import Affine, scalar
from obsynth.designs.lmi.problem import Problem


def cap_gain(problem: Problem, P: Affine, H: Affine, limit: float, name: str = "gain") -> None:
    """Keep the largest singular value of K = P^-1 H below a limit (sufficient).

    With p I <= P and ``[limit^2 p I, H'; H, P] >= 0`` follows p K'K <= K'P K <= limit^2 p I.
    """
    p = _floor(problem, P, name)
    columns = H.shape[1]
    block: Any = symmetric_block([[limit**2 * p * np.eye(columns)], [H, P]])
    problem.add_lmi(f"{name}.cap", block, ">>", strict=False)


def cap_condition(problem: Problem, P: Affine, limit: float, name: str = "condition") -> None:
    """Keep the condition number of P below a limit."""
    p = _floor(problem, P, name)
    problem.add_lmi(f"{name}.cap", limit * p * np.eye(P.shape[0]) - P, ">>", strict=False)


def _floor(problem: Problem, P: Affine, name: str) -> Affine:
    p = scalar(f"{name}.p")
    problem.add_lmi(f"{name}.floor", P - p * np.eye(P.shape[0]), ">>", strict=False)
    return p
