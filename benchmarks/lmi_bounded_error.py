"""Inequality (51) of the bounded-error observer in an instance that is feasible.

A, B and M as printed in the paper (four digits), both ends of the bounds of M times 0.25,
Q_w = 100 I, Q_eps = 400 I, gamma = 0.01, margin 1e-6, max trace(P): 64 vertices of 28 x 28.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
from lmi_relaxation import relax_sum

from obsynth.derive.rigour import Enclosure, ExactMatrix
from obsynth.designs.lmi.expression import full, scalar, symmetric, trace
from obsynth.designs.lmi.problem import Problem, he, symmetric_block
from obsynth.designs.lmi.proof import prove_family
from obsynth.designs.lmi.reductions import split_common

__all__ = ["ROWS"]

A = np.array([[0.9902, 0, 0.0201, 0], [0, 0.9946, 0, 0.0113], [0, 0, 0.9799, 0], [0, 0, 0, 0.9887]])
B = np.array([[0.0653, 0], [0, 0.0488], [0, 0.0628], [0.0440, 0]])
UPPER = {(0, 0): 65, (0, 2): 39, (1, 1): 33, (1, 3): 37, (2, 2): 144, (3, 3): 78}
LOWER = {(0, 0): 26, (0, 2): -144, (1, 1): 8, (1, 3): -78, (2, 2): -39, (3, 3): -37}
E = np.zeros((4, 3))
E[2, 2] = -1.0
T = np.diag([1.0, 1.0, 0.0, 1.0])
C = np.eye(3, 4)
GAMMA, MARGIN = 0.01, 1e-6
# Typical size of M: the value s = M e of the nonlinearity is measured in it.
SIGMA = 0.01

ABAR = np.block([[T @ A, T @ B], [np.zeros((2, 4)), np.eye(2)]])
CBAR = np.hstack([C, np.zeros((3, 2))])
WBAR = np.block([[np.zeros((4, 5)), E], [np.zeros((2, 3)), np.eye(2), np.zeros((2, 3))]])
VBAR = np.hstack([np.eye(3), np.zeros((3, 5))])
NOISE = GAMMA * np.diag([100.0] * 3 + [400.0] * 2 + [100.0] * 3) / 3.0
V, Y = np.eye(4, 6), np.vstack([T, np.zeros((2, 4))])


def _corners(places: list[tuple[int, int]]) -> Any:
    ends = [(0.25e-4 * LOWER[p], 0.25e-4 * UPPER[p]) for p in places]
    values = np.array(list(product(*ends)))
    family = np.zeros((len(values), 4, 4))
    for k, (i, j) in enumerate(places):
        family[:, i, j] = values[:, k]
    return family


VERTICES = _corners(list(UPPER))


def block_51(P: Any, H: Any, a: Any, b: Any, M: Any, lift: Any, unit: float = 1.0) -> Any:
    """(51) times -1 with U = beta I, s in units of ``unit`` (M divided by it)."""
    X = P @ lift(ABAR) - H @ lift(CBAR)
    Z = P @ lift(WBAR) - H @ lift(VBAR)
    MV = M @ lift(V)
    corner = (1.0 - GAMMA) * P - he(a * (lift(V.T) @ MV))
    identity = lift(np.eye(4))
    rows = [[corner], [a * lift(V), b * identity], [0, 0, lift(NOISE)]]
    rows += [[-X, -(P @ lift(unit * Y)), -Z, P], [-(b * MV), 0, 0, 0, b * identity]]
    return symmetric_block(rows)


def _prove(values: Any) -> Any:
    """All 64 vertices of (51) for the stored P and K, alpha and beta; the worst exactly."""
    P, a, b = values["P"], values["alpha"] / SIGMA, values["beta"] / SIGMA**2
    K = np.linalg.solve(P, values["H"])

    def at(M: Any, lift: Any) -> Any:
        return block_51(lift(P), lift(P) @ lift(K), lift(a), lift(b), lift(M), lift)

    return prove_family(
        "(51)",
        len(VERTICES),
        lambda k: at(VERTICES[k], Enclosure.of),
        lambda k: at(VERTICES[k], ExactMatrix.of),
    )


def _unknowns() -> tuple[Any, ...]:
    return symmetric("P", 6), full("H", 6, 3), scalar("alpha"), scalar("beta")


def _plain(matrix: Any) -> Any:
    return matrix


def _finish(problem: Problem, P: Any, start: float) -> dict[str, Any]:
    problem.maximise(trace(P))
    # Whatever the solver calls its answer, the proof decides.
    solution = problem.solve(accept_inaccurate=True)
    proof = _prove(solution.values).require()
    seconds = time.perf_counter() - start
    return {
        "seconds": seconds,
        "objective": solution.objective,
        "proof": f"{proof} ({solution.status})",
    }


def whole() -> dict[str, Any]:
    """State the 64 blocks as they are, without a modelling language in between."""
    start = time.perf_counter()
    P, H, a, b = _unknowns()
    problem = Problem("(51), whole")
    family = block_51(P, H, a, b, VERTICES / SIGMA, _plain, SIGMA)
    problem.add_lmi("51", family, ">>", margin=MARGIN)
    return _finish(problem, P, start)


def split() -> dict[str, Any]:
    """One common inequality of 24 x 24 and 64 of 8 x 8: exact."""
    start = time.perf_counter()
    P, H, a, b = _unknowns()
    parts = split_common(block_51(P, H, a, b, VERTICES / SIGMA, _plain, SIGMA), "Z")
    problem = Problem("(51), split")
    problem.add_lmi("common", parts.common, ">>", margin=MARGIN)
    problem.add_lmi("members", parts.members, ">>", margin=MARGIN)
    return _finish(problem, P, start)


def rows() -> dict[str, Any]:
    """Relax row by row of M: 12 small inequalities that imply all 64, sufficient."""
    start = time.perf_counter()
    P, H, a, b = _unknowns()
    centre = block_51(P, H, a, b, np.zeros((4, 4)), _plain, SIGMA)
    groups = []
    for row in range(4):
        corners = _corners([p for p in UPPER if p[0] == row]) / SIGMA
        groups.append(block_51(P, H, a, b, corners, _plain, SIGMA) - centre)
    problem = Problem("(51), row relaxation")
    relax_sum(problem, "51", centre, groups)
    return _finish(problem.tightened(MARGIN), P, start)


def naive(solver: str) -> dict[str, Any]:
    """Write it as in the paper: cvxpy, one bmat per vertex, U a full variable."""
    import cvxpy as cp

    start = time.perf_counter()
    P, H = cp.Variable((6, 6), symmetric=True), cp.Variable((6, 3))
    U, a, b = cp.Variable((4, 4)), cp.Variable(), cp.Variable()
    constraints = [P >> MARGIN * np.eye(6), a >= 0, b >= 0]
    zero = np.zeros
    for M in VERTICES:
        S1 = -(1 - GAMMA) * P + a * (V.T @ (M + M.T) @ V)
        X, Z, PY, UM = P @ ABAR - H @ CBAR, P @ WBAR - H @ VBAR, P @ Y, U @ M @ V
        matrix = cp.bmat(
            [
                [S1, -a * V.T, zero((6, 8)), X.T, UM.T],
                [-a * V, -b * np.eye(4), zero((4, 8)), PY.T, zero((4, 4))],
                [zero((8, 6)), zero((8, 4)), -NOISE, Z.T, zero((8, 4))],
                [X, PY, Z, -P, zero((6, 4))],
                [UM, zero((4, 4)), zero((4, 8)), zero((4, 6)), b * np.eye(4) - U - U.T],
            ]
        )
        constraints.append(matrix << -MARGIN * np.eye(28))
    problem = cp.Problem(cp.Maximize(cp.trace(P)), constraints)
    problem.solve(solver=solver)
    seconds = time.perf_counter() - start
    return {"seconds": seconds, "objective": float(problem.value), "proof": "none"}


ROWS: dict[str, Callable[[], dict[str, Any]]] = {
    "naive cvxpy + Clarabel": lambda: naive("CLARABEL"),
    "naive cvxpy + SDPA": lambda: naive("SDPA"),
    "thin layer, whole": whole,
    "thin layer, exact split": split,
    "thin layer, row relaxation": rows,
}
