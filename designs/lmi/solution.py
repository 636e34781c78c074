"""What a solver returned, before anything is proved about it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.designs.lmi.expression import Affine


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

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><td>{name}</td><td>{value.shape}</td></tr>" for name, value in self.values.items()
        )
        head = f"{self.solver}: {self.status}, objective {self.objective:.6g}"
        return f"<table><caption>{head}</caption>{rows}</table>"

    def facts(self) -> dict[str, Any]:
        """Status, objective, solver and time, for errors and reports."""
        return {
            "status": self.status,
            "objective": self.objective,
            "solver": self.solver,
            "solve_time": self.solve_time,
            "iterations": self.iterations,
        }
