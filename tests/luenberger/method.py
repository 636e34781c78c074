"""`Luenberger`: the options, and the verbs of the contract."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from numpy.typing import ArrayLike

from luenberger import claims, step
from luenberger.model import CLASS, LuenbergerModel, read
from luenberger.record import LuenbergerDesign
from luenberger.synthesis import solve_gain, with_gain
from obsynth.derive import JacobianBounds, Split
from obsynth.designs.core.given import read_gains
from obsynth.designs.core.method import Contract, Method
from obsynth.symbolic import Plant


@dataclass(frozen=True)
class Luenberger(Method):
    """State observer with a peak bound of the error, for plants without faults."""

    CLASS = CLASS
    CONTRACT = Contract.of("luenberger", LuenbergerDesign, claims, step, shared=("prediction",))

    def read(self, given: Plant | Split, bounds: JacobianBounds | None = None) -> LuenbergerModel:
        """Split the plant and bound the Jacobian."""
        return read(given, bounds)

    def solve(self, model: LuenbergerModel) -> LuenbergerDesign:
        """Choose the gain."""
        return with_gain(model, solve_gain(model), self.options())

    def fix(self, model: LuenbergerModel, gains: Mapping[str, ArrayLike]) -> LuenbergerDesign:
        """Bound the error of a given gain."""
        shape = model.C.T.shape
        return with_gain(model, read_gains(gains, {"L": shape})["L"], self.options())
