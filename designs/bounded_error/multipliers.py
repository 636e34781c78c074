"""Design through inequality (51): as printed, and repaired with diagonal multipliers."""

import itertools
from dataclasses import replace
from typing import Literal

import numpy as np

from obsynth.derive import JacobianBounds
from obsynth.designs.bounded_error.infeasibility import find_fixed_point
from obsynth.designs.bounded_error.lmis import ModelData, multiplier_block
from obsynth.designs.bounded_error.synthesis import (
    FLOOR,
    GAP,
    MARGIN,
    EllipsoidSolution,
    Objective,
    largest_feasible,
    set_objective,
)
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.lmi.expression import Affine, diagonal, full, scalar, symmetric
from obsynth.designs.lmi.problem import Problem
from obsynth.designs.lmi.solve import solve_reliably
from obsynth.symbolic.arrays import FloatArray

MOST_ENTRIES = 12


def box_vertices(bounds: JacobianBounds) -> FloatArray:
    """All 2^k combinations of the k uncertain entries, as Remark 2 takes them."""
    low, high = bounds.min, bounds.max
    rows, columns = np.nonzero(low != high)
    count = rows.size
    if count > MOST_ENTRIES:
        raise InfeasibleDesign(
            f"the printed form needs 2^{count} vertices; use form='corrected', which takes "
            f"{len(bounds.vertices())}",
            entries=count,
        )
    vertices = np.repeat(low[None], 2**count, axis=0)
    for number, choice in enumerate(itertools.product((False, True), repeat=count)):
        picked = np.array(choice, dtype=bool)
        vertices[number, rows, columns] = np.where(picked, high[rows, columns], low[rows, columns])
    return vertices


def multiplier_problem(
    data: ModelData,
    gamma: float,
    noise: FloatArray,
    objective: Objective,
    weights: FloatArray,
    form: Literal["printed", "repaired"],
) -> Problem:
    """State (51) with variables P, H, alpha, beta, U (printed) or P, H, a, b (repaired).

    The multipliers a of the repaired form keep the sign that the paper gives to
    alpha. (s = M e would allow any sign, which is a little less conservative.)
    As in `design_problem`, P and H stand for gamma times those of the paper.
    """
    problem = Problem(f"(51), {form}, at gamma = {gamma:.6g}")
    P = _state(problem, data, gamma, noise, form, MARGIN)
    set_objective(problem, P, objective, weights, np.ones(len(weights)))
    return problem


def _state(
    problem: Problem, data: ModelData, gamma: float, noise: FloatArray, form: str, margin: float
) -> Affine:
    """State the inequality and the signs of its multipliers, and return P."""
    n, n_f, m, _ = data.sizes
    P, H, U = symmetric("P", n + n_f), full("H", n + n_f, m), None
    if form == "printed":
        alpha, beta, U = scalar("alpha"), scalar("beta"), full("U", n, n)
        problem.add("alpha.sign", alpha >= 0.0)
        a, b = alpha * np.eye(n), beta * np.eye(n)
    else:
        a, b = diagonal("a", n), diagonal("b", n)
        problem.add("a.sign", np.ones((1, n)) @ a >= 0.0)
    block = multiplier_block(data, P, H, 1.0 - gamma, np.diag(noise), a, b, U)
    problem.add_lmi("(51)", block, ">>", margin=margin)
    return P


def largest_multiplier_gamma(data: ModelData) -> float:
    """Return the largest gamma for which the repaired form is feasible; noise does not enter."""
    quiet = replace(data, w_radius=data.w_radius * 0.0, rate=data.rate * 0.0)
    _, n_f, _, n_w = data.sizes

    def state(gamma: float) -> tuple[Problem, Affine]:
        problem = Problem(f"(51), repaired, decay at gamma = {gamma:.6g}")
        return problem, _state(problem, quiet, gamma, np.ones(2 * n_w + n_f), "repaired", 0.0)

    return largest_feasible(state)


def synthesise_multipliers(
    data: ModelData,
    gamma: float,
    noise: FloatArray,
    objective: Objective,
    weights: FloatArray,
    form: Literal["printed", "repaired"],
) -> EllipsoidSolution:
    """Solve (51) at a fixed gamma."""
    problem = multiplier_problem(data, gamma, noise, objective, weights, form)
    solution = solve_reliably(problem, floor=FLOOR, gap=GAP)
    gain = np.asarray(np.linalg.solve(solution["P"], solution["H"]), dtype=float)
    P = gamma * solution["P"]
    return EllipsoidSolution(gain, 0.5 * (P + P.T), gamma, noise)


def refuse_printed(data: ModelData, vertices: FloatArray, gamma: float) -> None:
    """Refuse the printed form where an error exists that no gain removes."""
    point = find_fixed_point(data.A, data.B_f, data.C, data.T, vertices)
    if point is None:
        return
    raise InfeasibleDesign(
        f"(51) as printed is infeasible for every gamma, P, K, alpha, beta and U "
        f"(asked for: gamma = {gamma:.6g})",
        [
            str(point),
            "the reason: Assumptions 1 and 2 bound s only through two scalars, so (51) has to "
            "hold for values of the nonlinearity that no Jacobian in the box produces",
            'what to do: form="corrected" uses s = M e at every vertex',
        ],
        certificate=point,
        gamma=gamma,
    )
