"""The stored design of the general class: plain data from which step and proofs are made."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Annotated, Any

import numpy as np

from obsynth.derive.forms.extended import Extended, extend
from obsynth.derive.jacobian.family import AffineFamily
from obsynth.designs.core.errors import CertificateError
from obsynth.designs.core.record import Design, Record
from obsynth.designs.core.signals import Limits
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray, IntArray

_extended = lru_cache(maxsize=16)(extend)
"""One extended plant for all designs of a plant."""


@dataclass(frozen=True, eq=False)
class Modes(Record):
    """Basis V in which the first error fades, its inverse Y, and the columns of every block."""

    basis: Annotated[FloatArray, "N N"]
    inverse: Annotated[FloatArray, "N N"]
    blocks: Annotated[IntArray, "n_b"]

    def check(self) -> None:
        """Refuse blocks that are not those of the basis."""
        if not np.all((self.blocks == 1) | (self.blocks == 2)) or self.blocks.sum() != len(
            self.basis
        ):
            raise CertificateError(
                f"the blocks {self.blocks.tolist()} of the stored design do not make up "
                f"{len(self.basis)} columns"
            )


@dataclass(frozen=True, eq=False)
class Fading(Record):
    """How the first error fades: at most ``reach G^k start |xi_0|`` is added to the peak bounds.

    decay: at least the spectral radius of G; modes: none for an exponential
    """

    G: Annotated[FloatArray, "n_b n_b"]
    reach: Annotated[FloatArray, "N n_b"]
    start: Annotated[FloatArray, "n_b N"]
    decay: float
    modes: Modes | None


@dataclass(frozen=True, eq=False)
class PeakBound(Record):
    """Guaranteed peak bounds b of the errors before and after the last correction."""

    KIND = "peak"

    b: Annotated[FloatArray, "N+N"]
    fading: Fading


@dataclass(frozen=True, eq=False)
class EllipsoidBound(Record):
    """An invariant ellipsoid ``e_c'P e_c <= 1`` of the errors, see `storage_block`.

    gamma: contraction per sample
    noise: diagonal of N, of the components of v_k and v_{k+1} in units of their bounds
    tau: multipliers of the channels, those of F and then those of h
    inverse_diagonal: upper bounds of ``(P^-1)_ii``
    peak: bounds of the same gain, where small gain holds; the smaller half width counts
    """

    KIND = "ellipsoid"

    P: Annotated[FloatArray, "N N"]
    gamma: float
    noise: Annotated[FloatArray, "n_both"]
    tau: Annotated[FloatArray, "n_q"]
    inverse_diagonal: Annotated[FloatArray, "N"]
    peak: PeakBound | None = None


@dataclass(frozen=True, eq=False)
class EnergyBound(Record):
    """A gain mu from the energy of v, in units of its bounds, to that of the weighted errors.

    weights: of the errors, C is their diagonal
    tau: multipliers, as of `EllipsoidBound`
    attained: the largest gain at a frozen Jacobian that a search found, which no claim proves
    """

    KIND = "l2"

    P: Annotated[FloatArray, "N N"]
    mu: float
    weights: Annotated[FloatArray, "N"]
    tau: Annotated[FloatArray, "n_q"]
    attained: float


@dataclass(frozen=True, eq=False)
class Rounding(Record):
    """Bounds of what rounding adds, each (N,): to xq, to xc and to the next prediction."""

    q: Annotated[FloatArray, "N"]
    c: Annotated[FloatArray, "N"]
    p: Annotated[FloatArray, "N"]


@dataclass(frozen=True, eq=False)
class GeneralDesign(Design):
    """Everything that is deployed and proved, in doubles.

    unfollowed, divided: faults that count as disturbances, or are taken away, see `extend`
    v_centre, v_radius: box of the disturbances of the extended plant
    L0: what takes unknown inputs away
    Z: the gain; zero where L0 reads
    K: the gain of the innovation in the next prediction, which peak bounds alone can have
    family: Jacobians of the extended plant's rows and outputs by its states and disturbances
    rounding: allowances of one step
    """

    plant: Plant
    unfollowed: tuple[str, ...]
    divided: tuple[str, ...]
    v_centre: Annotated[FloatArray, "n_v"]
    v_radius: Annotated[FloatArray, "n_v"]
    L0: Annotated[FloatArray, "N m"]
    Z: Annotated[FloatArray, "N m"]
    K: Annotated[FloatArray, "N m"]
    family: Annotated[AffineFamily, "N+m N+n_v"]
    rounding: Rounding
    bound: PeakBound | EllipsoidBound | EnergyBound
    options: Mapping[str, Any]

    def check(self) -> None:
        """Refuse faults that the plant does not have, and gains that the bound does not know."""
        if np.any(self.K) and not isinstance(self.bound, PeakBound):
            raise CertificateError(
                f"the stored design has a gain K of predictions and a bound of kind "
                f"{self.bound.KIND}; peak bounds alone have it"
            )
        named = (*self.unfollowed, *self.divided)
        unknown = [name for name in named if name not in self.plant.names("f")]
        if unknown or len(set(named)) < len(named):
            raise CertificateError(
                f"the stored design names faults {list(named)}; the plant has "
                f"{list(self.plant.names('f'))}"
            )

    def changed(self, **changes: Any) -> "GeneralDesign":
        """Return a copy with other numbers, the derived plant kept: of the same plant, not read."""
        found = replace(self, **changes)
        found.__dict__["extended"] = self.extended
        return found

    @cached_property
    def extended(self) -> Extended:
        """The plant with its faults as states, derived from the stored equations."""
        return _extended(self.plant, self.unfollowed, self.divided)

    @property
    def limits(self) -> Limits:
        """Where estimates and inputs are followed."""
        return Limits.of(self.extended.plant, self.precision, held=False)

    @property
    def places(self) -> list[int]:
        """Places of the followed faults among all."""
        names = self.plant.names("f")
        return [names.index(name) for name in self.extended.followed]

    @property
    def pick(self) -> list[int]:
        """Places of the states and followed faults among states and all faults."""
        n = len(self.plant.x)
        return [*range(n), *(n + k for k in self.places)]

    @property
    def bounds(self) -> tuple[PeakBound | EllipsoidBound, ...]:
        """What holds the errors at every instant, all at once; nothing of an energy gain."""
        if isinstance(self.bound, EnergyBound):
            return ()
        peak = self.bound.peak if isinstance(self.bound, EllipsoidBound) else None
        return (self.bound,) if peak is None else (self.bound, peak)

    @property
    def peak(self) -> PeakBound | None:
        """The peak bounds, if there are any."""
        return next((bound for bound in self.bounds if isinstance(bound, PeakBound)), None)

    @property
    def size(self) -> int:
        """Number of states of the extended plant."""
        return len(self.L0)

    @cached_property
    def middle(self) -> FloatArray:
        """The Jacobian that stands for all in the step, shape (N + m, N + n_v)."""
        return self.family.midpoint

    @property
    def L(self) -> FloatArray:
        """The gain from a reading to the estimate, ``L0 + Z (I - C0 L0)``, shape (N, m)."""
        C0 = self.middle[self.size :, : self.size]
        return np.asarray(self.L0 + self.Z - self.Z @ (C0 @ self.L0))
