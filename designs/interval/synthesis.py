"""From numbers to gains P and L whose bounds are proved to stay bounded.

By a linear programme, the Sylvester equation, pole placement, or a direct search.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive.rigour import exact, nearest
from obsynth.designs.core.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.interval.decoupling import MODE, Reduced, shaped
from obsynth.designs.interval.printed import divergence
from obsynth.designs.interval.record import IntervalDesign
from obsynth.designs.interval.widths import steady, steady_holds
from obsynth.designs.lmi.expression import diagonal, full
from obsynth.designs.lmi.problem import Problem
from obsynth.symbolic import ObsynthError
from obsynth.symbolic.arrays import FloatArray

STARTS = 3
MOST_SKEW = 1e7
UNBOUNDED = 1e6


def lp_problem(data: Reduced, P: FloatArray) -> Problem:
    """Return the programme (the method's page, Gains) of the L that makes bounds for P narrow."""
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
    """Yield (P, L) that make P (A2 - L C2) P^-1 diagonal with real poles, A2 the mean."""
    A2, C2 = data.A.mean(axis=0), data.C2
    n2, m2 = len(A2), len(C2)
    if not n2 or not m2:
        return
    steps = np.arange(n2) - 0.5 * (n2 - 1)
    Q = np.ones((n2, m2)) + np.eye(n2)[:, np.arange(m2) % n2]
    for middle, apart in product((0.01, 0.15, 0.3, 0.5, 0.7), (0.05, 0.2)):
        poles = middle + apart * steps
        if np.abs(poles).max() < 1.0:
            with suppress(InfeasibleDesign):
                yield sylvester_gain(A2, C2, np.diag(poles), Q)


def predicted_size(data: Reduced, P: FloatArray, L: FloatArray) -> float:
    """Return the sum of steady widths of x, vertex form, in doubles; 1e6 or more if unbounded."""
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


def with_gains(design: IntervalDesign, P: FloatArray, L: FloatArray) -> IntervalDesign:
    """Return the design with other gains, its steady widths not yet known."""
    return replace(design, P=P, L=L, error=np.zeros(0), width=np.zeros(0))


def complete(design: IntervalDesign) -> IntervalDesign | None:
    """Find the steady widths; None if the bounds diverge or the paper's R is not nonnegative."""
    if design.bound == "paper" and not design.nonnegative:
        return None
    found = steady(design.width_map)
    if found is None or not steady_holds(design.width_map, *found)[0]:
        return None
    return replace(design, error=found[0], width=found[1])


def fitting_gains(
    design: IntervalDesign, P: ArrayLike, L: ArrayLike | None
) -> tuple[FloatArray, FloatArray]:
    """Check given gains; for L = None the linear programme chooses it."""
    m2, n2 = design.decoupled.C2.shape
    P = shaped(P, (n2, n2), "P", option="gains")
    if n2 and np.linalg.matrix_rank(P) < n2:
        raise ObsynthError(f"P has to be regular with shape {(n2, n2)}", option="gains")
    if L is None:
        return P, lp_gain(design.reduced, P)
    return P, shaped(L, (n2, m2), "L", option="gains")


def given_gains(design: IntervalDesign, P: ArrayLike, L: ArrayLike | None) -> IntervalDesign:
    """Complete a design with given P and L."""
    chosen = with_gains(design, *fitting_gains(design, P, L))
    done = complete(chosen)
    if done is None:
        raise divergence(chosen)
    return done


def lp_design(design: IntervalDesign) -> IntervalDesign:
    """Gains by the linear programme for P = I; where that has no solution, by `search_design`."""
    data = design.reduced
    identity = np.eye(data.A.shape[1])
    first = _try(design, identity, _programme(data, identity))
    return search_design(design) if first is None else first


def search_design(design: IntervalDesign) -> IntervalDesign:
    """Gains by a direct search on P and L, from the programme's and from placed poles."""
    data = design.reduced
    identity = np.eye(data.A.shape[1])
    starts = list(placed_gains(data))
    programme = _programme(data, identity)
    if programme is not None:
        starts.append((identity, programme))
    if len(identity):  # else the faults take every state, and there is nothing to search
        starts.sort(key=lambda gains: predicted_size(data, *gains))
    tried = [*starts, *((identity, L) for _, L in starts)]
    if len(identity):
        tried += [refined(data, *gains) for gains in starts[:STARTS]]
    done = [d for d in (_try(design, P, L) for P, L in tried) if d is not None]
    if not done:
        gains = tried[0] if tried else (identity, np.zeros((len(identity), len(data.C2))))
        raise divergence(with_gains(design, *gains), "no P was found whose bounds stay bounded")
    return min(done, key=lambda d: float(d.half_widths.sum()))


def _programme(data: Reduced, P: FloatArray) -> FloatArray | None:
    try:
        return lp_gain(data, P)
    except InfeasibleDesign:
        return None


def _try(design: IntervalDesign, P: FloatArray, L: FloatArray | None) -> IntervalDesign | None:
    return None if L is None else complete(with_gains(design, P, L))


def sylvester_design(
    design: IntervalDesign, R: ArrayLike | None, Q: ArrayLike | None
) -> IntervalDesign:
    """Gains by P A2 - R P = Q C2, R nonnegative: given, or the best of several diagonal ones."""
    data = design.reduced
    A2 = nearest(design.decoupled.T2 @ exact(design.nominal) @ design.decoupled.W)
    n2, m2 = len(A2), len(data.C2)
    if R is not None:
        Q = np.ones((n2, m2)) if Q is None else np.array(Q)
        return given_gains(design, *sylvester_gain(A2, data.C2, np.array(R), Q))
    tried = []
    for start in (0.0, 0.1, 0.2, 0.3, 0.5):
        poles = start + 0.1 * np.arange(n2) / max(n2 - 1, 1)
        with suppress(InfeasibleDesign):
            gains = sylvester_gain(A2, data.C2, np.diag(poles), np.ones((n2, m2)))
            tried.append(with_gains(design, *gains))
    done = [found for found in map(complete, tried) if found is not None]
    if done:
        return min(done, key=lambda d: float(d.half_widths.sum()))
    if not tried:
        raise InfeasibleDesign(
            "P A2 - R P = Q C2 has no regular solution for the R that were tried",
            ['give R= and Q=, or use gains="lp"'],
        )
    raise divergence(tried[-1], "the bounds diverge for every R that was tried")
