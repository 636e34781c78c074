"""The stored design: the numbers from which the step is built."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any

import numpy as np

from obsynth.designs.core.errors import CertificateError
from obsynth.designs.core.record import Design
from obsynth.designs.general.record import GeneralDesign, PeakBound
from obsynth.designs.set_membership.zonotope import Frame, Real
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray, IntArray

MOST_COLUMNS = 400


@dataclass(frozen=True, eq=False)
class SetMembershipDesign(Design):
    """Everything that is deployed and proved.

    followed: faults that the zonotopes carry as states, by their rates
    L: the gain, (N, m)
    V, W, size, leak: see `Frame`
    A, C: slopes of the equations at the point of operation
    columns, kept: K, and for how many calls a generator is kept before it becomes part of a box
    zonotopes, restart: how many zonotopes begin anew every so many calls
    contraction: bound of the spectral radius of ``|V^-1 ((I - L C) A)^kept V|``
    predicted, share, settles: half widths at the point of operation, from which share of the
        declared ranges they were followed, and calls until they stand still
    peak: an observer of the general class with peak bounds, whose sets are met with the others
    """

    plant: Plant
    followed: tuple[str, ...]
    L: Annotated[FloatArray, "n_z m"]
    V: Annotated[FloatArray, "n_z n_z"]
    W: Annotated[FloatArray, "n_z n_z"]
    size: Annotated[FloatArray, "n_z n_z"]
    leak: Annotated[FloatArray, "n_z n_z"]
    A: Annotated[FloatArray, "n_z n_z"]
    C: Annotated[FloatArray, "m n_z"]
    columns: int
    kept: int
    zonotopes: int
    restart: int
    contraction: float
    predicted: Annotated[FloatArray, "n+n_f"]
    share: float
    settles: int
    peak: GeneralDesign | None
    options: Mapping[str, Any]

    def check(self) -> None:
        """Refuse what no step can be built from."""
        names, N = self.plant.names("f"), len(self.V)
        known = len(set(self.followed)) == len(self.followed) <= N and set(self.followed) <= {
            *names
        }
        if not known or len(self.plant.x) + len(self.followed) != N:
            raise CertificateError(
                f"the stored design follows {list(self.followed)} with {N} coordinates; the plant "
                f"has {len(self.plant.x)} states and faults {list(names)}"
            )
        bank = self.kept >= 1 and N <= self.columns <= MOST_COLUMNS
        if not bank or not 0 <= self.zonotopes <= self.restart:
            raise CertificateError(
                f"the stored design has {self.columns} columns and {self.zonotopes} zonotopes that "
                f"begin anew every {self.restart} calls, which is no bank"
            )
        if self.peak is not None and not isinstance(self.peak.bound, PeakBound):
            raise CertificateError("the stored observer of the general class has no peak bounds")

    @property
    def places(self) -> IntArray:
        """Places of the followed faults."""
        names = self.plant.names("f")
        return np.array([names.index(name) for name in self.followed], dtype=np.int64)

    @cached_property
    def frame(self) -> Frame:
        """Coordinates of the reduction."""
        return Frame(self.V, self.W, self.size, self.leak, Real(self.precision, len(self.V)))

    @property
    def turns(self) -> list[int]:
        """At which call of a round every zonotope but the first begins anew, from 1 on."""
        count = max(self.zonotopes, 1)
        return [1 + (j * self.restart) // count for j in range(self.zonotopes)]
