"""`Luenberger`: the options, and the verbs of the contract."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from numpy.typing import ArrayLike

from luenberger.claims import claims, covers, guarantee, numbers
from luenberger.model import CLASS, LuenbergerModel, read
from luenberger.record import LuenbergerDesign
from luenberger.step import build_core, first_memory, memory_sizes, settling
from luenberger.synthesis import solve_gain, with_gain
from obsynth.derive import JacobianBounds, Split
from obsynth.designs.core.given import read_gains
from obsynth.designs.core.method import Contract, Method
from obsynth.symbolic import Plant


def read_again(design: LuenbergerDesign) -> LuenbergerModel:
    """Read the stored equations."""
    return read(design.plant)


@dataclass(frozen=True)
class Luenberger(Method):
    """State observer with a peak bound of the error, for plants without faults."""

    CLASS = CLASS
    CONTRACT = Contract(
        name="luenberger",
        record=LuenbergerDesign,
        read_again=read_again,
        claims=claims,
        covers=covers,
        guarantee=guarantee,
        numbers=numbers,
        memory=memory_sizes,
        first=first_memory,
        core=build_core,
        shared=("prediction",),
        settle=settling,
    )

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
