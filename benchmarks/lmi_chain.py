"""A chain of ten tanks with k independent uncertain entries: 2^k vertices, none redundant.

n = 10 states, two faults, nine outputs; A is bidiagonal and stable, and k of the 19 entries
(j, j), (j, j + 1) of the Jacobian have a box of their own. Quadratic boundedness of the
augmented error (gamma = .005, noise and fault increments scaled to one) in blocks of 35 x 35,
min trace(P^-1).
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from itertools import product
from typing import Any

import numpy as np
from lmi_relaxation import (
    RowMultipliers,
    UncertainRow,
    corner_block,
    row_multipliers,
)

from obsynth.derive.rigour import Enclosure, prove_positive_definite
from obsynth.designs.lmi.expression import full, symmetric
from obsynth.designs.lmi.margin import solve_with_margin
from obsynth.designs.lmi.problem import Problem, symmetric_block
from obsynth.designs.lmi.proof import prove_family
from obsynth.designs.lmi.reductions import split_common

__all__ = ["WAYS", "run"]

N, FAULTS, OUTPUTS = 10, 2, 9
SIZE = N + FAULTS
KEEP, HALF_WIDTH = 0.995, 0.004
# Without a cap the infimum is not attained: P grows in directions that cost nothing.
CAP = 1e3 * np.eye(SIZE)
PLACES = sorted([(j, j) for j in range(N)] + [(j, j + 1) for j in range(N - 1)])[:18]


def _augmented() -> Any:
    A = np.diag(np.linspace(0.98, 0.90, N)) + np.diag(np.full(N - 1, 0.03), 1)
    B = np.zeros((N, FAULTS))
    B[4, 0] = B[9, 1] = 0.06
    return np.block([[A, B], [np.zeros((FAULTS, N)), np.eye(FAULTS)]])


ABAR = _augmented()
CBAR = np.hstack([np.eye(OUTPUTS, N), np.zeros((OUTPUTS, FAULTS))])
WBAR = np.zeros((SIZE, OUTPUTS + FAULTS))
WBAR[N:, OUTPUTS:] = 0.05 * np.eye(FAULTS)
VBAR = np.hstack([0.1 * np.eye(OUTPUTS), np.zeros((OUTPUTS, FAULTS))])
NOISE = np.diag([0.5 / OUTPUTS] * OUTPUTS + [0.5 / FAULTS] * FAULTS)


def _signs(vertices: Any, k: int) -> Any:
    return 2.0 * ((np.asarray(vertices)[:, None] >> np.arange(k)) & 1) - 1.0


def _directions(k: int) -> Any:
    steps = np.zeros((k, SIZE, SIZE))
    for number, (i, j) in enumerate(PLACES[:k]):
        steps[number, i, j] = HALF_WIDTH
    return steps


def _vertices(k: int) -> Any:
    return ABAR + np.einsum("vk,kij->vij", _signs(np.arange(2**k), k), _directions(k))


def _block(P: Any, H: Any, A: Any) -> Any:
    return symmetric_block([[KEEP * P], [0, NOISE], [P @ A - H @ CBAR, P @ WBAR - H @ VBAR, P]])


def _unknowns() -> tuple[Any, Any]:
    return symmetric("P", SIZE), full("H", SIZE, OUTPUTS)


def _prove_all(values: Mapping[str, Any], k: int) -> Any:
    """Every vertex for the stored P, K and a slack Z between noise and dynamics."""
    P = Enclosure.of(values["P"])
    gain = np.linalg.solve(values["P"], values["H"])
    H = P @ Enclosure.of(gain)
    Z = Enclosure.of(_slack(values["P"], gain))
    centre = P @ Enclosure.of(ABAR) - H @ Enclosure.of(CBAR)
    steps = P @ Enclosure.of(_directions(k))

    def members(vertices: Any) -> Any:
        X = Enclosure.combine(centre, steps, _signs(vertices, k))
        return symmetric_block([[KEEP * P], [X, P - Z]])

    noise = symmetric_block([[NOISE], [P @ Enclosure.of(WBAR) - H @ Enclosure.of(VBAR), Z]])
    if not prove_positive_definite(noise).all_proved:
        return prove_family("noise", 1, lambda _: noise.member(0))
    return prove_family(f"2^{k} vertices", 2**k, members)


def _slack(P: Any, gain: Any) -> Any:
    """Hardly more than the Schur complement of the noise."""
    side = P @ (WBAR - gain @ VBAR)
    Z = side @ np.linalg.solve(NOISE, side.T)
    Z = 0.5 * (Z + Z.T)
    return Z + 1e-9 * np.trace(Z) * np.eye(SIZE)


def _finish(found: Any, start: float) -> dict[str, Any]:
    seconds = time.perf_counter() - start
    return {"seconds": seconds, "objective": found.objective, "proof": str(found.proof)}


def whole(k: int) -> dict[str, Any]:
    """Every vertex as one block of 35 x 35, no modelling language in between."""
    start = time.perf_counter()
    P, H = _unknowns()
    problem = Problem("chain, whole")
    problem.add_lmi("members", _block(P, H, _vertices(k)), ">>")
    problem.add("cap", P << CAP)
    problem.minimise_trace_inverse(P)
    return _finish(solve_with_margin(problem, prove=lambda v: _prove_all(v, k)), start)


def split(k: int) -> dict[str, Any]:
    """Split the common part off (exact), add vertices when they are violated."""
    start = time.perf_counter()
    P, H = _unknowns()
    parts = split_common(_block(P, H, _vertices(k)), "Z")
    problem = Problem("chain, split")
    problem.add_lmi("common", parts.common, ">>")
    problem.add_lmi("members", parts.members, ">>")
    problem.add("cap", P << CAP)
    problem.minimise_trace_inverse(P)
    return _finish(solve_with_margin(problem, prove=lambda v: _prove_all(v, k)), start)


def _uncertain_rows(k: int) -> list[UncertainRow]:
    found = []
    for row in sorted({i for i, _ in PLACES[:k]}):
        columns = tuple(j for i, j in PLACES[:k] if i == row)
        ends = product((-HALF_WIDTH, HALF_WIDTH), repeat=len(columns))
        found.append(UncertainRow(row, columns, np.array(list(ends))))
    return found


def rows(k: int) -> dict[str, Any]:
    """Multipliers for every row of M: at most four corners per row imply all vertices."""
    start = time.perf_counter()
    P, H = _unknowns()
    Z = symmetric("Z", SIZE)
    problem = Problem("chain, rows")
    m = row_multipliers(problem, "row", _uncertain_rows(k), (SIZE, SIZE))
    problem.add_lmi("noise", symmetric_block([[NOISE], [P @ WBAR - H @ VBAR, Z]]), ">>")
    X = P @ ABAR - H @ CBAR
    problem.add_lmi("main", _main(P, X, Z, m), ">>")
    problem.add("cap", P << CAP)
    problem.minimise_trace_inverse(P)

    def prove(values: Mapping[str, Any]) -> Any:
        implied = _prove_rows(values, k)
        return implied if not implied.all_proved else _prove_all(values, k)

    return _finish(solve_with_margin(problem, prove=prove), start)


def _main(P: Any, X: Any, Z: Any, m: RowMultipliers) -> Any:
    return symmetric_block([[KEEP * P - m.Q], [-m.S.T, m.R], [X, P @ m.rows, P - Z]])


def _prove_rows(values: Mapping[str, Any], k: int) -> Any:
    """Prove the relaxation itself for the stored numbers: it implies every vertex."""
    enclosed = {name: Enclosure.of(value) for name, value in values.items()}
    P = enclosed["P"]
    H = P @ Enclosure.of(np.linalg.solve(values["P"], values["H"]))
    uncertain = _uncertain_rows(k)
    m = RowMultipliers.assemble(uncertain, enclosed, "row", (SIZE, SIZE), Enclosure.of)
    X = P @ Enclosure.of(ABAR) - H @ Enclosure.of(CBAR)
    noise = P @ Enclosure.of(WBAR) - H @ Enclosure.of(VBAR)
    blocks = [symmetric_block([[NOISE], [noise, enclosed["Z"]]]), _main(P, X, enclosed["Z"], m)]
    for item in uncertain:
        parts = [enclosed[f"row.{part}{item.row}"] for part in "QSR"]
        blocks.append(corner_block(*parts, Enclosure.of(item.vertices)))
    results = [prove_positive_definite(matrix) for matrix in blocks]
    worst = min(range(len(blocks)), key=lambda i: results[i].relative.min())
    return results[worst]


def naive(k: int) -> dict[str, Any]:
    """Use cvxpy with one bmat per vertex, Clarabel."""
    import cvxpy as cp

    start = time.perf_counter()
    P, H = cp.Variable((SIZE, SIZE), symmetric=True), cp.Variable((SIZE, OUTPUTS))
    Z = cp.Variable((SIZE, SIZE), symmetric=True)
    eye, zero = np.eye(SIZE), np.zeros((OUTPUTS + FAULTS, SIZE))
    constraints = [cp.bmat([[Z, eye], [eye, P]]) >> 0, P << CAP]
    for A in _vertices(k):
        X, W = P @ A - H @ CBAR, P @ WBAR - H @ VBAR
        matrix = cp.bmat([[KEEP * P, zero.T, X.T], [zero, NOISE, W.T], [X, W, P]])
        constraints.append(matrix >> 0)
    problem = cp.Problem(cp.Minimize(cp.trace(Z)), constraints)
    problem.solve(solver="CLARABEL")
    seconds = time.perf_counter() - start
    return {"seconds": seconds, "objective": float(problem.value), "proof": "none"}


WAYS = {
    "naive cvxpy + Clarabel": naive,
    "thin layer, whole": whole,
    "thin layer, split and lazy": split,
    "thin layer, row multipliers": rows,
}


def run(way: str, k: int) -> dict[str, Any]:
    """Solve the chain with k uncertain entries one way; see the functions above."""
    return WAYS[way](k)
