"""What is known of disturbances and fault rates, as boxes and as the ellipsoid of the paper."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.derive.errors import StructureError
from obsynth.derive.rigour import middle_and_radius
from obsynth.symbolic.arrays import FloatArray

if TYPE_CHECKING:
    from obsynth.symbolic import Plant


@dataclass(frozen=True, eq=False)
class NoiseBox:
    """Boxes of the disturbances and of the fault increments.

    w_centre, w_radius (n_w,): ``|w - w_centre| <= w_radius``, elementwise
    rate (n_f,): ``|f_{k+1} - f_k| <= rate``, per step
    """

    w_centre: FloatArray
    w_radius: FloatArray
    rate: FloatArray

    @property
    def stacked(self) -> FloatArray:
        """Radii of v_k = (w_k, eps_k, w_{k+1}), shape (2 n_w + n_f,)."""
        return np.concatenate([self.w_radius, self.rate, self.w_radius])

    def equal_weights(self, blocks: int = 3) -> FloatArray:
        """Weights of the scaled components of v, summing to 1 (errata 4 of the method).

        ``v' Q_v v <= 1`` with ``Q_v = 1/3 diag(Q_w, Q_eps, Q_w)`` and the
        ellipsoids that circumscribe the boxes, ``Q_w = diag(1/(n_w b_i^2))``,
        ``Q_eps = diag(1/(n_f rate_j^2))``, in coordinates scaled by the boxes.
        With ``blocks=2`` the last block (w_{k+1}) is absent.
        """
        n_w, n_f = self.w_radius.size, self.rate.size
        parts = [np.full(n_w, 1.0 / max(n_w, 1)), np.full(n_f, 1.0 / max(n_f, 1))]
        if blocks == 3:
            parts.append(parts[0])
        present = sum(1 for part in parts if part.size)
        return np.concatenate(parts) / max(present, 1)


def noise_box(model: Plant) -> NoiseBox:
    """Read the boxes from a discrete plant."""
    unbounded = [s.name for s in model.w if not np.isfinite([s.lower, s.upper]).all()]
    if unbounded:
        raise StructureError(
            f"disturbance {', '.join(unbounded)} has no bound, so no interval can be guaranteed; "
            "declare it with bound= or range=, or use a method for finite energy (HinfUIO)",
            symbols=tuple(unbounded),
        )
    rateless = [s.name for s in model.f if s.rate is None and not s.constant]
    if rateless:
        raise StructureError(
            f"fault {', '.join(rateless)} has no rate bound, so how far it moves in one step is "
            "unknown; declare it with rate= (per second) or constant=True",
            symbols=tuple(rateless),
        )
    box: Any = model.box("w")
    centre, radius = middle_and_radius(box[:, 0], box[:, 1])
    exact = (centre - radius <= box[:, 0]) & (box[:, 1] <= centre + radius)
    symmetric = box[:, 0] == -box[:, 1]
    radius = np.where(symmetric, box[:, 1], radius)
    centre = np.where(symmetric, 0.0, centre)
    if not np.all(exact | symmetric):
        raise StructureError("the box of the disturbances cannot be centred in doubles")
    rate = np.array([0.0 if s.constant else float(s.rate or 0.0) for s in model.f])
    return NoiseBox(centre, radius, rate)
