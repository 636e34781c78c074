"""The QPV observer's H2 design over boxes: 64 x 64 pairs of vertices, 4 of the scheduling.

Data of the example of Rotondo, Buciakowski and Witczak (QPV observer for process faults),
eta = .2, alpha = .1, performance output e6, half widths kappa sqrt(Q_ii).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from itertools import product
from typing import Any

import numpy as np

from obsynth.derive.rigour import Enclosure, ExactMatrix
from obsynth.designs.lmi.expression import full, scalar, symmetric
from obsynth.designs.lmi.margin import solve_with_margin
from obsynth.designs.lmi.problem import Problem, he, symmetric_block
from obsynth.designs.lmi.proof import prove_family
from obsynth.designs.lmi.reductions import split_common
from obsynth.designs.qpv.error_matrix import extreme_points

__all__ = ["ROWS"]

ETA, ALPHA = 0.2, 0.1
CENTRE = np.array([10.0, 10.0, 10.0, 0.0, 0.0, 0.0])
Q = np.array([0.2, 0.2, 0.2, 0.1, 0.1, 0.1])
CBAR, CZ = np.eye(3, 6), np.eye(6)[[5]]
G = np.vstack([np.diag([0.25, 0.15, 0.25]), np.zeros((3, 3))])
H = np.diag([0.025, 0.015, 0.025])


def _scheduled(t1: float, t2: float) -> Any:
    top = [[-4 - t1, 10, 2 + 2 * t2], [-1, -1 - t2, 1.5 + 2 * t1], [1, 1, -4 - 3 * t1]]
    return np.block([[np.array(top), np.zeros((3, 3))], [np.zeros((3, 6))]])


ABAR = [_scheduled(t1, t2) for t1, t2 in product((0.0, 1.0), repeat=2)]


def _box(kappa: float) -> tuple[Any, Any]:
    half = kappa * np.sqrt(Q)
    return np.array(list(product((-1.0, 1.0), repeat=6))) * half, half


def _pairs(offsets: Any) -> Any:
    """x_j - x_i and f_j, all that enters of a pair of vertices."""
    i, j = np.divmod(np.arange(64 * 64), 64)
    return np.hstack([offsets[j, :3] - offsets[i, :3], offsets[j, 3:]])


def _psi(pairs: Any) -> Any:
    family = np.zeros((len(pairs), 6, 6))
    for k in range(3):
        family[:, k, 3 + k] = ETA * CENTRE[k] + pairs[:, k]
        family[:, k, k] = pairs[:, 3 + k]
    return family


def drift(P: Any, Gain: Any, A: Any, psi: Any, C: Any) -> Any:
    """He{eta (P A - Gamma C) + P Psi}."""
    return he(ETA * (P @ A - Gain @ C) + P @ psi)


def h2_block(P: Any, Gain: Any, drifted: Any, root: Any, lift: Any, noise: Any) -> Any:
    """(54) times -1; ``root`` is the square root of eta, ``noise`` the matrices G and H."""
    side = root * (P @ noise[0] - Gain @ noise[1])
    return symmetric_block([[-drifted], [-side.T, lift(np.eye(3))]])


def reduced(kappa: float) -> dict[str, Any]:
    """Extreme pairs, common part split off, few vertices, back-off, proof at all pairs kept."""
    start = time.perf_counter()
    offsets, half = _box(kappa)
    kept = extreme_points(_pairs(offsets))
    psi = _psi(_pairs(offsets)[kept])
    # The error is measured in half widths of the box.
    D, back = np.diag(half), np.diag(1.0 / half)
    P, mu = symmetric("P", 6), scalar("mu")
    problem = Problem("QPV box")
    for k, A in enumerate(ABAR):
        gain = full(f"Gamma{k}", 6, 3)
        drifted = drift(P, gain, back @ A @ D, back @ psi @ D, CBAR @ D)
        problem.add_lmi(f"decay {k}", -drifted - ETA * ALPHA * P, ">>")
        block = h2_block(P, gain, drifted, ETA**0.5, lambda m: m, (back @ G, H))
        parts = split_common(block, f"Z{k}")
        problem.add_lmi(f"h2 {k}, common", parts.common, ">>")
        problem.add_lmi(f"h2 {k}, members", parts.members, ">>")
    _add_region(problem, P, D, mu)
    problem.minimise(mu)
    found = solve_with_margin(problem, prove=lambda v: _prove(v, psi, half), fraction=1e-5)
    seconds = time.perf_counter() - start
    return {"seconds": seconds, "objective": found.objective, "proof": str(found.proof)}


def _add_region(problem: Problem, P: Any, D: Any, mu: Any) -> None:
    corners = np.array([(1.0, *s) for s in product((-1.0, 1.0), repeat=5)])[:, :, None]
    transposed = np.swapaxes(corners, 1, 2)
    problem.add_lmi("box inside", np.ones((1, 1)) - transposed @ P @ corners, ">>")
    faces = ETA * np.eye(6)[:, None, :]
    problem.add_lmi("ellipsoid inside", symmetric_block([[P], [faces, np.ones((1, 1))]]), ">>")
    problem.add_lmi("trace", symmetric_block([[P], [CZ @ D, mu]]), ">>")


def _prove(values: Mapping[str, Any], psi: Any, half: Any) -> Any:
    """Every inequality for the stored P, L_l and mu, in the coordinates of the plant."""
    back = np.diag(1.0 / half)
    P = back @ values["P"] @ back
    P = 0.5 * (P + P.T)
    gains = [np.diag(half) @ np.linalg.solve(values["P"], values[f"Gamma{k}"]) for k in range(4)]
    count = len(psi)
    corners = np.array([(1.0, *s) for s in product((-1.0, 1.0), repeat=5)]) * half
    # A double slightly above sqrt(eta) makes (54) harder, never easier.
    root = np.nextafter(ETA**0.5, 1.0)

    def at(k: int, vertex: Any, lift: Any) -> Any:
        Pl = lift(P)
        gain = Pl @ lift(gains[k])
        drifted = drift(Pl, gain, lift(ABAR[k]), lift(psi[vertex]), lift(CBAR))
        decay = -drifted - ETA * lift(ALPHA) * Pl
        noise = (lift(G), lift(H))
        return symmetric_block([[decay], [0, h2_block(Pl, gain, drifted, lift(root), lift, noise)]])

    proofs = [
        prove_family(
            "QPV box",
            count,
            lambda vertex, k=k: at(k, vertex, Enclosure.of),
            lambda vertex, k=k: at(k, vertex, ExactMatrix.of),
        )
        for k in range(4)
    ]
    Pe = Enclosure.of(P)
    inside = Enclosure.of(corners[:, None, :])
    region = [
        prove_family("box", 32, lambda v: ONE - inside.member(v) @ Pe @ inside.member(v).T),
        prove_family("faces", 6, lambda v: _face(Pe, v, half)),
        prove_family("trace", 1, lambda _: _trace_block(Pe, values["mu"])),
    ]
    return next((p for p in (*proofs, *region) if not p.all_proved), proofs[0])


ONE = Enclosure.of(1.0)


def _trace_block(P: Enclosure, mu: Any) -> Any:
    return symmetric_block([[P], [Enclosure.of(CZ[None]), Enclosure.of(mu)]])


def _face(P: Enclosure, which: Any, half: Any) -> Any:
    normals = Enclosure.of(np.eye(6)[which][:, None, :]) / Enclosure.of(half[which][:, None, None])
    return symmetric_block([[P], [ETA * normals, np.ones((1, 1))]])


def naive(kappa: float, pairs: int = 64) -> dict[str, Any]:
    """cvxpy, one constraint per pair and vertex of the scheduling; the first pairs only."""
    import cvxpy as cp

    start = time.perf_counter()
    offsets, half = _box(kappa)
    P, mu = cp.Variable((6, 6), symmetric=True), cp.Variable((1, 1))
    gains = [cp.Variable((6, 3)) for _ in ABAR]
    constraints = [cp.bmat([[mu, CZ], [CZ.T, P]]) >> 0]
    constraints += [cp.sum(cp.multiply(P, np.outer(x, x))) <= 1 for x in offsets]
    for k in range(6):
        a = ETA * np.eye(6)[:, [k]] / half[k]
        constraints.append(cp.bmat([[P, a], [a.T, np.ones((1, 1))]]) >> 0)
    psi = _psi(_pairs(offsets)[:pairs])
    for A, gain in zip(ABAR, gains, strict=True):
        side = ETA**0.5 * (P @ G - gain @ H)
        for M in psi:
            X = ETA * (P @ A - gain @ CBAR) + P @ M
            drifted = X + X.T
            constraints.append(ETA * ALPHA * P + drifted << 0)
            constraints.append(cp.bmat([[drifted, side], [side.T, -np.eye(3)]]) << 0)
    problem = cp.Problem(cp.Minimize(mu[0, 0]), constraints)
    problem.solve(solver="CLARABEL")
    seconds = time.perf_counter() - start
    return {
        "seconds": seconds * 64 * 64 / pairs,
        "objective": float(problem.value),
        "proof": f"none; {pairs} of 4096 pairs in {seconds:.1f} s, extrapolated",
    }


TIGHT, INSCRIBED = 0.2, 6.0**-0.5

ROWS: dict[str, Callable[[], dict[str, Any]]] = {
    "naive cvxpy + Clarabel, box_tight": lambda: naive(TIGHT),
    "thin layer, reduced and lazy, box_tight": lambda: reduced(TIGHT),
    "naive cvxpy + Clarabel, box_insc": lambda: naive(INSCRIBED),
    "thin layer, reduced and lazy, box_insc": lambda: reduced(INSCRIBED),
}
