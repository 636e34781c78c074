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
    scale: FloatArray | None = None,
) -> Problem:
    """State (51) with variables P, H, alpha, beta, U (printed) or P, H, a, b (repaired).

    The multipliers a of the repaired form keep the sign that the paper gives to
    alpha. (s = M e would allow any sign, which is a little less conservative.)
    As in `design_problem`, P and H stand for gamma times those of the paper, in
    scaled coordinates.
    """
    n, n_f, m, _ = data.sizes
    p = n + n_f
    scale = np.ones(p) if scale is None else scale
    problem = Problem(f"(51), {form}, at gamma = {gamma:.6g}")
    back = np.diag(1.0 / scale)
    P, H = symmetric("P", p), full("H", p, m)
    if form == "printed":
        a, b = scalar("alpha"), scalar("beta")
        problem.add("alpha.sign", a >= 0.0)
        block = multiplier_block(
            data,
            back @ P @ back,
            back @ H,
            1.0 - gamma,
            np.diag(noise),
            a * np.eye(n),
            b * np.eye(n),
            full("U", n, n),
        )
    else:
        a = diagonal("a", n)
        problem.add("a.sign", np.ones((1, n)) @ a >= 0.0)
        block = multiplier_block(
            data,
            back @ P @ back,
            back @ H,
            1.0 - gamma,
            np.diag(noise),
            a,
            diagonal("b", n),
        )
    extra = block.shape[0] - 2 * p - noise.size
    unit = np.concatenate([scale, np.ones(n), np.ones(noise.size), scale, np.ones(extra - n)])
    block = np.diag(unit) @ block @ np.diag(unit)
    problem.add_lmi("(51)", block, ">>", margin=MARGIN)
    set_objective(problem, P, objective, weights, scale)
    return problem


def largest_multiplier_gamma(data: ModelData) -> float:
    """Return the largest gamma for which the repaired form is feasible; noise does not enter."""
    quiet = replace(data, w_radius=data.w_radius * 0.0, rate=data.rate * 0.0)
    n, n_f, m, n_w = data.sizes
    p, n_v = n + n_f, 2 * n_w + n_f

    def state(gamma: float) -> tuple[Problem, Affine]:
        problem = Problem(f"(51), repaired, decay at gamma = {gamma:.6g}")
        P, H = symmetric("P", p), full("H", p, m)
        a, b = diagonal("a", n), diagonal("b", n)
        problem.add("a.sign", np.ones((1, n)) @ a >= 0.0)
        block = multiplier_block(quiet, P, H, 1.0 - gamma, np.eye(n_v), a, b)
        problem.add_lmi("(51)", block, ">>")
        return problem, P

    return largest_feasible(state)


def synthesise_multipliers(
    data: ModelData,
    gamma: float,
    noise: FloatArray,
    objective: Objective,
    weights: FloatArray,
    form: Literal["printed", "repaired"],
    scale: FloatArray | None = None,
) -> EllipsoidSolution:
    """Solve (51) at a fixed gamma."""
    p = sum(data.sizes[:2])
    scale = np.ones(p) if scale is None else scale
    problem = multiplier_problem(data, gamma, noise, objective, weights, form, scale)
    solution = solve_reliably(problem, floor=FLOOR, gap=GAP)
    gain = np.linalg.solve(solution["P"], solution["H"]) * scale[:, None]
    P = gamma * solution["P"] / np.outer(scale, scale)
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
