"""Design through inequality (51): as printed, repaired, and a proof that it has no solution.

At a vertex M of the Jacobian bounds take an augmented error ``ebar = (e, e_f)`` and a value ``s``
of the nonlinearity with

    C e = 0 ,   T (A e + B_f e_f + s) = e ,
    q1 = e'M e - s'e >= 0 ,   q2 = |M e|^2 - |s|^2 >= 0 .

No gain sees this error, and the error map sends it to itself, so V does not change; yet s
satisfies both inequalities that (51) allows it. The quadratic form of (31) there with v = 0 is
``gamma V + 2 alpha q1 + beta q2 > 0`` for all gamma, alpha, beta > 0, P and K.
"""

import itertools
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, Literal

import numpy as np

from obsynth.derive import JacobianBounds
from obsynth.derive.rigour import ExactMatrix
from obsynth.designs.bounded_error import synthesis
from obsynth.designs.bounded_error.lmis import ModelData, multiplier_block
from obsynth.designs.bounded_error.synthesis import EllipsoidSolution, Objective
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.lmi.expression import Affine, diagonal, full, scalar, symmetric
from obsynth.designs.lmi.problem import Problem
from obsynth.designs.lmi.solve import solve_reliably
from obsynth.symbolic.arrays import FloatArray

MOST_ENTRIES = 12
SHARES = np.linspace(0.0, 1.0, 65)
_exact = np.vectorize(Fraction, otypes=[object])


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
    """State (51), printed or repaired; P and H are gamma times those of the paper."""
    problem = Problem(f"(51), {form}, at gamma = {gamma:.6g}")
    P = _state(problem, data, gamma, noise, form, synthesis.MARGIN)
    synthesis.set_objective(problem, P, objective, weights, np.ones(len(weights)))
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

    return synthesis.largest_feasible(state)


def solve_multipliers(problem: Problem, gamma: float, noise: FloatArray) -> EllipsoidSolution:
    """Solve (51) as it is stated at a gamma."""
    solution = solve_reliably(problem, floor=synthesis.FLOOR, gap=synthesis.GAP)
    gain = np.asarray(np.linalg.solve(solution["P"], solution["H"]), dtype=float)
    P = gamma * solution["P"]
    return EllipsoidSolution(gain, 0.5 * (P + P.T), gamma, noise)


def refuse_printed(data: ModelData, gamma: float) -> None:
    """Refuse the printed form where an error exists that no gain removes."""
    point = find_fixed_point(data.A, data.B_f, data.C, data.T, data.vertices)
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


@dataclass(frozen=True)
class FixedPoint:
    """An error that no gain removes, in exact rational numbers, at a vertex by its number.

    e, e_f, s: state error (n,), fault error (n_f,) and value of the nonlinearity (n,)
    q1, q2: the two quadratic constraints of (51) at this point; both are >= 0
    """

    e: tuple[Fraction, ...]
    e_f: tuple[Fraction, ...]
    s: tuple[Fraction, ...]
    q1: Fraction
    q2: Fraction
    vertex: int

    def __str__(self) -> str:
        def row(values: tuple[Fraction, ...]) -> str:
            return "(" + ", ".join(str(value) for value in values) + ")"

        return (
            f"at vertex {self.vertex}: e = {row(self.e)}, e_f = {row(self.e_f)}, "
            f"s = {row(self.s)} is a fixed point of the error for every gain, with "
            f"q1 = {self.q1} and q2 = {self.q2}, both >= 0"
        )


def verify_fixed_point(
    A: Any,
    B_f: Any,
    C: Any,
    T: Any,
    M: Any,
    e: tuple[Fraction, ...],
    e_f: tuple[Fraction, ...],
    s: tuple[Fraction, ...],
) -> tuple[Fraction, Fraction] | None:
    """Check a fixed point in exact arithmetic."""
    A, B_f, C, T, M = map(_exact, (A, B_f, C, T, M))
    error, fault, value = map(_exact, (e, e_f, s))
    if not error.any() or (C @ error).any():
        return None
    if (T @ (A @ error + B_f @ fault + value) != error).any():
        return None
    Me = M @ error
    q1, q2 = error @ Me - value @ error, Me @ Me - value @ value
    return (q1, q2) if q1 >= 0 and q2 >= 0 else None


def _solution_space(A: Any, B_f: Any, C: Any, T: Any) -> Any:
    """Basis of all (e, e_f, s) with C e = 0 and T (A e + B_f e_f + s) = e, exactly, in rows."""
    T, A, B_f, C = map(_exact, (T, A, B_f, C))
    rest = np.zeros((len(C), B_f.shape[1] + len(A)), dtype=int)
    rows = np.block([[C, rest], [T @ A - np.eye(len(A), dtype=int), T @ B_f, T]])
    reduced, rank = ExactMatrix.of(rows).entries.rref()
    table = _exact(ExactMatrix(reduced).to_fractions())[:rank]
    pivots = [int(np.flatnonzero(row)[0]) for row in table]
    free = [j for j in range(rows.shape[1]) if j not in pivots]
    basis = _exact(np.eye(rows.shape[1], dtype=int))[free]
    basis[:, pivots] = -table[:, free].T
    return basis


def find_fixed_point(A: Any, B_f: Any, C: Any, T: Any, vertices: Any) -> FixedPoint | None:
    """Search every vertex (N, n, n) for a fixed point that makes (51) infeasible, exactly.

    Where q1 and q2 are both positive somewhere every mean of them is, most of all along its
    principal axis, and along one of these axes both are, unless two belong to the same value.
    """
    space = _solution_space(A, B_f, C, T)
    if not len(space):
        return None
    n, n_f = np.shape(B_f)
    basis = space.T.astype(float)
    e, s = basis[:n], basis[n + n_f :]
    for number, M in enumerate(_exact(vertices).astype(float)):
        unit = max(float(np.abs(M).max()), 1e-12)
        Me = M @ e
        forms = e.T @ (Me - s) / unit, (Me.T @ Me - s.T @ s) / unit**2
        q1, q2 = (0.5 * (form + form.T) for form in forms)
        means = (share * q1 + (1.0 - share) * q2 for share in SHARES)
        axes = (np.linalg.eigh(mean)[1][:, -1] for mean in means)
        room, axis = max(((min(c @ q1 @ c, c @ q2 @ c), c) for c in axes), key=lambda pair: pair[0])
        if room > 0.0:
            data = (A, B_f, C, T, vertices[number])
            point = _rounded_point(axis, space, n, n_f, data, number)
            if point is not None:
                return point
    return None


def _rounded_point(
    c: FloatArray,
    space: Any,
    n: int,
    n_f: int,
    data: tuple[Any, Any, Any, Any, Any],
    vertex: int,
) -> FixedPoint | None:
    """Round the coordinates to ever longer rationals until the exact check passes."""
    largest = float(np.abs(c).max())
    for denominator in (10, 100, 1000, 10**4, 10**6, 10**9):
        coordinates = [Fraction(float(x / largest)).limit_denominator(denominator) for x in c]
        vector = coordinates @ space
        unit = max(vector[:n], key=abs)
        if unit == 0:
            continue
        e, e_f, s = (tuple(part) for part in np.split(vector / unit, (n, n + n_f)))
        quadratics = verify_fixed_point(*data, e, e_f, s)
        if quadratics is not None:
            return FixedPoint(e, e_f, s, *quadratics, vertex)
    return None
