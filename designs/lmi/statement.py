"""What a solver is handed, and what it returned before anything is proved about it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.designs.lmi.expression import Affine, Variable


@dataclass(frozen=True, eq=False)
class Block:
    """A named constraint: an expression and the cone it lies in.

    name: name in reports and in the duals of the solution
    cone: ``"psd"``, ``"nonnegative"``, ``"zero"``, or ``"exponential"`` (rows of three)
    expression: for ``"psd"`` with sense ``<<`` the negative of what was typed, margin included
    strict: whether a margin is asked of the block; helpers that only define an auxiliary variable
        are not strict
    """

    name: str
    cone: str
    expression: Affine
    strict: bool = True

    @property
    def asks_margin(self) -> bool:
        """Whether the block is a matrix inequality of which a margin is asked."""
        return self.strict and self.cone == "psd"


@dataclass(frozen=True, eq=False)
class Statement:
    """A problem as a back end reads it: blocks and variables by name, and a 1 x 1 objective."""

    name: str
    variables: Mapping[str, Variable]
    blocks: Mapping[str, Block]
    objective: Affine
    maximising: bool


@dataclass(frozen=True, eq=False)
class Solution:
    """Values by variable name. A status is not a certificate: prove what matters.

    values: every variable as a matrix (numbers are 1 x 1)
    status: in the words of the solver
    solved: true only for the status that means solved to full accuracy
    infeasible: true only where the solver reports infeasibility to full accuracy
    objective: in the sense of the problem (what was minimised or maximised)
    gap: difference to the dual objective, relative to the objective where that is above one; inf
        where the solver does not tell
    solver: name of the solver
    solve_time: seconds inside the solver
    duals: dual matrix of every block, (r, c) or (N, r, c); empty when the solver gives none
    attempts: how earlier attempts and this one ended, when there was more than one way to try
    """

    values: Mapping[str, NDArray[np.float64]]
    status: str
    solved: bool
    infeasible: bool
    objective: float
    gap: float
    solver: str
    solve_time: float
    iterations: int = 0
    duals: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    attempts: tuple[str, ...] = ()

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        return self.values[name]

    def value(self, expression: Affine) -> NDArray[np.float64]:
        """Value of an expression, (r, c) or (N, r, c)."""
        return expression.value(self.values)

    def number(self, name: str) -> float:
        """Read a 1 x 1 variable as a float."""
        return float(self.values[name].item())

    def facts(self) -> dict[str, Any]:
        """Status, objective, solver and time, for errors and reports."""
        names = ("status", "objective", "solver", "solve_time", "iterations")
        return {name: getattr(self, name) for name in names}
