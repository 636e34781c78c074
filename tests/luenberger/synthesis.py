"""The gain by a linear program, and what follows from a gain."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from luenberger.lmis import error_matrices, noise_matrix
from luenberger.model import LuenbergerModel
from luenberger.record import Comparison, LuenbergerDesign
from obsynth.derive.rigour import Enclosure
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.lmi.expression import full, scalar
from obsynth.designs.lmi.problem import Problem
from obsynth.symbolic.arrays import FloatArray

ROOM = 1.0 + 1e-9


def gain_problem(model: LuenbergerModel, size: FloatArray) -> Problem:
    """State: minimise t with N >= |A + M - L C| at every vertex and N size <= t size."""
    n, m = len(model.A), len(model.C)
    L, N, t = full("L", n, m), full("N", n, n), scalar("t")
    problem = Problem("Luenberger gain")
    for k, A in enumerate(model.A + model.family.vertices()):
        X = error_matrices(A, model.C, L)
        problem.add(f"above {k}", N - X >= 0.0)
        problem.add(f"below {k}", N + X >= 0.0)
    problem.add("decay", t * size[:, None] - N @ size[:, None] >= 0.0)
    problem.minimise(t)
    return problem


def solve_gain(model: LuenbergerModel) -> FloatArray:
    """Return the gain with the fastest decay in units of the declared ranges."""
    box = model.plant.box("x")
    return gain_problem(model, 0.5 * (box[:, 1] - box[:, 0])).solve()["L"]


def with_gain(
    model: LuenbergerModel, L: FloatArray, options: Mapping[str, Any]
) -> LuenbergerDesign:
    """Complete a design with a gain, or refuse a gain whose error is not seen to decay."""
    closed, missing = (
        Comparison(found.N * ROOM, found.n * ROOM)
        for found in (compare(model, L), compare(model, np.zeros_like(L)))
    )
    radius = float(np.abs(np.linalg.eigvals(closed.N)).max())
    if radius >= 1.0:
        raise InfeasibleDesign(
            f"|A + M - L C| has the spectral radius {radius:.6g}; below 1 is needed",
            ["narrow the ranges of the states, or measure more of them"],
            spectral_radius=radius,
        )
    b = np.linalg.solve(np.eye(len(L)) - closed.N, closed.n + 1e-9 * closed.n.max()) * ROOM
    return LuenbergerDesign(model, L, closed, missing, b, options)


def compare(model: LuenbergerModel, L: FloatArray) -> Comparison:
    """Return N and n for a gain, never below the exact ones."""
    X = error_matrices(enclosed(model), Enclosure.of(model.C), Enclosure.of(L))
    Z = noise_matrix(Enclosure.of(model.W1), Enclosure.of(model.W2), Enclosure.of(L))
    n = Enclosure.of(magnitude(Z)) @ Enclosure.of(model.w_radius[:, None])
    return Comparison(magnitude(X).max(axis=0), magnitude(n)[:, 0])


def magnitude(found: Enclosure) -> FloatArray:
    """Return what no entry exceeds in absolute value."""
    return np.nextafter(np.abs(found.mid) + found.rad, np.inf)


def enclosed(model: LuenbergerModel) -> Enclosure:
    """Enclose A + M at all vertices, shape (N, n, n)."""
    vertices = model.family.vertices()
    radius = np.broadcast_to(model.family.radius, vertices.shape)
    return Enclosure.of(model.A) + Enclosure.of(vertices, radius)
