"""Gains and ellipsoids by linear matrix inequalities: solved here, proved elsewhere."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from obsynth.designs.bounded_error.lmis import ErrorSystem, boundedness_block
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.lmi.expression import Affine, diagonal, full, symmetric, trace
from obsynth.designs.lmi.margin import Margin, largest_margin
from obsynth.designs.lmi.problem import Problem, symmetric_block
from obsynth.designs.lmi.search import bisect_feasible, search_line, search_scale
from obsynth.designs.lmi.solve import solve_reliably
from obsynth.symbolic.arrays import FloatArray

Objective = Literal["trace_inverse", "log_det", "lambda_min", "trace"]

# Room between the solver's answer and the boundary, relative to blocks scaled to about one:
# large against the solver's tolerance, small against the digits anybody reads.
MARGIN = 1e-7
FLOOR = -0.5 * MARGIN
GAP = 1e-5
LEAST_GAMMA = 1e-9
# Shares of the largest gamma that are tried before the golden sections.
GRID = (0.1, 0.3, 0.5, 0.65, 0.8, 0.95)
REFINE = 6
# Of the largest gamma for a given gain: where the search begins.
LEAST_SHARE = 1e-4


@dataclass(frozen=True, eq=False)
class EllipsoidSolution:
    """A solution of the design or analysis LMI: gain (p, m), P (p, p), weights (n_v,)."""

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
    """Set a size criterion of section 5, or one of two that serve it better; scale (p,)."""
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
    """State the design LMI (or, with a gain, the analysis LMI) at a gamma; weights, scale (p,)."""
    p, m, n_v = system.sizes
    scale = np.ones(p) if scale is None else scale
    scaled = _scaled(system, scale)
    kind = "design" if gain is None else "analysis"
    problem = Problem(f"bounded-error {kind} at gamma = {gamma:.6g}")
    P = symmetric("P", p)
    Q = _noise(noise, n_v, problem)
    if gain is None:
        X, Z = scaled.weighed(P, full("H", p, m))
    else:
        X, Z = (P @ part for part in scaled.closed_loop(gain / scale[:, None]))
    block = boundedness_block(P, X, Z, 1.0 - gamma, Q)
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
    """Solve the design (or analysis) LMI, once to learn the scales and once in them."""
    scale = np.ones(system.sizes[0])
    problem = design_problem(system, gamma, noise, objective, weights, scale, gain)
    rough = problem.solve(accept_inaccurate=True, tol_gap_abs=1e-5, tol_gap_rel=1e-5)
    if np.linalg.eigvalsh(rough["P"])[0] > 0:
        scale = 2.0 ** np.round(0.5 * np.log2(np.diag(np.linalg.inv(rough["P"]))))
    problem = design_problem(system, gamma, noise, objective, weights, scale, gain)
    solution = solve_reliably(problem, floor=FLOOR, gap=GAP)
    K = gain
    if K is None:
        K = np.linalg.solve(solution["P"], solution["H"]) * scale[:, None]
    P = gamma * solution["P"] / np.outer(scale, scale)
    Q_v = np.diag(solution["Q_v"]).copy() if noise is None else noise
    return EllipsoidSolution(K, 0.5 * (P + P.T), gamma, np.maximum(Q_v, 0.0))


def analyse_gain(
    system: ErrorSystem, gain: FloatArray, noise: FloatArray | None, weights: FloatArray
) -> EllipsoidSolution:
    """Find ellipsoid and gamma of a gain: one minimum (the method's page, Given gains)."""
    radius = _decay_limit(system, gain)
    if radius >= 1.0:
        raise InfeasibleDesign(
            f"the given gain is unstable: spectral radius {radius:.6f} at a vertex of the "
            "Jacobian set",
            spectral_radius=radius,
        )

    def solve(gamma: float) -> EllipsoidSolution:
        return synthesise(system, gamma, noise, "trace_inverse", weights, gain)

    def size(solution: EllipsoidSolution) -> float:
        return float(weights @ solution.inverse_diagonal)

    top = 1.0 - radius**2
    return search_scale(solve, size, LEAST_SHARE * top, top, name="gamma").result


def _decay_limit(system: ErrorSystem, gain: FloatArray) -> float:
    """Return the largest spectral radius of the error map over the vertices."""
    X, _ = system.closed_loop(gain)
    return float(np.abs(np.linalg.eigvals(X)).max())


def largest_gamma(system: ErrorSystem, gain: FloatArray | None = None) -> float:
    """Return the largest gamma for which some P and gain satisfy ``X'P X < (1 - gamma) P``."""
    return largest_feasible(lambda gamma: decay_problem(system, gamma, gain))


def decay_problem(
    system: ErrorSystem, gamma: float, gain: FloatArray | None = None
) -> tuple[Problem, Affine]:
    """State ``[(1 - gamma) P, X'P; P X, P] > 0``: quadratic boundedness without noise."""
    p, m, _ = system.sizes
    problem = Problem(f"decay at gamma = {gamma:.6g}")
    P, H = symmetric("P", p), full("H", p, m)
    X, _ = system.weighed(P, H) if gain is None else (P @ system.closed_loop(gain)[0], None)
    problem.add_lmi("decay", symmetric_block([[P * (1.0 - gamma)], [X, P]]), ">>")
    return problem, P


def explain_infeasible(
    system: ErrorSystem, gamma: float, gain: FloatArray | None = None
) -> tuple[list[str], float | None]:
    """Say what binds at an infeasible gamma, and how much narrower the Jacobian set has to be."""

    def margin(share: float, explain: bool = False) -> Margin:
        middle = system.Abar.mean(axis=0)
        narrowed = replace(system, Abar=middle + share * (system.Abar - middle))
        problem, P = decay_problem(narrowed, gamma, gain)
        return largest_margin(problem, caps={"size": P << np.eye(P.shape[0])}, explain=explain)

    lines = margin(1.0, explain=True).lines()
    found = bisect_feasible(lambda share: margin(share).feasible, 0.0, 1.0, rtol=0.01)
    if found is None:
        return [*lines, "no box is small enough: infeasible even for one constant Jacobian"], None
    return [
        *lines,
        f"the same gamma is feasible if the Jacobian varies {100 * found:.0f} % as much "
        "about its middle: make the box of the states smaller",
    ], found


def largest_feasible(state: Callable[[float], tuple[Problem, Affine]], rtol: float = 1e-3) -> float:
    """Return the largest gamma with a margin, 0 where there is none."""

    def feasible(gamma: float) -> bool:
        problem, P = state(gamma)
        cap = {"size": P << np.eye(P.shape[0])}
        return largest_margin(problem, caps=cap, explain=False).feasible

    found = bisect_feasible(feasible, LEAST_GAMMA, 1.0 - 1e-9, rtol=rtol, logarithmic=True)
    return found or 0.0


def search_gamma(
    solve: Callable[[float], EllipsoidSolution], weights: FloatArray, top: float
) -> EllipsoidSolution:
    """Search gamma for the smallest sum of the (weighted) half widths. Shapes: weights (p,)."""
    found = search_line(
        solve,
        lambda solution: float(np.sqrt(weights * solution.inverse_diagonal).sum()),
        [top * share for share in GRID],
        refine=REFINE,
        name="gamma",
    )
    return found.result
