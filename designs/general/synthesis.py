"""Gains, ellipsoids and energy gains by `storage_block`: solved here, proved in `claims`.

The unknowns are scaled by bounds that some gain already has where there is one: then P is near the
identity. Scaled by ranges alone, a solver has called values optimal that were a tenth off.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from obsynth.designs.core.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.general.gain import GainSearch, riccati_starts, scaled
from obsynth.designs.general.lmis import Loop, error_loop, storage_block
from obsynth.designs.general.peak import spectral_radius
from obsynth.designs.general.record import GeneralDesign
from obsynth.designs.general.system import error_system
from obsynth.designs.lmi.conic import Solution
from obsynth.designs.lmi.expression import Affine, diagonal, full, scalar, symmetric, trace
from obsynth.designs.lmi.problem import Problem
from obsynth.designs.lmi.solve import solve_with_retries
from obsynth.symbolic.arrays import FloatArray, IntArray

# Room between the solver's answer and the boundary, relative to blocks scaled to about one.
MARGIN = 1e-7
# An answer with such a gap of the objective serves, as a proof follows.
GAP = 1e-5
# Of the search for gamma: the first step, what is worth another, what may be missed, most solves.
STEP, WORTH, ENOUGH, MOST = 1.8, 2e-3, 0.02, 12
LEAST_GAMMA, LARGEST_GAMMA = 1e-5, 0.98
# What keeps rounded weights inside the simplex.
BELOW_ONE = 1.0 - 2.0**-44
# Of P against the units, for energy gains: several infima are reached as P grows without bound.
CAPS = (1e5, 1e4, 1e3)
LEAST_LEVEL = 1e-24


@dataclass(frozen=True, eq=False)
class Found:
    """Numbers found, in units of the plant; noise, tau: diagonals; level: mu."""

    Z: FloatArray
    P: FloatArray
    gamma: float
    noise: FloatArray
    tau: FloatArray
    level: float


@dataclass(frozen=True, eq=False)
class Units:
    """A start, units of errors x (N,), readings y (m,), and whether a bound was found."""

    Z: FloatArray
    x: FloatArray
    y: FloatArray
    bounded: bool


def units(design: GeneralDesign, weights: FloatArray) -> Units:
    """Take the peak bounds of the best Riccati gain as units, or the ranges."""
    data, m = scaled(design), design.L0.shape[1]
    share = weights * data.x
    share = share / share.sum() if share.sum() > 0 else np.full(len(share), 1.0 / len(share))
    search = GainSearch(data, share)
    tried = [(search.value(Z), Z) for Z in riccati_starts(data)]
    y = np.ones(m)
    y[data.free] = data.y
    if not tried:
        return Units(np.zeros((len(data.x), m)), data.x, y, bounded=False)
    value, Z = min(tried, key=lambda pair: (pair[0].mean, pair[0].rho, pair[0].radius))
    bounded = bool(np.isfinite(value.b).all())
    size = np.maximum(value.b[len(data.x) :], 1e-5) if bounded else np.ones(len(data.x))
    return Units(data.deployed(Z, m), size * data.x, y, bounded)


@dataclass(frozen=True, eq=False)
class Stated:
    """The maps of a loop in units, as doubles; see `Loop`. free: columns of Z."""

    loop: Loop
    E: FloatArray
    Y: FloatArray
    z: FloatArray
    q: FloatArray
    units: Units
    free: IntArray


def state(design: GeneralDesign, measured: Units) -> Stated:
    """Put the loop of a design in units."""
    system = error_system(design)
    loop = error_loop(system)
    _, n_w, _ = loop.sizes
    sources = np.concatenate([system.of_F.sources, system.of_h.sources])
    radii = np.concatenate([system.of_F.radii, system.of_h.radii])
    q = radii * np.concatenate([measured.x, system.v_radius])[sources]
    columns = np.concatenate([measured.x, np.ones(n_w), q])
    free = np.array([i for i in range(len(measured.y)) if i not in design.extended.picked], int)
    return Stated(
        loop,
        loop.E.mid * columns / measured.x[:, None],
        loop.Y.mid * columns / measured.y[:, None],
        loop.z.mid * columns / q[:, None],
        q,
        measured,
        free,
    )


def ellipsoid_problem(
    stated: Stated, gamma: float, weights: FloatArray, gain: FloatArray | None = None
) -> Problem:
    """State the LMI for the smallest sum of the weighted squares of half widths at a gamma."""
    _, n_w, n_q = stated.loop.sizes
    problem = Problem(f"bounded-error design of the general class at gamma = {gamma:.6g}")
    P, X = _unknowns(stated, gain)
    noise = diagonal("noise", n_w) if n_w else None
    tau = diagonal("tau", n_q) if n_q else None
    if noise is not None:
        problem.add("noise.sum", trace(noise) <= gamma)
    block = storage_block(P, X, 1.0 - gamma, noise, tau, stated.z)
    problem.add_lmi("invariance", block, ">>", margin=MARGIN)
    cost = weights * stated.units.x
    cost = cost / cost.max()
    problem.minimise_trace_inverse(P, np.diag(cost)[:, cost > 0.0])
    return problem


def energy_problem(
    stated: Stated, weights: FloatArray, cap: float, gain: FloatArray | None = None
) -> Problem:
    """State the LMI for the least energy gain to the weighted errors; mu2 in their units."""
    _, n_w, n_q = stated.loop.sizes
    problem = Problem("energy gain of the general class")
    P, X = _unknowns(stated, gain)
    mu2 = scalar("mu2")
    noise = mu2 * np.eye(n_w) if n_w else None
    tau = diagonal("tau", n_q) if n_q else None
    cost = weights * stated.units.x
    output = np.diag((cost / cost.max()) ** 2)
    block = storage_block(P, X, 1.0, noise, tau, stated.z, output)
    problem.add_lmi("dissipation", block, ">>", margin=1e-2 / cap)
    problem.add("size", P << cap * np.eye(P.shape[0]))
    problem.add("level", mu2 >= 0.0)
    problem.minimise(mu2)
    return problem


def _unknowns(stated: Stated, gain: FloatArray | None) -> tuple[Affine, Affine]:
    """Return P and P (E - Z Y), with the gain free or given."""
    N, x = len(stated.E), stated.units.x
    P = symmetric("P", N)
    if gain is None and not len(stated.free):
        gain = np.zeros((N, len(stated.units.y)))
    if gain is None:
        return P, P @ stated.E - full("H", N, len(stated.free)) @ stated.Y[stated.free]
    Z = gain * stated.units.y / x[:, None]
    return P, P @ (stated.E - Z @ stated.Y)


def recovered(stated: Stated, solution: Solution, gamma: float, gain: FloatArray | None) -> Found:
    """Return a solution in the units of the plant."""
    x, y = stated.units.x, stated.units.y
    N, n_w, n_q = stated.loop.sizes
    Z = gain
    if Z is None:
        Z = np.zeros((N, len(y)))
    if gain is None and len(stated.free):
        Z[:, stated.free] = np.linalg.solve(solution["P"], solution["H"])
        Z = Z * x[:, None] / y
    P = solution["P"] / np.outer(x, x)
    noise = np.diag(solution["noise"]) if n_w and "noise" in solution.values else np.zeros(n_w)
    noise = np.maximum(noise, 0.0)
    noise = noise * min(1.0, gamma * BELOW_ONE / max(float(noise.sum()), 1e-300))
    tau = np.diag(solution["tau"]) if n_q else np.zeros(0)
    tau = np.maximum(tau, 0.0) / stated.q**2
    return Found(Z, 0.5 * (P + P.T), gamma, noise, tau, 0.0)


def solve_ellipsoid(
    design: GeneralDesign,
    weights: FloatArray,
    measured: Units,
    gamma: float | None = None,
    gain: FloatArray | None = None,
) -> Found:
    """Find an ellipsoid; over gamma, where not given, that of the least sum of weighted widths."""
    stated = [state(design, measured)]
    refusals: list[Exception] = []

    def solve(gamma: float) -> tuple[float, Found] | None:
        try:
            where, solution = _near_units(
                design, stated[-1], lambda s: ellipsoid_problem(s, gamma, weights, gain)
            )
            found = recovered(where, solution, gamma, gain)
            size = weights @ np.sqrt(np.diag(np.linalg.inv(found.P)))
        except (InfeasibleDesign, SolverTrouble, np.linalg.LinAlgError) as refusal:
            refusals.append(refusal)
            return None
        stated.append(_rescaled(design, where, solution))
        return (float(size), found) if size > 0.0 else None

    if gamma is not None:
        one = solve(gamma)
        best = None if one is None else one[1]
    else:
        best = search_gamma(solve, guess_gamma(stated[0], weights))
    if best is None:
        raise _no_ellipsoid(measured, gamma, refusals)
    return best


def _near_units(
    design: GeneralDesign, stated: Stated, make: Callable[[Stated], Problem]
) -> tuple[Stated, Solution]:
    """Solve a problem, again in units of what was found where that is not accurate."""
    problem = make(stated)
    rough = problem.solve(accept_inaccurate=True)
    if _serves(problem, rough):
        return stated, rough
    nearer = _rescaled(design, stated, rough)
    problem = make(nearer)
    solution = solve_with_retries(problem, (), lambda s: _serves(problem, s))
    if not _serves(problem, solution):
        raise SolverTrouble(f"{problem.name}: {solution.solver} calls solved what is not")
    return nearer, solution


def _serves(problem: Problem, found: Solution) -> bool:
    """Whether a solution has a small gap and leaves half the margin, as a proof follows."""
    if not 0.0 <= found.gap < GAP:
        return False
    strict = [item.expression for item in problem.blocks.values() if item.asks_margin]
    least = min(float(np.linalg.eigvalsh(found.value(part))[0]) for part in strict)
    return least > -0.5 * MARGIN


def _rescaled(design: GeneralDesign, stated: Stated, found: Solution) -> Stated:
    """Take the half widths of a P as units of the errors where these are far from them."""
    P = found["P"]
    if not (np.isfinite(P).all() and np.linalg.eigvalsh(P)[0] > 0.0):
        return stated
    inverse = np.diag(np.linalg.inv(P))
    if not np.all(inverse > 0.0):
        # barely definite: its inverse says nothing
        return stated
    size = np.clip(np.sqrt(inverse), 1e-3, 1e3)
    if np.all((size > 0.1) & (size < 10.0)):
        return stated
    return state(design, replace(stated.units, x=stated.units.x * size))


def _no_ellipsoid(
    measured: Units, gamma: float | None, refusals: list[Exception]
) -> InfeasibleDesign | SolverTrouble:
    """Refuse: infeasible only what exact arithmetic showed at the smallest gamma that was tried."""
    last = refusals[-1] if refusals else None
    where = "" if gamma is None else f" at gamma = {gamma:.6g}"
    details = [] if last is None else [str(last).splitlines()[0]]
    if isinstance(last, InfeasibleDesign) and (gamma is not None or not measured.bounded):
        return InfeasibleDesign(
            f"no gain makes the error contract{where} with one P and one multiplier per column",
            [
                *details,
                "bounds of disturbances do not enter this: they only scale P; narrow the ranges of "
                "the states"
                + ("" if gamma is None else ", or leave gamma= out, which searches a smaller one"),
            ],
            gamma=gamma,
        )
    mend = 'bounds="peak" has a design for this plant' if measured.bounded else "give gamma="
    return SolverTrouble(f"no ellipsoid was found{where}", [*details, mend], gamma=gamma)


def guess_gamma(stated: Stated, weights: FloatArray) -> float:
    """Return the gamma that would be best for the start, its channels taken for disturbances."""
    from scipy.linalg import solve_discrete_lyapunov

    N, units = len(stated.E), stated.units
    closed = stated.E - (units.Z * units.y / units.x[:, None]) @ stated.Y
    A, B = closed[:, :N], closed[:, N:]
    top = 1.0 - spectral_radius(A) ** 2
    if not top > LEAST_GAMMA:
        return 10.0 * LEAST_GAMMA
    W, sizes = np.diag((weights * units.x) ** 2), []
    # what the search for the other gain wins in decay
    grid = np.geomspace(max(1e-3 * top, LEAST_GAMMA), 0.97 * top, 24)
    for gamma in grid:
        S = solve_discrete_lyapunov((A / np.sqrt(1.0 - gamma)).T, W)
        shares = np.sqrt(np.maximum(np.einsum("ij,ik,kj->j", B, S, B), 0.0))
        sizes.append(float(shares.sum() / np.sqrt(gamma)))
    return float(np.clip(grid[int(np.argmin(sizes))], 10.0 * LEAST_GAMMA, LARGEST_GAMMA))


def search_gamma(
    solve: Callable[[float], tuple[float, Found] | None], start: float
) -> Found | None:
    """Walk from a guess to the smallest size, then on while the secants leave room for less."""
    tried: dict[float, tuple[float, Found] | None] = {}

    def at(step: float) -> float:
        if step not in tried:
            gamma = start * STEP**step
            fits = LEAST_GAMMA <= gamma <= LARGEST_GAMMA
            tried[step] = solve(gamma) if fits and len(tried) < MOST else None
        found = tried[step]
        return np.inf if found is None else float(np.log(found[0]))

    place = 0.0
    while at(place) == np.inf and start * STEP ** (place - 3) >= LEAST_GAMMA and len(tried) < MOST:
        place -= 3
    if at(place) == np.inf:
        return None
    way = 1 if at(place + 1) < at(place) else -1
    while at(place + way) < at(place) - WORTH:
        place += way
    sizes = {step: at(step) for step in (place - 1, place, place + 1, *tried)}
    while len(tried) < MOST and (probe := _next_step(sizes)) is not None:
        sizes[probe] = at(probe)
    return min((pair for pair in tried.values() if pair is not None), key=lambda pair: pair[0])[1]


def _next_step(sizes: Mapping[float, float]) -> float | None:
    """Return where the logarithm of a size, were it convex, could be less by `ENOUGH`.

    A jump up, or an end of what is feasible, leaves no room beyond and all on this side.
    """
    steps = sorted(sizes)
    k = min(range(1, len(steps) - 1), key=lambda k: sizes[steps[k]])
    best, rooms = steps[k], []
    for way in (-1, 1):
        near, far, beyond = steps[k + way], steps[k - way], k + 2 * way
        length, slope = abs(best - near), (sizes[far] - sizes[best]) / abs(best - far)
        room = slope * length
        if slope == np.inf and 0 <= beyond < len(steps) and sizes[near] < np.inf:
            slope = (sizes[steps[beyond]] - sizes[near]) / abs(near - steps[beyond])
            room = sizes[best] - sizes[near] + slope * length
        if room > ENOUGH:
            rooms.append((room, near))
    if not rooms:
        return None
    near = max(rooms)[1]
    a, b = best - steps[k - 1], steps[k + 1] - best
    left, right = (sizes[steps[j]] - sizes[best] for j in (k - 1, k + 1))
    if left + right < np.inf:
        share = 0.5 * (left * b**2 - right * a**2) / (left * b + right * a) / (near - best)
        if 0.2 <= share <= 0.8:
            return best + share * (near - best)
    return 0.5 * (best + near)


def solve_energy(
    design: GeneralDesign,
    weights: FloatArray,
    measured: Units,
    gain: FloatArray | None = None,
) -> Found:
    """Find the least energy gain to the weighted errors."""
    stated = state(design, measured)
    last: Exception | None = None
    for cap in CAPS:
        try:
            where, solution = _near_units(
                design, stated, partial(energy_problem, weights=weights, cap=cap, gain=gain)
            )
        except (InfeasibleDesign, SolverTrouble) as refusal:
            last = refusal
            continue
        found = recovered(where, solution, 0.0, gain)
        unit = float((weights * where.units.x).max())
        level = unit * np.sqrt(max(solution.number("mu2"), LEAST_LEVEL))
        return replace(found, P=found.P * unit**2, tau=found.tau * unit**2, level=level)
    text = "no energy gain was found"
    details = [] if last is None else [str(last).splitlines()[0]]
    if isinstance(last, InfeasibleDesign) and not measured.bounded:
        raise InfeasibleDesign(text, details)
    raise SolverTrouble(text, [*details, "give other weights=, or narrow the ranges"])
