"""The stored design, and the coordinates z = S x in which its bounds move.

    z' = D z + (S A - D S - L C) x + L (C x) + S (B u + offset + G theta + W1 w)

for any S, D and L: docs/methods/set_adaptive_observer.md, Other coordinates.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np

from obsynth.derive.jacobian.slope_signs import with_ranges
from obsynth.derive.rigour import allowance, exact, inverse, nearest
from obsynth.designs.core.errors import CertificateError
from obsynth.designs.core.record import Design, Record
from obsynth.designs.set_adaptive.bounds import EndBounds
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray, IntArray
from obsynth.symbolic.errors import ObsynthError


@dataclass(frozen=True, eq=False)
class Coordinates(Record):
    """S and D of the equation above, and ranges of the derivatives of states as in `System`."""

    S: Annotated[FloatArray, "n n"]
    D: Annotated[FloatArray, "n n"]
    rate: Annotated[FloatArray, "n 2"]
    input_rate: Annotated[FloatArray, "n n_u"]

    def check(self) -> None:
        """Refuse coordinates that do not tell the states apart."""
        try:
            inverse(exact(self.S))
        except ObsynthError as error:
            raise CertificateError("S of the stored design has no inverse") from error


@dataclass(frozen=True, eq=False)
class Frame:
    """The plant in the coordinates of the bounds: exact in S, L and D, every number rounded once.

    C (m, n), G (n, n_f), W1 (n, n_w): of z, C S^-1, S G and S W1
    back, own (n, n): S^-1 and D S + L C, by what A differs from which the drive is
    """

    C: FloatArray
    G: FloatArray
    W1: FloatArray
    back: FloatArray | None = None
    own: FloatArray | None = None


def read_coordinates(rows: tuple[tuple[float, ...], ...], names: tuple[str, ...]) -> None:
    """Refuse an S that is not square, or that does not tell the states apart."""
    S, n = np.array(rows), len(names)
    if S.shape != (n, n):
        raise ObsynthError(
            f"coordinates has shape {S.shape}; S of z = S x has a row and a column for each of "
            f"{', '.join(names)}",
            option="coordinates",
        )
    try:
        inverse(exact(S))
    except ObsynthError as error:
        raise ObsynthError(
            f"coordinates do not tell {', '.join(names)} apart: S has no inverse",
            option="coordinates",
        ) from error


def build_frame(
    C: FloatArray, G: FloatArray, W1: FloatArray, L: FloatArray, given: Coordinates | None
) -> Frame:
    """Return the frame of a plant's own coordinates, or of others."""
    if given is None:
        return Frame(C, G, W1)
    S, D = exact(given.S), exact(given.D)
    back, shown = inverse(S), exact(C)
    rows = (shown @ back, S @ exact(G), S @ exact(W1), back, D @ S + exact(L) @ shown)
    return Frame(*map(nearest, rows))


@dataclass(frozen=True, eq=False)
class System(Record):
    """The plant in the form (3) of the paper, x' = A x + B u + offset + G theta + W1 w.

    w_centre, w_radius: box of the disturbances, zero where the noise is left out
    rate: range of the derivative of C x over the declared ranges, without inputs that enter with a
        constant factor, which `input_rate` has
    """

    plant: Plant
    bounds: EndBounds
    C: Annotated[FloatArray, "m n"]
    G: Annotated[FloatArray, "n n_f"]
    W1: Annotated[FloatArray, "n n_w"]
    W2: Annotated[FloatArray, "m n_w"]
    w_centre: Annotated[FloatArray, "n_w"]
    w_radius: Annotated[FloatArray, "n_w"]
    rate: Annotated[FloatArray, "m 2"]
    input_rate: Annotated[FloatArray, "m n_u"]

    @property
    def output_box(self) -> FloatArray:
        """Ranges of C x, every output a positive multiple of one state, shape (m, 2)."""
        shown = self.plant.box("x")[np.argmax(self.C, axis=1)]
        box: FloatArray = self.C.max(axis=1)[:, None] * shown
        return box

    @property
    def noise(self) -> FloatArray:
        """Bound of the measurement noise, shape (m,)."""
        bound: FloatArray = np.abs(self.W2) @ self.w_radius
        return bound


@dataclass(frozen=True, eq=False)
class SetDesign(System, Design):
    """Everything that is deployed and proved of the set adaptive observer.

    A_lower, A_upper: least A_m and largest A_M of the continuous form (noise included)
    A_upper_step: the same with what the outputs move within a step
    A_lower_box: least A_m for ends anywhere in the declared ranges
    alpha, alpha_step: decay of the continuous form and of the step
    fault_outputs: the output that adapts each fault
    coordinates: z = S x in which the bounds move, None for x itself; L is the gain in them
    """

    Ts: float
    noisy: bool
    A_lower: Annotated[FloatArray, "n n"]
    A_upper: Annotated[FloatArray, "n n"]
    A_upper_step: Annotated[FloatArray, "n n"]
    A_lower_box: Annotated[FloatArray, "n n"]
    L: Annotated[FloatArray, "n m"]
    p: Annotated[FloatArray, "n"]
    alpha: float
    alpha_step: float
    Gamma: Annotated[FloatArray, "n_f"]
    law: Literal["cooperative", "printed"]
    fault_outputs: Annotated[IntArray, "n_f"]
    window: float | None
    coordinates: Coordinates | None
    options: Mapping[str, Any]

    @cached_property
    def frame(self) -> Frame:
        """The plant in the coordinates of the bounds."""
        return build_frame(self.C, self.G, self.W1, self.L, self.coordinates)

    def error_matrix(self, A: FloatArray) -> FloatArray:
        """Return A - L C for a bound of A, or D in coordinates of their own, rounded."""
        own: FloatArray = A - self.L @ self.C
        return own if self.coordinates is None else self.coordinates.D

    @cached_property
    def assumed(self) -> Plant:
        """The plant with the stored boxes of the disturbances, zero where noise is left out."""
        ends = [self.w_centre - self.w_radius, self.w_centre + self.w_radius]
        box = np.column_stack(ends)
        same = np.array_equal(box, self.plant.box("w"))
        return self.plant if same else with_ranges(self.plant, box, "w")

    @property
    def rounding(self) -> float:
        """What the rounding of one step may be, relative to the size of its terms."""
        count = len(self.plant.x) * (1 if self.coordinates is None else 4)
        return allowance(self.precision, count, self.Ts * self.mu)

    @property
    def mu(self) -> float:
        """Not below any diagonal entry of L C - A_m."""
        fastest = float((-np.diag(self.error_matrix(self.A_lower_box))).max())
        return fastest * (1.0 + 2.0**-40)

    def check(self) -> None:
        """Refuse numbers of outputs that there are not."""
        if ((self.fault_outputs < 0) | (self.fault_outputs >= len(self.C))).any():
            raise CertificateError("fault_outputs of the stored design name no outputs")
