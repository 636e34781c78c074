"""What the user hands over: a majorant, gains; and why gains are refused."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.hinf.claims import RESIDUAL, decoupling_residual
from obsynth.designs.hinf.model import Prepared
from obsynth.designs.hinf.record import HinfDesign
from obsynth.designs.hinf.system import Filter
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError


def read_diagonal(value: Any) -> tuple[float, ...]:
    """Return the diagonal of M'M from a sequence or a diagonal matrix."""
    array = np.asarray(value, dtype=float)
    if array.ndim == 2 and array.shape[0] == array.shape[1]:
        if np.any(array - np.diag(np.diag(array))):
            raise ObsynthError("majorant= has to be a diagonal M'M", option="majorant")
        array = np.diag(array)
    if array.ndim != 1 or not np.all(np.isfinite(array)) or np.any(array < 0.0):
        raise ObsynthError(
            f"majorant= is {value!r}; it has to be the diagonal of M'M, not negative",
            option="majorant",
        )
    return tuple(float(v) for v in array)


def read_gains(design: HinfDesign, gains: Mapping[str, ArrayLike]) -> Filter:
    """Return the filter of given gains; F, H and D as in (18)-(19) where they are not given."""
    data = design.data
    n, m, n_f = len(data.A), len(data.C), data.n_f
    shapes = {"K": (n, m), "F": (n, m), "H": (n_f, m), "D": (n_f, m)}
    unknown = sorted(set(gains) - set(shapes))
    if "K" not in gains or unknown:
        raise ObsynthError(
            f"gains are {sorted(gains)}; K is needed, F, H and D may be given", option="gains"
        )
    arrays: dict[str, FloatArray] = {}
    for name, value in gains.items():
        array = np.asarray(value, dtype=float)
        if array.shape != shapes[name] or not np.all(np.isfinite(array)):
            raise ObsynthError(
                f"{name} has shape {array.shape}; {shapes[name]} finite numbers are needed",
                option="gains",
            )
        arrays[name] = array
    chosen = replace(data.standard_filter(arrays["K"]), **arrays)
    state, fault = decoupling_residual(replace(design, gains=chosen))
    for name, left, identity in (("F", state, "(I - F C) L = 0"), ("H", fault, "H C L = I")):
        if left > RESIDUAL * max(1.0, float(np.abs(design.L).max())):
            raise ObsynthError(
                f"{name} does not decouple {', '.join(design.plant.names('f'))}: {identity} is "
                f"missed by {left:.3g}; round {name} so that it holds to the last digits",
                option=name,
                residual=left,
            )
    return chosen


def unstable_gains(prepared: Prepared, index: int, radius: float) -> InfeasibleDesign:
    """Return the refusal of gains whose error grows at a vertex of the Jacobian set."""
    vertex = prepared.design.data.vertices[index]
    varying = prepared.bounds.max > prepared.bounds.min
    names = prepared.design.plant.names("x")
    entries = {
        f"dg_{names[i]}/d{names[j]}": float(vertex[i, j])
        for i, j in np.argwhere(varying & (np.abs(vertex) > 1e-12))
    }
    where = ", ".join(f"{name} = {value:.6g}" for name, value in entries.items())
    return InfeasibleDesign(
        f"the error is unstable with these gains: spectral radius {radius:.6f} at the vertex "
        f"{where or index}",
        [
            "a Jacobian that the plant has there or near it makes the estimation error grow",
            "design gains for this plant, or narrow the ranges of the states",
        ],
        spectral_radius=radius,
        vertex=vertex,
        vertex_index=index,
        entries=entries,
    )
