"""What is stored: what was read, the gain, and what bounds the error."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from luenberger.model import LuenbergerModel
from obsynth.designs.core.record import Design, Record
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class Comparison(Record):
    """|e+| <= N |e| + n, elementwise."""

    N: Annotated[FloatArray, "n n"]
    n: Annotated[FloatArray, "n"]


@dataclass(frozen=True, eq=False)
class LuenbergerDesign(Design):
    """Everything that is deployed and proved.

    closed, missing: with a measurement and without
    b: the peak bound
    """

    model: LuenbergerModel
    L: Annotated[FloatArray, "n m"]
    closed: Comparison
    missing: Comparison
    b: Annotated[FloatArray, "n"]
    options: Mapping[str, Any]

    @property
    def plant(self) -> Plant:
        """The discrete plant."""
        return self.model.plant
