"""Gains and ellipsoids by linear matrix inequalities: solved here, proved elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from obsynth.designs.bounded_error.error_system import ErrorSystem
from obsynth.designs.bounded_error.lmis import direct_block, fixed_gain_block
from obsynth.designs.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.lmi import (
    Affine,
    Problem,
    Solution,
    diagonal,
    full,
    scalar,
    symmetric,
    symmetric_block,
    trace,
)

__all__ = [
    "OBJECTIVES",
    "EllipsoidSolution",
    "Objective",
    "analyse_gain",
    "decay_room",
    "design_problem",
    "largest_feasible",
    "largest_gamma",
    "largest_margin",
    "search_gamma",
    "set_objective",
    "solve_reliably",
    "synthesise",
]

FloatArray = NDArray[np.float64]
Objective = Literal["trace_inverse", "log_det", "lambda_min", "trace"]
OBJECTIVES: tuple[Objective, ...] = ("trace_inverse", "log_det", "lambda_min", "trace")

# Room between the solver's answer and the boundary, relative to blocks scaled to about one:
# large against the solver's tolerance, small against the digits anybody reads.
MARGIN = 1e-7


@dataclass(frozen=True, eq=False)
class EllipsoidSolution:
    """A solution of the design or analysis LMI.

    Attributes
    ----------
    gain : ndarray of shape (p, m)
    P : ndarray of shape (p, p)
    gamma : float
    weights : ndarray of shape (n_v,)
        Diagonal of Q_v for v scaled by its boxes.
    """

    gain: FloatArray
    P: FloatArray
    gamma: float
    weights: FloatArray

    @property
    def inverse_diagonal(self) -> FloatArray:
        """``(P^-1)_ii``: squares of the steady half widths of xi."""
        return np.diag(np.linalg.inv(self.P)).copy()


def _scaled(system: ErrorSystem, scale: FloatArray) -> ErrorSystem:
    """Rewrite the system for ``xi = diag(scale) xi_scaled``."""
    return replace(
        system,
        Abar=system.Abar * scale / scale[:, None],
        Cbar=system.Cbar * scale,
        Wbar=system.Wbar / scale[:, None],
    )


def _noise(weights: FloatArray | None, n_v: int, problem: Problem) -> Any:
    """Q_v in scaled coordinates: given, or a variable with trace at most 1."""
    if weights is not None:
        return np.diag(weights)
    noise = diagonal("Q_v", n_v)
    # Stay a little below 1, so that rounding the solution cannot leave the simplex.
    problem.add("Q_v.sum", trace(noise) <= 1.0 - 1e-9)
    return noise


def set_objective(
    problem: Problem, P: Any, objective: Objective, weights: FloatArray, scale: FloatArray
) -> None:
    """Set one of the size criteria of section 5 (and the two that serve it better).

    Parameters
    ----------
    problem : Problem
    P : Affine
        In coordinates scaled by `scale`.
    objective : {"trace_inverse", "log_det", "lambda_min", "trace"}
    weights, scale : ndarray of shape (p,)
    """
    back = np.diag(1.0 / scale)
    if objective == "trace_inverse":
        chosen = weights > 0
        problem.minimise_trace_inverse(P, np.diag(np.sqrt(weights) * scale)[:, chosen])
    elif objective == "log_det":
        problem.maximise_log_det(P)
    elif objective == "lambda_min":
        problem.maximise_lambda_min(back @ P @ back)
    else:
        problem.maximise(trace(back @ P @ back))


def design_problem(
    system: ErrorSystem,
    gamma: float,
    noise: FloatArray | None,
    objective: Objective,
    weights: FloatArray,
    scale: FloatArray | None = None,
    gain: FloatArray | None = None,
) -> Problem:
    """State the design LMI (or, with `gain`, the analysis LMI) at a fixed gamma.

    Parameters
    ----------
    system : ErrorSystem
        Of arrays.
    gamma : float
    noise : ndarray of shape (n_v,) or None
        Weights of Q_v; None makes them variables.
    objective : {"trace_inverse", "log_det", "lambda_min", "trace"}
    weights : ndarray of shape (p,)
        Of ``trace_inverse``.
    scale : ndarray of shape (p,), optional
        Typical sizes of the components of xi.
    gain : ndarray of shape (p, m), optional

    Returns
    -------
    Problem
        With variables ``P`` and ``H`` for ``gamma * S P S`` and ``gamma * S H``, where
        ``S = diag(1 / scale)``.
    """
    p, m, n_v = system.sizes
    scale = np.ones(p) if scale is None else scale
    scaled = _scaled(system, scale)
    kind = "design" if gain is None else "analysis"
    problem = Problem(f"bounded-error {kind} at gamma = {gamma:.6g}")
    P = symmetric("P", p)
    Q = _noise(noise, n_v, problem)
    if gain is None:
        block = direct_block(scaled, P, full("H", p, m), 1.0 - gamma, Q)
    else:
        X, Z = scaled.closed_loop(gain / scale[:, None])
        block = fixed_gain_block(X, Z, P, 1.0 - gamma, Q)
    problem.add_lmi("invariance", block, ">>", margin=MARGIN)
    set_objective(problem, P, objective, weights, scale)
    return problem


def synthesise(
    system: ErrorSystem,
    gamma: float,
    noise: FloatArray | None,
    objective: Objective,
    weights: FloatArray,
    gain: FloatArray | None = None,
) -> EllipsoidSolution:
    """Solve the design (or analysis) LMI, once to learn the scales and once in them.

    Raises
    ------
    InfeasibleDesign, SolverTrouble
        As the solver reports; the caller explains.
    """
    scale = np.ones(system.sizes[0])
    problem = design_problem(system, gamma, noise, objective, weights, scale, gain)
    rough = problem.solve(accept_inaccurate=True, **_accuracy(1e-5))
    if "Infeasible" in rough.status:
        problem.solve()
    if np.linalg.eigvalsh(rough["P"])[0] > 0:
        scale = 2.0 ** np.round(0.5 * np.log2(np.diag(np.linalg.inv(rough["P"]))))
    problem = design_problem(system, gamma, noise, objective, weights, scale, gain)
    solution = solve_reliably(problem)
    K = gain
    if K is None:
        K = np.linalg.solve(solution["P"], solution["H"]) * scale[:, None]
    P = gamma * solution["P"] / np.outer(scale, scale)
    Q_v = np.diag(solution["Q_v"]).copy() if noise is None else noise
    return EllipsoidSolution(K, 0.5 * (P + P.T), gamma, np.maximum(Q_v, 0.0))


def _accuracy(tolerance: float) -> dict[str, Any]:
    return dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), tolerance)


def solve_reliably(problem: Problem) -> Solution:
    """Solve to the best accuracy that the solver reaches and calls solved."""
    for tolerance in (1e-8, 1e-7, 1e-6):
        solution = problem.solve(accept_inaccurate=True, **_accuracy(tolerance))
        if solution.solved:
            return solution
    return problem.solve(**_accuracy(1e-5))


def analyse_gain(
    system: ErrorSystem, gain: FloatArray, noise: FloatArray | None, weights: FloatArray
) -> EllipsoidSolution:
    """Find the best ellipsoid and gamma for a given gain."""
    radius = _decay_limit(system, gain)
    if radius >= 1.0:
        raise InfeasibleDesign(
            f"the given gain is unstable: spectral radius {radius:.6f} at a vertex of the "
            "Jacobian set",
            spectral_radius=radius,
        )
    top = 1.0 - radius**2

    def solve(gamma: float) -> EllipsoidSolution:
        return synthesise(system, gamma, noise, "trace_inverse", weights, gain)

    return search_gamma(solve, weights, top)


def _decay_limit(system: ErrorSystem, gain: FloatArray) -> float:
    """Return the largest spectral radius of the error map over the vertices."""
    X, _ = system.closed_loop(gain)
    return float(np.abs(np.linalg.eigvals(X)).max())


def largest_gamma(system: ErrorSystem, rtol: float = 1e-3, gain: FloatArray | None = None) -> float:
    """Return the largest gamma for which some P and gain satisfy ``X'P X < (1 - gamma) P``.

    Bounds of the noise do not enter: they only scale P.

    Returns
    -------
    float
        A feasible value, within `rtol` of the largest; 0 where nothing is feasible.
    """
    return largest_feasible(lambda gamma: decay_room(system, gamma, gain), rtol)


def largest_feasible(room: Callable[[float], float], rtol: float = 1e-3) -> float:
    """Bisect for the largest gamma in (0, 1) with ``room(gamma) > 0``; room falls with gamma."""
    if room(0.0) <= 0:
        return 0.0
    low, high = 0.0, 1e-4
    while high < 1.0 and room(high) > 0:
        low, high = high, min(3.0 * high, 1.0)
    while low == 0.0:
        if high < 1e-9:
            return 0.0
        if room(high / 3.0) > 0:
            low = high / 3.0
        else:
            high /= 3.0
    while high - low > rtol * high:
        middle = 0.5 * (low + high)
        if room(middle) > 0:
            low = middle
        else:
            high = middle
    return low


def decay_room(system: ErrorSystem, gamma: float, gain: FloatArray | None = None) -> float:
    """Return the largest t with ``[(1-gamma) P, X'P; P X, P] >= t I``, P <= I, less a tolerance."""
    p, m, _ = system.sizes
    problem = Problem(f"decay at gamma = {gamma:.6g}")
    P = symmetric("P", p)
    if gain is None:
        X = P @ system.Abar - full("H", p, m) @ system.Cbar
    else:
        X = P @ system.closed_loop(gain)[0]
    return largest_margin(problem, symmetric_block([[P * (1.0 - gamma)], [X, P]]), P)


def largest_margin(problem: Problem, block: Affine, P: Affine) -> float:
    """Phase 1: the largest t with ``block >= t I`` and P <= I, minus the solver's tolerance."""
    room = scalar("t")
    problem.add_lmi("block", block - room * np.eye(block.shape[0]), ">>")
    problem.add_lmi("size", P - np.eye(P.shape[0]), "<<")
    problem.maximise(room)
    solution = problem.solve(accept_inaccurate=True)
    return solution.number("t") - 1e-9


def search_gamma(
    solve: Callable[[float], EllipsoidSolution],
    weights: FloatArray,
    top: float,
    xatol: float = 5e-3,
) -> EllipsoidSolution:
    """Line search over gamma for the smallest sum of the (weighted) half widths.

    Parameters
    ----------
    solve : callable
        ``gamma -> EllipsoidSolution``; may raise InfeasibleDesign or SolverTrouble.
    weights : ndarray of shape (p,)
    top : float
        Largest gamma to try (exclusive).
    xatol : float
        Of log gamma.
    """
    from scipy.optimize import minimize_scalar

    best: list[tuple[float, EllipsoidSolution]] = []

    def cost(log_gamma: float) -> float:
        try:
            solution = solve(float(np.exp(log_gamma)))
        except (InfeasibleDesign, SolverTrouble):
            return 1e30
        value = float(np.sqrt(weights * solution.inverse_diagonal).sum())
        best.append((value, solution))
        return value

    bounds = (np.log(top * 0.05), np.log(top * 0.9999))
    minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": xatol})
    if not best:
        raise InfeasibleDesign(f"no gamma below {top:.4g} is feasible", largest_gamma=top)
    return min(best, key=lambda pair: pair[0])[1]
