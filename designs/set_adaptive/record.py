"""The stored design: plain data from which step, ode and proofs are made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.designs.core.errors import CertificateError
from obsynth.designs.core.record import plain_fields, read_array, reading
from obsynth.designs.set_adaptive.bounds import EndBounds
from obsynth.designs.set_adaptive.transition import PRECISIONS, allowance
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray

METHOD = "set_adaptive_observer"
KINDS = ("adaptive", "bank")


@dataclass(frozen=True, eq=False)
class SetDesign:
    """Everything that is deployed and proved of the set adaptive observer.

    plant: continuous
    Ts: sample time of the step
    C, G, W1, W2, w_centre, w_radius, rate, input_rate: see `Structure`
    A_lower, A_upper (n, n): least A_m and largest A_M of the continuous form (noise included)
    A_upper_step (n, n): the same with what the outputs move within a step
    A_lower_box (n, n): least A_m for ends anywhere in the declared ranges
    L, p (n, m), (n,)
    alpha, alpha_step: decay of the continuous form and of the step
    Gamma (q,)
    fault_outputs (q,): the output that adapts each fault
    options: the options of the method, as given
    """

    plant: Plant
    Ts: float
    bounds: EndBounds
    C: FloatArray
    G: FloatArray
    W1: FloatArray
    W2: FloatArray
    w_centre: FloatArray
    w_radius: FloatArray
    rate: FloatArray
    input_rate: FloatArray
    A_lower: FloatArray
    A_upper: FloatArray
    A_upper_step: FloatArray
    A_lower_box: FloatArray
    L: FloatArray
    p: FloatArray
    alpha: float
    alpha_step: float
    Gamma: FloatArray
    fault_outputs: NDArray[np.int64]
    options: Mapping[str, Any]

    @property
    def law(self) -> str:
        """``"cooperative"`` or ``"printed"``."""
        return str(self.options["law"])

    @property
    def precision(self) -> str:
        """``"double"`` or ``"single"``."""
        return str(self.options.get("precision", "double"))

    @property
    def rounding(self) -> float:
        """What the rounding of one step may be, relative to the size of its terms."""
        return allowance(self.precision, len(self.plant.x), self.Ts * self.mu)

    @property
    def window(self) -> float | None:
        """Length of the monitors' window in seconds; None for all time."""
        value = self.options["window"]
        return None if value is None else float(value)

    @property
    def noise(self) -> FloatArray:
        """Bound of the measurement noise, shape (m,)."""
        bound: FloatArray = np.abs(self.W2) @ self.w_radius
        return bound

    @property
    def mu(self) -> float:
        """Not below any diagonal entry of L C - A_m."""
        return float((-np.diag(self.A_lower_box - self.L @ self.C)).max()) * (1.0 + 2.0**-40)

    def to_record(self) -> dict[str, Any]:
        """Return the design as JSON-able data."""
        return {"kind": "adaptive", **plain_fields(self)}

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> SetDesign:
        """Read and check the data of `to_record`."""
        with reading():
            plant = Plant.from_dict(record["plant"])
            sizes = {
                "n": len(plant.x),
                "m": len(plant.output),
                "u": len(plant.u),
                "q": len(plant.f),
                "w": len(plant.w),
                "2": 2,
            }
            arrays = {
                name: read_array(record[name], tuple(sizes[letter] for letter in letters), name)
                for name, letters in _SHAPES.items()
            }
            design = cls(
                plant=plant,
                Ts=float(record["Ts"]),
                bounds=EndBounds.from_record(record["bounds"], plant),
                alpha=float(record["alpha"]),
                alpha_step=float(record["alpha_step"]),
                fault_outputs=np.asarray(record["fault_outputs"], dtype=np.int64),
                options=dict(record["options"]),
                **arrays,
            )
        design._check()
        return design

    def _check(self) -> None:
        outputs, m = self.fault_outputs, len(self.plant.output)
        if outputs.shape != (len(self.plant.f),) or np.any((outputs < 0) | (outputs >= m)):
            raise CertificateError("fault_outputs of the stored design name no outputs")
        if self.precision not in PRECISIONS:
            raise CertificateError(f"precision = {self.precision!r} in the stored design")
        if self.options.get("law") not in ("cooperative", "printed"):
            raise CertificateError(f"law = {self.options.get('law')!r} in the stored design")


_SHAPES: Mapping[str, str] = {
    "C": "mn",
    "G": "nq",
    "W1": "nw",
    "W2": "mw",
    "w_centre": "w",
    "w_radius": "w",
    "rate": "m2",
    "input_rate": "mu",
    "A_lower": "nn",
    "A_upper": "nn",
    "A_upper_step": "nn",
    "A_lower_box": "nn",
    "L": "nm",
    "p": "n",
    "Gamma": "q",
}
