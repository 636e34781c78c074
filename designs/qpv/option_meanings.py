"""What options mean for a plant: polytopes, starts, performance outputs."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from obsynth.designs.qpv.model import Prepared
from obsynth.designs.qpv.polytopes import Shape, box, cross, hull
from obsynth.designs.qpv.region import Ellipsoid
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError


def noise_centre(model: Plant) -> FloatArray:
    """Return the middle of the declared disturbances, 0 where they have no bound, shape (n_w,)."""
    w = np.where(np.isfinite(model.box("w")).all(axis=1, keepdims=True), model.box("w"), 0.0)
    return np.asarray(w.mean(axis=1))


def unit_shape(polytope: Any, region: Ellipsoid) -> Shape:
    """Return the polytope for kappa = 1."""
    if isinstance(polytope, str):
        return (box if polytope == "box" else cross)(region.half_widths)
    if polytope.ndim != 2 or polytope.shape[1] != region.dimension:
        raise ObsynthError(
            f"polytope has shape {polytope.shape}; vertices of {region.dimension} coordinates are "
            "rows, offsets from the centre c",
            option="polytope",
        )
    return hull(polytope)


def reach(unit: Shape, region: Ellipsoid) -> float:
    """Return the largest norm of a vertex in the region's metric: 1 on its boundary."""
    vertices = unit.vertices
    values = np.einsum("ki,ik->k", vertices, np.linalg.solve(region.Q, vertices.T))
    return float(np.sqrt(values.max()))


def cover(unit: Shape, region: Ellipsoid) -> float:
    """Return how much the polytope has to be enlarged to hold the region."""
    normals = unit.normals.mid[:, 0, :]
    return float(np.sqrt(np.einsum("ki,ij,kj->k", normals, region.Q, normals).max()))


def one_of_each_pair(vertices: FloatArray) -> FloatArray:
    """Keep one of every pair v, -v, and those without a mirror image."""
    seen: set[bytes] = set()
    kept = []
    for row in vertices + 0.0:
        if (0.0 - row).tobytes() not in seen:
            seen.add(row.tobytes())
            kept.append(row)
    return np.array(kept)


def start_corners(value: FloatArray, names: tuple[str, ...]) -> FloatArray:
    """Read half widths of the box of e(0), or its vertices; one of every pair v, -v."""
    n = len(names)
    if value.ndim == 2 and value.shape[1] == n and len(value):
        return one_of_each_pair(value)
    if value.shape != (n,) or np.any(value < 0):
        raise ObsynthError(
            f"initial_error holds the half widths of {', '.join(names)}, or vertices in rows; "
            f"given was {value.tolist()}",
            option="initial_error",
        )
    ends = [(-side, side) if side > 0 else (0.0,) for side in value.tolist()]
    return one_of_each_pair(np.array(list(itertools.product(*ends))))


def read_performance_output(value: Any, prepared: Prepared) -> FloatArray:
    """Read Cz for every vertex of the scheduling, shape (V, n_z, n)."""
    n, n_x = len(prepared.names), len(prepared.model.x)
    count = prepared.vertices
    if value is None:
        value = np.eye(n)[n_x:] if n > n_x else np.eye(n)
    Cz = np.atleast_2d(np.asarray(value, dtype=float))
    if Cz.ndim == 2:
        Cz = np.broadcast_to(Cz, (count, *Cz.shape)).copy()
    if Cz.shape[0] != count or Cz.shape[2] != n:
        raise ObsynthError(
            f"performance_output has shape {np.shape(value)}; z = Cz e needs {n} columns "
            f"({', '.join(prepared.names)}), and {count} matrices if it varies",
            option="performance_output",
        )
    return Cz
