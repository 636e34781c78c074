"""The gain by a linear program, and what follows from a gain."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from luenberger.lmis import error_matrices, noise_matrix
from luenberger.model import LuenbergerModel
from luenberger.record import Comparison, LuenbergerDesign
from obsynth.derive.rigour import Enclosure, add_up
from obsynth.designs.core.boxes import cut_box
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.core.record import precision_of
from obsynth.designs.core.rounding import rounding_bound
from obsynth.designs.core.signals import finite_box
from obsynth.designs.lmi.expression import full, scalar
from obsynth.designs.lmi.problem import Problem
from obsynth.symbolic.arrays import FloatArray

ROOM = 1.0 + 1e-9
CELLS = 64


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
    precision = precision_of(options)
    closed, missing = (
        Comparison(found.N * ROOM, found.n * ROOM)
        for found in (compare(model, gain, precision) for gain in (L, np.zeros_like(L)))
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


def prediction(model: LuenbergerModel, L: FloatArray) -> ca.Function:
    """(xhat, u, y) -> what the state is predicted to be, corrected by L."""
    plant = model.plant
    sizes = {"x": len(plant.x), "u": len(plant.u), "y": len(model.C)}
    x, u, y = (ca.SX.sym(name, size) for name, size in sizes.items())
    quiet = [ca.DM.zeros(0)] * 2 + [ca.DM(model.w_centre)] + [ca.DM.zeros(0)] * 2
    innovation = y - ca.DM(model.C) @ x - ca.DM(model.W2 @ model.w_centre)
    moved = plant.function()(x, u, *quiet)[0] + ca.DM(L) @ innovation
    return ca.Function("prediction", [x, u, y], [moved], [*sizes], ["moved"])


def rounding(model: LuenbergerModel, L: FloatArray, precision: str) -> FloatArray:
    """Bound what rounding adds to a prediction, readings and all, shape (n,)."""
    plant = model.plant
    x, u, w = (finite_box(plant, kind) for kind in "xuw")
    size = np.abs(model.C) @ np.abs(x).max(axis=1) + np.abs(model.W2) @ np.abs(w).max(axis=1)
    y = np.column_stack([-size, size]) * ROOM
    ends = {"x": cut_box(x, CELLS), "u": (u[:, :1], u[:, 1:]), "y": (y[:, :1], y[:, 1:])}
    return rounding_bound(prediction(model, L), ends, precision, read=("y",))["moved"].error


def compare(model: LuenbergerModel, L: FloatArray, precision: str) -> Comparison:
    """Return N and n for a gain, rounding of a step included, never below the exact ones."""
    X = error_matrices(enclosed(model), Enclosure.of(model.C), Enclosure.of(L))
    Z = noise_matrix(Enclosure.of(model.W1), Enclosure.of(model.W2), Enclosure.of(L))
    n = Enclosure.of(magnitude(Z)) @ Enclosure.of(model.w_radius[:, None])
    return Comparison(
        magnitude(X).max(axis=0), add_up(magnitude(n)[:, 0], rounding(model, L, precision))
    )


def magnitude(found: Enclosure) -> FloatArray:
    """Return what no entry exceeds in absolute value."""
    return np.nextafter(np.abs(found.mid) + found.rad, np.inf)


def enclosed(model: LuenbergerModel) -> Enclosure:
    """Enclose A + M at all vertices, shape (N, n, n)."""
    vertices = model.family.vertices()
    radius = np.broadcast_to(model.family.radius, vertices.shape)
    return Enclosure.of(model.A) + Enclosure.of(vertices, radius)
