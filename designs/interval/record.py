"""The stored design of the method, and the bounds that follow from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from obsynth.derive.rigour import UNIT, Exact, above, exact, inverse, magnitude, nearest
from obsynth.designs.core.record import read_array, reading
from obsynth.designs.interval.decoupling import Decoupled, Transformation, decouple_exactly
from obsynth.designs.interval.model import IntervalModel
from obsynth.designs.interval.rows import (
    Part,
    Precision,
    Rows,
    estimate_rows,
    measured_rows,
    state_rows,
)
from obsynth.designs.interval.widths import (
    PartWidth,
    WidthMap,
    contraction_width,
    part_width,
    row_widths,
)
from obsynth.symbolic.arrays import FloatArray

METHOD = "interval_observer"
Bound = Literal["vertex", "paper"]
SWEEPS = 2
SMALL = 1e-12


@dataclass(frozen=True, eq=False)
class IntervalDesign:
    """Everything that is deployed and proved.

    chosen: H, R0, K0, N, R1, K1 as stored
    nominal: the A around which the paper's bound is taken
    precision: in which the step may be evaluated
    error, width: e* and w*: steady bounds of the errors and widths of r; empty before they are
        known
    options: the options of the method, as given
    """

    model: IntervalModel
    chosen: Transformation
    nominal: FloatArray
    P: FloatArray
    L: FloatArray
    bound: Bound
    contraction: bool
    precision: Precision
    error: FloatArray
    width: FloatArray
    options: Mapping[str, Any]

    @property
    def n_f(self) -> int:
        """Number of faults that are estimated."""
        return len(self.model.plant.f)

    @cached_property
    def plant(self) -> Decoupled:
        """The exact decoupling."""
        return decouple_exactly(self.model, self.chosen)

    @cached_property
    def S(self) -> Exact:
        """Inverse of P, exact."""
        return inverse(exact(self.P))

    @cached_property
    def prediction(self) -> Part:
        """The bounded quantity: r of the next instant."""
        P = exact(self.P)
        return Part(self.model, self.plant, self.S, P @ self.plant.T2, P @ exact(self.L))

    @cached_property
    def share(self) -> Part:
        """What is known of the fault before the next measurement."""
        X = -self.plant.F_left[: self.n_f]
        Y = np.full((self.n_f, len(self.plant.N12)), exact(0.0).item(), dtype=object)
        return Part(self.model, self.plant, self.S, X, Y)

    def _rows_of(self, part: Part) -> Rows:
        return part.vertex_rows() if self.bound == "vertex" else part.paper_rows(self._nominal)

    @property
    def _nominal(self) -> Exact:
        return exact(self.nominal)

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
        Q = nearest(self.plant.C2 @ self.S)
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

    def _width_of(self, part: Part, rows: Rows) -> PartWidth:
        nominal = None if self.bound == "vertex" else self._nominal
        return part_width(part, rows, rows.slack(self.precision), nominal)

    @cached_property
    def half_widths(self) -> FloatArray:
        """Steady half widths of states, then faults, from e* and w*, rounded upwards."""
        state, fault = self.state_rows, self.estimate_rows
        share = row_widths(self._width_of(self.share, self.share_rows), self.error, self.width)
        x = self._linear_width(state)
        size = self.share.size + exact(share)
        f = exact(self._linear_width(fault, {"share_upper": size, "share_lower": size}))
        f = f + exact(share)
        unit = exact(1.0 + 4.0 * UNIT[self.precision])
        return np.asarray(above(np.concatenate([exact(x), f]) * unit / 2), dtype=float)

    def _linear_width(self, rows: Rows, more: Mapping[str, Exact] | None = None) -> FloatArray:
        """Width of bounds that are linear in r and y; `more`: sizes of what else they take."""
        n2, w = len(self.P), exact(self.width)
        low, high = rows.lower[0], rows.upper[0]
        names = list(rows.sizes)
        start = sum(rows.sizes[name] for name in names[: names.index("r_upper")])
        of_r = magnitude(high[:, start : start + n2]) + magnitude(
            high[:, start + n2 : start + 2 * n2]
        )
        table = exact(2.0 * rows.slack(self.precision))
        x, v = self.model.size("x"), self.model.size("w")
        r = magnitude(exact(self.P) @ self.plant.T2) @ x + w
        y = magnitude(self.model.C) @ x + magnitude(self.model.W2) @ v
        known = {"r_upper": r, "r_lower": r, "y": y, "one": exact(np.ones(1)), **(more or {})}
        total = of_r @ w + high[:, -1] - low[:, -1]
        at = 0
        for name, size in rows.sizes.items():
            if name in known:
                total = total + table[:, at : at + size] @ known[name]
            at += size
        return above(total)

    def to_record(self) -> dict[str, Any]:
        """Return the design as JSON-able data."""
        names = ("H", "R0", "K0", "N", "R1", "K1")
        return {
            "model": self.model.to_record(),
            "transformation": {name: getattr(self.chosen, name).tolist() for name in names},
            "nominal": self.nominal.tolist(),
            "P": self.P.tolist(),
            "L": self.L.tolist(),
            "bound": self.bound,
            "contraction": self.contraction,
            "precision": self.precision,
            "error": self.error.tolist(),
            "width": self.width.tolist(),
            "options": dict(self.options),
        }

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> IntervalDesign:
        """Read and check the data of `to_record`."""
        with reading():
            model = IntervalModel.from_record(record["model"])
            n, q, m = model.n, model.q, len(model.C)
            shapes = {"H": (n, n), "N": (m, m), **dict.fromkeys(("R0", "K0", "R1", "K1"), (q, q))}
            stored = record["transformation"]
            chosen = Transformation(**{k: read_array(stored[k], s, k) for k, s in shapes.items()})
            if record["bound"] not in ("vertex", "paper"):
                raise ValueError(f"bound {record['bound']!r}")
            if record["precision"] not in UNIT:
                raise ValueError(f"precision {record['precision']!r}")
            return cls(
                model,
                chosen,
                read_array(record["nominal"], (n, n), "nominal"),
                read_array(record["P"], (n - q, n - q), "P"),
                read_array(record["L"], (n - q, m - q), "L"),
                record["bound"],
                bool(record["contraction"]),
                record["precision"],
                read_array(record["error"], (n - q,), "error"),
                read_array(record["width"], (n - q,), "width"),
                dict(record["options"]),
            )
