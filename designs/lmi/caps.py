"""Caps on the gain and on the conditioning of a design, as matrix inequalities."""

from typing import Any

import numpy as np

from obsynth.designs.lmi.blocks import symmetric_block
from obsynth.designs.lmi.expression import Affine, scalar
from obsynth.designs.lmi.problem import Problem

__all__ = ["cap_condition", "cap_gain"]


def cap_gain(problem: Problem, P: Affine, H: Affine, limit: float, name: str = "gain") -> None:
    """Keep the largest singular value of K = P^-1 H below a limit (sufficient).

    With p I <= P and ``[limit^2 p I, H'; H, P] >= 0`` follows p K'K <= K'P K <= limit^2 p I.

    Parameters
    ----------
    problem : Problem
        Two blocks and the variable ``name.p`` are added.
    P, H : Affine, shapes (n, n) and (n, m)
        With K = P^-1 H.
    limit : float
        In the units of the coordinates of P.
    name : str
        Prefix of the blocks.

    Examples
    --------
    >>> from obsynth.designs.lmi import full, symmetric, trace
    >>> P, H = symmetric("P", 1), full("H", 1, 1)
    >>> problem = Problem("as large a gain as allowed")
    >>> problem.add("size", P << np.eye(1))
    >>> cap_gain(problem, P, H, 3.0)
    >>> problem.maximise(trace(H))
    >>> round(float(problem.solve()["H"][0, 0]), 4)
    3.0
    """
    p = _floor(problem, P, name)
    columns = H.shape[1]
    block: Any = symmetric_block([[limit**2 * p * np.eye(columns)], [H, P]])
    problem.add_lmi(f"{name}.cap", block, ">>", strict=False)


def cap_condition(problem: Problem, P: Affine, limit: float, name: str = "condition") -> None:
    """Keep the condition number of P below a limit.

    Parameters
    ----------
    problem : Problem
        Two blocks and the variable ``name.p`` are added.
    P : Affine, shape (n, n)
        Symmetric.
    limit : float
        Largest eigenvalue over smallest.
    name : str
        Prefix of the blocks.

    Examples
    --------
    >>> from obsynth.designs.lmi import symmetric, trace
    >>> P = symmetric("P", 2)
    >>> problem = Problem("condition")
    >>> problem.add("corner", P[0, 0] >= 100.0)
    >>> cap_condition(problem, P, 10.0)
    >>> problem.minimise(trace(P))
    >>> round(problem.solve().objective, 3)
    110.0
    """
    p = _floor(problem, P, name)
    problem.add_lmi(f"{name}.cap", limit * p * np.eye(P.shape[0]) - P, ">>", strict=False)


def _floor(problem: Problem, P: Affine, name: str) -> Affine:
    p = scalar(f"{name}.p")
    problem.add_lmi(f"{name}.floor", P - p * np.eye(P.shape[0]), ">>", strict=False)
    return p
