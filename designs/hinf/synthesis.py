"""Gains and attenuation levels by linear matrix inequalities: solved here, proved elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from obsynth.designs.core.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.hinf.lmis import decay_block
from obsynth.designs.hinf.problems import CAP, Structure, multipliers, open_loop, state_problem
from obsynth.designs.hinf.system import Filter, FilterData, Units, find_units
from obsynth.designs.lmi import (
    Margin,
    Problem,
    Solution,
    bisect_feasible,
    largest_margin,
    solve_reliably,
    symmetric,
)
from obsynth.symbolic.arrays import FloatArray

Values = Mapping[str, FloatArray]

# Asked for in turn where the solver does not cope with the one before.
CAPS = (CAP, 1e3, 1e2)
# A level of zero, where w can be kept out of f - fhat altogether, is not worth endless gains: this
# much of the typical size of f - fhat is asked for at least.
LEAST_LEVEL = 1e-3
# Violation left at vertices that are not stated when gains are sought: the storage function is
# looked for again, with these gains, if the proof does not go through.
LEFT = 1e-6
# Largest relative duality gap of an answer that the solver does not call solved.
GAP = 1e-6


@dataclass(frozen=True, eq=False)
class Found:
    """A storage function that shows a level, in the plant's units.

    P (n, n)
    tau, tau_decay (n_groups,)
    printed (0,) or (2 + n n,): alpha, beta and Q of (45)
    """

    P: FloatArray
    tau: FloatArray
    tau_decay: FloatArray
    printed: FloatArray

    def mixed(self, other: Found, share: float) -> Found:
        """Return a convex combination: for given gains all inequalities are linear in these."""
        pairs = (
            (getattr(self, name), getattr(other, name))
            for name in ("P", "tau", "tau_decay", "printed")
        )
        return Found(*((1.0 - share) * a + share * b for a, b in pairs))


def find_level(
    data: FilterData,
    structure: Structure,
    decay: float | None = None,
    gains: Filter | None = None,
) -> float:
    """Find the least mu, to the solver's accuracy, not below what `LEAST_LEVEL` stands for."""
    units = find_units(data, structure == "printed")
    scaled = units.scaled(data)
    given = None if gains is None else units.filter_from_plant(gains)

    def state(cap: float) -> Problem:
        return state_problem(scaled, structure, None, decay, given, cap=cap)

    # Where alpha and beta of (45) want to be infinite the solver stops short of it, the sooner the
    # larger P may be.
    starts = (CAPS, CAPS[-1:]) if structure == "printed" else (CAPS,)
    levels: list[float] = []
    try:
        for caps in starts:
            try:
                square = _solve_with_caps(state, caps).number("mu2")
                levels.append(float(np.sqrt(max(square, 0.0))))
            except SolverTrouble:
                continue
        least = min(levels) if levels else _bisected(scaled, structure, decay, given)
    except InfeasibleDesign as refusal:
        raise _explained(scaled, structure, decay, given) from refusal
    return max(least, LEAST_LEVEL) * units.f


def _bisected(
    scaled: FilterData, structure: Structure, decay: float | None, given: Filter | None
) -> float:
    """Find the least mu by margins alone, which the solver finds where it finds no minimum."""

    def margin(mu: float | None) -> Margin:
        problem = state_problem(scaled, structure, mu, decay, given, margin=0.0)
        return largest_margin(problem, explain=False)

    def feasible(mu: float) -> bool:
        try:
            return margin(mu).feasible
        except SolverTrouble:
            return False

    first = margin(None)
    if not first.feasible:
        raise InfeasibleDesign("no level leaves room", first.lines(), margin=first.value)
    inside = max(float(np.sqrt(first.found.solution.number("mu2"))), 2.0 * LEAST_LEVEL)
    found = bisect_feasible(feasible, inside, LEAST_LEVEL, rtol=1e-4, logarithmic=True)
    if found is None:
        raise SolverTrouble(f"no level could be found, although mu = {inside:.4g} has room")
    return found.feasible


def _solve_with_caps(state: Callable[[float], Problem], caps: tuple[float, ...] = CAPS) -> Solution:
    """Solve under the first cap of P that the solver copes with."""
    troubles: list[SolverTrouble] = []
    for cap in caps:
        try:
            return solve_reliably(state(cap), floor=-LEFT, gap=GAP)
        except SolverTrouble as trouble:
            troubles.append(trouble)
        except InfeasibleDesign:
            if not troubles:
                raise
    margin = largest_margin(state(CAP), explain=False)
    if margin.feasible:
        raise troubles[0]
    raise InfeasibleDesign(f"{state(CAP).name}: no room", margin.lines(), margin=margin.value)


def find_filter(
    data: FilterData, structure: Structure, mu: float, decay: float | None = None
) -> tuple[Filter, Found]:
    """Find the gains with the smallest trace of P at a level."""
    units = find_units(data, structure == "printed")
    scaled = units.scaled(data)

    def state(cap: float) -> Problem:
        return state_problem(scaled, structure, mu / units.f, decay, cap=cap)

    try:
        solution = _solve_with_caps(state)
    except SolverTrouble:
        # A filter with room is better than none with the smallest trace.
        roomy = state_problem(scaled, structure, mu / units.f, decay, margin=0.0)
        solution = largest_margin(roomy, explain=False).found.solution
    P = solution["P"]
    m, n_f = len(data.C), data.n_f
    K: FloatArray = np.asarray(np.linalg.solve(P, solution["N"]), dtype=float)
    F, H, D = scaled.L @ scaled.H, scaled.H[:n_f], np.zeros((n_f, m))
    if structure == "general":
        D = solution["D"]
        if len(scaled.null):
            F = F + np.linalg.solve(P, solution["N2"]) @ scaled.null
            H = H + solution["Y"] @ scaled.null
    gains = units.filter_to_plant(Filter(K, F, H, D))
    if structure != "general":
        gains = data.standard_filter(gains.K)
    return gains, _found(units, data, solution.values, decay)


def _found(units: Units, data: FilterData, values: Values, decay: float | None) -> Found:
    groups = 0 if data.sector is None else data.sector.groups
    names = [str(k + 1) for k in range(groups)]
    tau, tau_decay, printed = np.zeros(0), np.zeros(0), np.zeros(0)
    if "alpha" in values:
        size = units.f**2 / units.phi[0] ** 2
        Q = values["Q"] * size
        numbers = [float(values[key].item()) * size for key in ("alpha", "beta")]
        printed = np.concatenate([numbers, (0.5 * (Q + Q.T)).ravel()])
    elif groups:
        tau = units.tau_to_plant(np.array([float(values[f"tau{k}"].item()) for k in names]))
        if decay is not None:
            raw = np.array([float(values[f"decay.tau{k}"].item()) for k in names])
            tau_decay = units.tau_to_plant(raw)
    return Found(units.P_to_plant(values["P"]), tau, tau_decay, printed)


def find_storage(
    data: FilterData,
    structure: Structure,
    mu: float,
    gains: Filter,
    decay: float | None = None,
) -> Found:
    """Find the storage function of given gains with the most room at a level."""
    units = find_units(data, structure == "printed")
    scaled = units.scaled(data)
    given = units.filter_from_plant(gains)
    problem = state_problem(scaled, structure, mu / units.f, decay, given, margin=0.0)
    margin = largest_margin(problem, explain=False)
    if not margin.feasible:
        raise InfeasibleDesign(
            f"mu = {mu:.6g} cannot be shown for these gains", margin.lines(), margin=margin.value
        )
    return _found(units, data, margin.found.solution.values, decay)


def unstable_vertex(data: FilterData, gains: Filter) -> tuple[int, float] | None:
    """Return the vertex with the largest spectral radius, if that is not below 1."""
    radii = np.abs(np.linalg.eigvals(data.closed_loops(gains))).max(axis=-1)
    worst = int(np.argmax(radii))
    return None if radii[worst] < 1.0 else (worst, float(radii[worst]))


def _explained(
    scaled: FilterData, structure: Structure, decay: float | None, gains: Filter | None
) -> InfeasibleDesign:
    """Say what binds where no mu is feasible: the decay of V alone, a homogeneous problem."""
    what = "these gains" if gains is not None else "any gain"
    how = "decays" if decay is None else f"shrinks to {decay:g} of itself in a step"
    headline = f"no quadratic V {how} along every error with {what}, so there is no level mu"
    details = []
    if structure != "printed":
        problem = Problem("decay of V")
        P = symmetric("P", len(scaled.A))
        loop = open_loop(scaled, structure, P, gains)
        keep = 1.0 if decay is None else decay
        block = decay_block(loop, keep, scaled.sector, multipliers("tau", scaled))
        problem.add_lmi("decay", block, ">>")
        try:
            margin = largest_margin(problem, caps={"size": P << np.eye(len(scaled.A))})
            details += margin.lines()
        except SolverTrouble as trouble:
            details.append(str(trouble).splitlines()[0])
    if decay is not None:
        details.append("a larger decay= asks for less")
    if scaled.sector is not None:
        details.append(
            'multipliers="per_entry" or method="polytopic" know more about the nonlinearity'
        )
    details.append("smaller ranges of the states make its Jacobian vary less")
    return InfeasibleDesign(headline, details)
