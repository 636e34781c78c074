"""The stored bank: plain data from which the step, its continuous form and the proofs are made."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any

import numpy as np

from obsynth.derive.jacobian.slope_signs import with_ranges
from obsynth.derive.rigour import allowance
from obsynth.designs.core.errors import CertificateError
from obsynth.designs.core.record import Design, Record
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray, IntArray

UNKNOWN = ("x", "w", "p", "rho", "f")
"""Kinds of signals that are not known at run time, besides measured scheduling variables."""


@dataclass(frozen=True, eq=False)
class Signs(Record):
    """Signs of the slopes of all equations by every signal of the kinds of `UNKNOWN`."""

    x: Annotated[IntArray, "n n"]
    w: Annotated[IntArray, "n n_w"]
    p: Annotated[IntArray, "n n_p"]
    rho: Annotated[IntArray, "n n_rho"]
    f: Annotated[IntArray, "n n_f"]

    def __getitem__(self, kind: str) -> IntArray:
        signs: IntArray = getattr(self, kind)
        return signs


@dataclass(frozen=True, eq=False)
class BankModel(Record):
    """What the bank rests on, all derived from the plant and a region.

    region: where the equations are monotone, and where the states are assumed to be
    outputs, scale: which state each output shows, and times what
    noise: range of what is added to scale * state
    fault_rows, gain: the state that each fault enters, and its factor
    """

    plant: Plant
    region: Annotated[FloatArray, "n 2"]
    outputs: Annotated[IntArray, "m"]
    scale: Annotated[FloatArray, "m"]
    noise: Annotated[FloatArray, "m 2"]
    fault_rows: Annotated[IntArray, "n_f"]
    gain: Annotated[FloatArray, "n_f"]
    signs: Signs

    @property
    def hidden(self) -> list[int]:
        """States that no output shows."""
        return [i for i in range(len(self.plant.x)) if i not in set(self.outputs.tolist())]

    def check(self) -> None:
        """Refuse numbers of states that there are not."""
        for name in ("outputs", "fault_rows"):
            rows = getattr(self, name)
            if ((rows < 0) | (rows >= len(self.plant.x))).any():
                raise CertificateError(
                    f"the stored design cannot be read: {name} = {rows.tolist()} are no numbers of "
                    "states"
                )


@dataclass(frozen=True, eq=False)
class BankDesign(BankModel, Design):
    """Everything that is deployed and proved; filters: rates, that of the intervals first."""

    Ts: float
    filters: Annotated[FloatArray, "n_l"]
    options: Mapping[str, Any]

    @cached_property
    def assumed(self) -> Plant:
        """The plant with the region for ranges of the states: what sets are held to."""
        same = np.array_equal(self.region, self.plant.box("x"))
        return self.plant if same else with_ranges(self.plant, self.region)

    @property
    def bank(self) -> list[tuple[int, float, float]]:
        """Row, factor of the fault and rate of every filter, faults first, then rates."""
        rows = zip(self.fault_rows.tolist(), self.gain.tolist(), strict=True)
        return [(i, gain, rate) for i, gain in rows for rate in self.filters.tolist()]

    @property
    def rounding(self) -> float:
        """What the rounding of one step may be, relative to the size of its terms."""
        return allowance(self.precision, len(self.plant.x))

    def check(self) -> None:
        """Refuse a bank without filters too."""
        super().check()
        if not self.filters.size:
            raise CertificateError("the stored design has no filters")
