"""The stored design of the method, and the bounds that follow from it."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np

from obsynth.derive.rigour import UNIT, Exact, above, exact, inverse, magnitude, nearest
from obsynth.designs.core.errors import CertificateError
from obsynth.designs.core.record import Design
from obsynth.designs.interval.decoupling import (
    Decoupled,
    Reduced,
    Transformation,
    decouple_exactly,
)
from obsynth.designs.interval.model import IntervalModel
from obsynth.designs.interval.rows import (
    Part,
    Rows,
    estimate_rows,
    first_rows,
    measured_rows,
    state_rows,
)
from obsynth.designs.interval.widths import (
    PartWidth,
    WidthMap,
    contraction_width,
    linear_widths,
    part_width,
    row_widths,
)
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

Bound = Literal["vertex", "paper"]
SWEEPS = 2
SMALL = 1e-12
NEGATIVE = 1e-9
"""How far below zero rounded gains may leave an entry of R that is meant to be zero."""


@dataclass(frozen=True, eq=False)
class IntervalDesign(Design):
    """Everything that is deployed and proved.

    nominal: the A around which the paper's bound is taken
    error, width: steady bounds e*, w* of the errors and widths of r; empty before they are known
    """

    model: IntervalModel
    transformation: Transformation
    nominal: Annotated[FloatArray, "n n"]
    P: Annotated[FloatArray, "n-n_f-q n-n_f-q"]
    L: Annotated[FloatArray, "n-n_f-q m-n_f-q"]
    bound: Bound
    contraction: bool
    error: Annotated[FloatArray, "n-n_f-q"]
    width: Annotated[FloatArray, "n-n_f-q"]
    options: Mapping[str, Any]

    def check(self) -> None:
        """Refuse numbers for which the observer is not defined."""
        try:
            _ = self.decoupled, self.S
        except ObsynthError as error:
            raise CertificateError(f"the stored design decouples nothing: {error}") from error

    @property
    def plant(self) -> Plant:
        """The discrete plant."""
        return self.model.plant

    @property
    def n_f(self) -> int:
        """Number of faults that are estimated."""
        return len(self.plant.f)

    @cached_property
    def decoupled(self) -> Decoupled:
        """The exact decoupling."""
        return decouple_exactly(self.model, self.transformation)

    @cached_property
    def reduced(self) -> Reduced:
        """The plant without its faults, in doubles."""
        return Reduced.of(self.model, self.decoupled)

    @cached_property
    def S(self) -> Exact:
        """Inverse of P, exact."""
        return inverse(exact(self.P))

    @cached_property
    def prediction(self) -> Part:
        """The bounded quantity: r of the next instant."""
        P = exact(self.P)
        return Part(self.model, self.decoupled, self.S, P @ self.decoupled.T2, P @ exact(self.L))

    @cached_property
    def share(self) -> Part:
        """What is known of the fault before the next measurement."""
        X = -self.decoupled.F_left[: self.n_f]
        Y = exact(np.zeros((self.n_f, len(self.decoupled.N12))))
        return Part(self.model, self.decoupled, self.S, X, Y)

    @property
    def least_entry(self) -> float:
        """The smallest entry of R = P (A2 - L C2) P^-1, which Theorem 1 wants nonnegative."""
        return float(nearest(self.prediction.on_r(exact(self.nominal))).min(initial=np.inf))

    @property
    def nonnegative(self) -> bool:
        """Whether R is nonnegative, up to what rounded gains leave below zero."""
        return self.least_entry >= -NEGATIVE

    def _rows_of(self, part: Part) -> Rows:
        if self.bound == "vertex":
            return part.vertex_rows()
        return part.paper_rows(exact(self.nominal))

    @cached_property
    def first_rows(self) -> Rows:
        """Bounds of r for a box of states."""
        return first_rows(exact(self.P) @ self.decoupled.T2)

    @cached_property
    def prediction_rows(self) -> Rows:
        """Bounds of r of the next instant."""
        return self._rows_of(self.prediction)

    @cached_property
    def share_rows(self) -> Rows:
        """Bounds of the first share of the fault."""
        return self._rows_of(self.share)

    @cached_property
    def state_rows(self) -> Rows:
        """Bounds of x."""
        return state_rows(self.prediction)

    @cached_property
    def estimate_rows(self) -> Rows:
        """Bounds of the fault."""
        return estimate_rows(self.prediction, self.n_f)

    @cached_property
    def contraction_rows(self) -> tuple[tuple[int, Rows], ...]:
        """One sweep of the measurement contraction: component of r and its bounds."""
        if not self.contraction:
            return ()
        Q = nearest(self.decoupled.C2 @ self.S)
        return tuple(
            (j, measured_rows(self.prediction, i, j))
            for i, j in np.ndindex(Q.shape)
            if abs(Q[i, j]) > SMALL
        )

    @cached_property
    def width_map(self) -> WidthMap:
        """The recursion of errors and widths of r."""
        sweep = tuple(
            contraction_width(rows, rows.slack(self.precision), self.prediction, component)
            for component, rows in self.contraction_rows
        )
        return WidthMap(self._width_of(self.prediction, self.prediction_rows), sweep * SWEEPS)

    @property
    def spectral_radius(self) -> float:
        """By what the errors of one step grow, without contraction."""
        return float(np.abs(np.linalg.eigvals(nearest(self.width_map.part.E))).max(initial=0.0))

    def _width_of(self, part: Part, rows: Rows) -> PartWidth:
        nominal = None if self.bound == "vertex" else exact(self.nominal)
        return part_width(part, rows, rows.slack(self.precision), nominal)

    @cached_property
    def half_widths(self) -> FloatArray:
        """Steady half widths of states, then faults, from e* and w*, rounded upwards."""
        return self.half_widths_of(self.error, self.width)

    def half_widths_of(self, e: FloatArray, w: FloatArray) -> FloatArray:
        """Return half widths of states, then faults, for errors and widths of r, rounded up."""
        share = row_widths(self._width_of(self.share, self.share_rows), e, w)
        size = self.share.size + exact(share)
        x = self._linear_widths(self.state_rows, w)
        f = self._linear_widths(self.estimate_rows, w, share_upper=size, share_lower=size)
        total = np.concatenate([exact(x), exact(f) + exact(share)])
        return above(total * exact(1.0 + 4.0 * UNIT[self.precision]) / 2)

    def first_width(self, x: FloatArray) -> FloatArray:
        """Return the widths of r that begins from a box of states of half widths x."""
        table = magnitude(exact(self.P) @ self.decoupled.T2)
        slack = exact(2.0 * self.first_rows.slack(self.precision))
        size = np.concatenate([self.model.size("x")] * 2 + [exact(np.ones(1))])
        used = np.where((table != 0).any(axis=0), x, 0.0)
        if not np.isfinite(used).all():
            return np.full(len(table), np.inf)
        return above(table @ exact(2.0 * used) + slack @ size)

    def _linear_widths(self, rows: Rows, w: FloatArray, **more: Exact) -> FloatArray:
        return linear_widths(rows, rows.slack(self.precision), self.prediction, w, more)
