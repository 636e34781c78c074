"""Gains and attenuation levels by linear matrix inequalities: solved here, proved elsewhere.

The problems are stated in the units of `find_units`, where the entries are about one, so that caps
and margins mean the same for every plant.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from obsynth.designs.core.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.hinf import lmis
from obsynth.designs.hinf.lmis import Loop, PrintedLoop
from obsynth.designs.hinf.system import Filter, FilterData, Units, find_units
from obsynth.designs.lmi.conic import Solution
from obsynth.designs.lmi.expression import full, scalar, symmetric, trace
from obsynth.designs.lmi.margin import Margin, largest_margin
from obsynth.designs.lmi.problem import Problem
from obsynth.designs.lmi.search import bisect_feasible
from obsynth.designs.lmi.solve import solve_reliably
from obsynth.symbolic.arrays import FloatArray

Structure = Literal["standard", "general", "printed"]
Values = Mapping[str, FloatArray]

# Several infima need one direction of P to go to infinity. The least mu is the least one within
# these limits, in units in which the rest of P is about one; a plant is known where it lies 6e-5
# (1.4e-4 with multipliers) above the infimum. A given mu is looked for under the wider ones too.
CAP = 1e4
WIDER = (1e6, 1e8)
NOT_FOUND = (
    f"infeasible with P <= {CAP:g} I, and not found up to {WIDER[-1]:g} I, in units where "
    "its least entries are about one"
)
FLOOR = 1e-3
# Room between the solver's answer and the boundary: large against the solver's tolerance.
MARGIN = 1e-7
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
    """A storage function that shows a level, in the plant's units, with the letters of `Bound`."""

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


def state_problem(
    data: FilterData,
    structure: Structure,
    mu: float | None,
    decay: float | None = None,
    gains: Filter | None = None,
    margin: float = MARGIN,
    cap: float = CAP,
) -> Problem:
    """State the design LMI, or with `gains` the analysis LMI."""
    name = "least mu" if mu is None else f"mu = {mu:.6g}"
    problem = Problem(f"H-infinity {'analysis' if gains else 'design'}, {name}")
    P = symmetric("P", len(data.A))
    mu2: Any = scalar("mu2") if mu is None else mu**2
    if structure == "printed":
        _state_printed(problem, data, P, mu2, gains, margin)
        loop = None
    else:
        loop = open_loop(data, structure, P, gains)
        tau = multipliers("tau", data)
        block = lmis.dissipation_block(loop, mu2, data.sector, tau)
        problem.add_lmi("dissipation", block, ">>", margin=margin)
    if decay is not None and loop is not None:
        block = lmis.decay_block(loop, decay, data.sector, multipliers("decay.tau", data))
        problem.add_lmi("decay", block, ">>", margin=margin)
    problem.add_lmi("P.cap", cap * np.eye(len(data.A)) - P, ">>", strict=False)
    problem.add_lmi("P.floor", P - FLOOR * np.eye(len(data.A)), ">>", strict=False)
    problem.minimise(trace(P) if mu is not None else mu2)
    return problem


def multipliers(name: str, data: FilterData) -> list[Any]:
    """Return one scalar unknown per group of the sector."""
    groups = 0 if data.sector is None else data.sector.groups
    return [scalar(f"{name}{k + 1}") for k in range(groups)]


def open_loop(data: FilterData, structure: Structure, P: Any, gains: Filter | None) -> Loop:
    """Form the error system with free gains, or with the given ones."""
    if gains is not None:
        return lmis.loop_of_filter(data, gains, P)
    n, m = len(data.A), len(data.C)
    standard = data.standard_filter(np.zeros((n, m)))
    PG: Any = P @ data.G
    HC: Any = standard.H @ data.C
    DC: Any = np.zeros((data.n_f, n))
    if structure == "general":
        r = len(data.null)
        DC = full("D", data.n_f, m) @ data.C
        if r:
            PG = PG - full("N2", n, r) @ (data.null @ data.C)
            HC = full("Y", data.n_f, r) @ (data.null @ data.C) + HC
    return Loop(P, PG, full("N", n, m) @ data.C, HC, DC, data.dynamics(), data.W)


def _state_printed(
    problem: Problem, data: FilterData, P: Any, mu2: Any, gains: Filter | None, margin: float
) -> None:
    n, m = len(data.A), len(data.C)
    loop = PrintedLoop.of(data, gains)
    N = full("N", n, m) if gains is None else P @ gains.K
    Q, alpha, beta = symmetric("Q", n), scalar("alpha"), scalar("beta")
    problem.add_lmi(
        "(45)", lmis.printed_block(loop, P, N, Q, alpha, beta, mu2), ">>", margin=margin
    )
    problem.add_lmi("(37)", lmis.printed_bound(loop, P, alpha), ">>", margin=margin)
    problem.add_lmi("Q", Q, ">>", margin=margin)
    # Not implied by (45): with beta < 0 the Lipschitz condition (35) would count backwards.
    problem.add_lmi("beta", beta, ">>", margin=margin)


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
    except (InfeasibleDesign, SolverTrouble) as refusal:
        raise _explained(refusal, scaled, structure, decay, given) from refusal
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
    return found


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
    raise troubles[0]


def _roomiest(state: Callable[[float], Problem], what: str) -> Margin:
    """Return the largest margin under the first cap of P that leaves any, or refuse."""
    first = largest_margin(state(CAP))
    if first.feasible:
        return first
    for cap in WIDER:
        margin = largest_margin(state(cap), explain=False)
        if margin.feasible:
            return margin
    raise InfeasibleDesign(f"{what}: {NOT_FOUND}", first.lines(), margin=first.value)


def find_filter(
    data: FilterData, structure: Structure, mu: float, decay: float | None = None
) -> tuple[Filter, Found]:
    """Find the gains with the smallest trace of P at a level."""
    units = find_units(data, structure == "printed")
    scaled = units.scaled(data)

    def state(cap: float, margin: float = MARGIN) -> Problem:
        return state_problem(scaled, structure, mu / units.f, decay, margin=margin, cap=cap)

    try:
        solution = _solve_with_caps(state)
    except (SolverTrouble, InfeasibleDesign):
        # A filter with room is better than none with the smallest trace.
        solution = _roomiest(lambda cap: state(cap, 0.0), f"mu = {mu:.9g}").found.solution
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

    def state(cap: float) -> Problem:
        return state_problem(scaled, structure, mu / units.f, decay, given, margin=0.0, cap=cap)

    margin = _roomiest(state, f"mu = {mu:.9g} cannot be shown for these gains")
    return _found(units, data, margin.found.solution.values, decay)


def unstable_vertex(data: FilterData, gains: Filter) -> tuple[int, float] | None:
    """Return the vertex with the largest spectral radius, if that is not below 1."""
    radii = np.abs(np.linalg.eigvals(data.closed_loops(gains))).max(axis=-1)
    worst = int(np.argmax(radii))
    return None if radii[worst] < 1.0 else (worst, float(radii[worst]))


def _explained(
    refusal: InfeasibleDesign | SolverTrouble,
    scaled: FilterData,
    structure: Structure,
    decay: float | None,
    gains: Filter | None,
) -> InfeasibleDesign | SolverTrouble:
    """Say what binds where no mu is feasible: the decay of V alone, a homogeneous problem."""
    what = "these gains" if gains is not None else "any gain"
    how = "decays" if decay is None else f"shrinks to {decay:g} of itself in a step"
    headline = f"no quadratic V {how} along every error with {what}, so there is no level mu"
    if structure == "printed":
        problem = state_problem(scaled, structure, None, None, gains, margin=0.0)
        headline = f"(45) with (37) leaves no room with {what}, so it shows no level mu"
        caps = {}
    else:
        problem = Problem("decay of V")
        P = symmetric("P", len(scaled.A))
        loop = open_loop(scaled, structure, P, gains)
        keep = 1.0 if decay is None else decay
        block = lmis.decay_block(loop, keep, scaled.sector, multipliers("tau", scaled))
        problem.add_lmi("decay", block, ">>")
        caps = {"size": P << np.eye(len(scaled.A))}
    try:
        margin = largest_margin(problem, caps=caps)
    except SolverTrouble as trouble:
        margin, refusal = None, trouble
    if margin is None or margin.feasible:
        return SolverTrouble(
            "no level mu was found, nor was it shown that there is none",
            [refusal.headline, *refusal.details],
        )
    details = margin.lines()
    if decay is not None:
        details.append("a larger decay= asks for less")
    if scaled.sector is not None:
        details.append(
            'multipliers="per_entry" or method="polytopic" know more about the nonlinearity'
        )
    details.append("smaller ranges of the states make its Jacobian vary less")
    return InfeasibleDesign(headline, details)
