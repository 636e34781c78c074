"""Gains P and L of the observer: linear programme, Sylvester equation, pole placement."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from obsynth.derive.errors import StructureError
from obsynth.designs.core.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.interval.decoupling import Reduced
from obsynth.designs.lmi import Problem, diagonal, full
from obsynth.symbolic import ObsynthError, Plant
from obsynth.symbolic.arrays import FloatArray

MODE = 1e-9
MOST_SKEW = 1e7
UNBOUNDED = 1e6


def check_detectable(plant: Plant, data: Reduced) -> None:
    """Refuse a pair (A2, C2) with a mode that does not decay and is not seen, Assumption 4."""
    names = plant.names("x")
    for number, A in enumerate(data.A):
        for mode in np.linalg.eigvals(A):
            if abs(mode) < 1.0 - MODE:
                continue
            pencil = np.vstack([mode * np.eye(len(A)) - A, data.C2.astype(complex)])
            size = np.linalg.norm(pencil, axis=0)
            size = np.where(size > 0.0, size, 1.0)
            _, values, vectors = np.linalg.svd(pencil / size)
            if values[-1] > MODE:
                continue
            motion = np.abs(data.W @ (vectors[-1].conj() / size))
            moving = tuple(
                name for name, v in zip(names, motion, strict=True) if v > 1e-6 * motion.max()
            )
            text = f"{mode.real:.6g}" if abs(mode.imag) < 1e-12 else f"{mode:.6g}"
            raise StructureError(
                f"the pair (A2, C2) is not detectable: once the faults are removed, a motion of "
                f"{', '.join(moving)} with the mode {text}, which does not decay, leaves the "
                f"outputs {', '.join(plant.output_names)} unchanged (vertex {number + 1}). "
                f"Measure {moving[0]} as well",
                condition="detectability",
                symbols=moving,
                states=moving,
                mode=complex(mode),
                vertex_index=number,
            )


def lp_problem(data: Reduced, P: FloatArray) -> Problem:
    """Return the programme whose solution L makes the bounds for a fixed P narrow.

    With Lambda = diag(lambda), Y = Lambda P L and S = P^-1: T >= |Lambda P A_i S - Y C2 S| and
    U >= |Lambda P W1 - (Lambda P D_i + Y N12) W2| at every vertex, lambda >= 0 and
    1'T <= lambda' - 1'|S|; minimise 1'U (w_upper - w_lower) + 1'|Lambda P (D_i - D_j)| |y|, an
    upper bound of the sum of the steady widths of z2.
    """
    n2, m2 = len(P), len(data.C2)
    if not n2:
        raise ObsynthError("every state is measured once the faults are known: there is no gain")
    S = np.linalg.inv(P)
    Lambda, T = diagonal("lambda", n2), full("T", n2, n2)
    U = full("U", n2, len(data.w_width)) if data.w_width.size else None
    Y = full("Y", n2, m2) if m2 else None
    moved = Lambda @ (P @ data.A @ S)
    driven = Lambda @ (P @ data.W1 - P @ data.D @ data.W2)
    if Y is not None:
        moved = moved - Y @ (data.C2 @ S)
        driven = driven - Y @ (data.N12 @ data.W2)
    problem = Problem("gain of the interval observer")
    problem.add("T above", T - moved >= 0)
    problem.add("T below", T + moved >= 0)
    ones = np.ones((1, n2))
    problem.add("decay", ones @ Lambda - ones @ T - ones @ np.abs(S) >= 0)
    objective = 0.0 * (ones @ T @ ones.T)
    if U is not None:
        problem.add("U above", U - driven >= 0)
        problem.add("U below", U + driven >= 0)
        objective = objective + ones @ U @ data.w_width[:, None]
    varies = (P @ data.D).max(axis=0) - (P @ data.D).min(axis=0)
    if varies.any():
        objective = objective + ones @ Lambda @ (varies @ data.y_size[:, None])
    problem.minimise(objective)
    return problem


def lp_gain(data: Reduced, P: FloatArray) -> FloatArray:
    """Solve `lp_problem` and return L."""
    if not len(data.C2) or not len(P):
        return np.zeros((len(P), len(data.C2)))
    try:
        solution = lp_problem(data, P).solve(tol_gap_abs=1e-11, tol_gap_rel=1e-11, tol_feas=1e-11)
    except SolverTrouble:
        solution = lp_problem(data, P).solve()
    if "Y" not in solution.values:
        # neither C2 nor the noise of the remaining outputs: nothing to be gained from them
        return np.zeros((len(P), len(data.C2)))
    Y, weights = solution["Y"], np.diag(solution["lambda"])
    return np.asarray(np.linalg.solve(P, Y / weights[:, None]), dtype=float)


def sylvester_gain(
    A2: FloatArray, C2: FloatArray, R: FloatArray, Q: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Solve P A2 - R P = Q C2 and return P and L = P^-1 Q, so that P (A2 - L C2) P^-1 = R."""
    from scipy.linalg import solve_sylvester

    n2, m2 = len(A2), len(C2)
    if R.shape != (n2, n2) or Q.shape != (n2, m2):
        raise ObsynthError(
            f"R has shape {R.shape} and Q {Q.shape}; this plant needs {(n2, n2)} and {(n2, m2)}",
            option="R",
        )
    gap = np.abs(np.linalg.eigvals(R)[:, None] - np.linalg.eigvals(A2)[None, :])
    if gap.min(initial=np.inf) < MODE:
        raise InfeasibleDesign(
            "R and A2 have an eigenvalue in common, so P A2 - R P = Q C2 has no unique solution",
            ["choose other eigenvalues for R"],
        )
    P = np.asarray(solve_sylvester(-R, A2, Q @ C2), dtype=float)
    if np.linalg.cond(P) > 1e10:
        raise InfeasibleDesign(
            "P A2 - R P = Q C2 has no regular solution",
            ["(R, Q) has to be controllable and (A2, C2) observable"],
        )
    return P, np.linalg.solve(P, Q)


def placed_gains(data: Reduced) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield (P, L) that make P (A2 - L C2) P^-1 diagonal with several sets of real poles.

    A2 is the mean of the vertices; sets of poles for which the Sylvester equation has no regular
    solution are left out.
    """
    A2, C2 = data.A.mean(axis=0), data.C2
    n2, m2 = len(A2), len(C2)
    if not n2 or not m2:
        return
    steps = np.arange(n2) - 0.5 * (n2 - 1)
    Q = np.ones((n2, m2)) + np.eye(n2)[:, np.arange(m2) % n2]
    for middle in (0.01, 0.15, 0.3, 0.5, 0.7):
        for apart in (0.05, 0.2):
            poles = middle + apart * steps
            if np.abs(poles).max() < 1.0:
                try:
                    yield sylvester_gain(A2, C2, np.diag(poles), Q)
                except InfeasibleDesign:
                    continue


def predicted_size(data: Reduced, P: FloatArray, L: FloatArray) -> float:
    """Return the sum of the steady widths of x of the vertex form without contraction.

    In doubles, for a search; at least 1e6 where the widths are unbounded.
    """
    if np.linalg.cond(P) > MOST_SKEW:
        return 2.0 * UNBOUNDED
    S = np.linalg.inv(P)
    M = np.abs(P @ (data.A - L @ data.C2) @ S).max(axis=0)
    radius = float(np.abs(np.linalg.eigvals(M)).max())
    if radius >= 0.999:
        return UNBOUNDED * (1.0 + radius)
    driven = P @ (data.W1 - (data.D + L @ data.N12) @ data.W2)
    rest = np.abs(driven).max(axis=0) @ data.w_width
    rest = rest + np.abs(P @ data.changes).sum(axis=0) @ data.signals
    widths = np.linalg.solve(np.eye(len(P)) - M, rest)
    return float((np.abs(data.W @ S) @ widths).sum())


def refined(
    data: Reduced, P: FloatArray, L: FloatArray, evaluations: int = 3000
) -> tuple[FloatArray, FloatArray]:
    """Improve P and L together by a direct search on `predicted_size`."""
    from scipy.optimize import minimize

    n2 = len(P)

    def read(point: FloatArray) -> tuple[FloatArray, FloatArray]:
        return point[: n2 * n2].reshape(n2, n2), point[n2 * n2 :].reshape(n2, -1)

    rows = P / np.abs(P).max(axis=1, keepdims=True)
    found = minimize(
        lambda point: predicted_size(data, *read(point)),
        np.concatenate([rows.ravel(), L.ravel()]),
        method="Nelder-Mead",
        options={"maxfev": evaluations, "xatol": 1e-7, "fatol": 1e-9, "adaptive": True},
    )
    better, gain = read(np.asarray(found.x, dtype=float))
    return better / np.abs(better).max(axis=1, keepdims=True), gain
