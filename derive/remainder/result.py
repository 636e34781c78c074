"""Intervals for the local error of a discretisation."""

from dataclasses import dataclass

import numpy as np
import sympy as sp

from obsynth.derive.intervals.ranges import Status
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.discretise import Step
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.table import Table, Tabled

_HEADS = ("state", "guaranteed", "attained", "flow over a step", "unit")


@dataclass(frozen=True, eq=False, repr=False)
class Remainder(Tabled):
    """x(t + Ts) = step(x(t)) + r with r in [lower, upper], everything else held over the step.

    plant: the continuous plant
    formula: the formula of the step
    exact_Ts: sampling time in s, as it was given
    lower, upper (n,): guaranteed bounds of r, for every state of the box and every held signal in
        its range
    attained_lower, attained_upper (n,): values that r is guaranteed to reach or pass, so that the
        exact range lies between
    attained_at: for every state, the state and held signals with the larger attained modulus
    flow_lower, flow_upper (n,): a box that no solution from the plant's box leaves within a step
    order: power of Ts of the bound: 2 for Euler, 5 for Runge-Kutta, one more than its own for a
        Taylor polynomial, less where the dynamics have kinks inside the box
    assumed: ranges that were given for this purpose and are not the plant's own
    status: how far bounds and attained values are apart, by the tolerance that was asked for
    """

    plant: Plant
    formula: Step
    exact_Ts: sp.Expr
    lower: FloatArray
    upper: FloatArray
    attained_lower: FloatArray
    attained_upper: FloatArray
    attained_at: tuple[dict[str, float], ...]
    flow_lower: FloatArray
    flow_upper: FloatArray
    order: int
    assumed: dict[str, tuple[float, float]]
    status: Status

    @property
    def method(self) -> str:
        """``"euler"``, ``"rk4"``, or ``"taylor"`` and the order."""
        return str(self.formula)

    @property
    def Ts(self) -> float:
        """Sampling time in s."""
        return float(self.exact_Ts)

    @property
    def radius(self) -> FloatArray:
        """Largest modulus per state, shape (n,)."""
        return np.maximum(np.abs(self.lower), np.abs(self.upper))

    @property
    def excess(self) -> FloatArray:
        """Guaranteed width over attained width, per state; 1 is perfect, 1 too where both are 0."""
        wide, real = self.upper - self.lower, self.attained_upper - self.attained_lower
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return np.where(wide <= 1e-250, 1.0, np.where(real > 0.0, wide / real, np.inf))

    def table(self) -> Table:
        """Tabulate bounds, attained values and the box of the flow, a row for every state."""
        held = "".join(f", {k} in [{a:g}, {b:g}]" for k, (a, b) in self.assumed.items())
        title = (
            f"Remainder of {self.method}, Ts = {self.Ts:g} s, for {self.plant.name} "
            f"(order {self.order}; signals held over a step{held})"
        )
        rows = [
            (
                signal.name,
                f"[{self.lower[i]:.4g}, {self.upper[i]:.4g}]",
                f"[{self.attained_lower[i]:.4g}, {self.attained_upper[i]:.4g}]",
                f"[{self.flow_lower[i]:.6g}, {self.flow_upper[i]:.6g}]",
                signal.unit,
            )
            for i, signal in enumerate(self.plant.x)
        ]
        return Table(title, _HEADS, rows)
