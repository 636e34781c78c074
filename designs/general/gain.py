"""Gains that minimise the mean of the peak bounds themselves, in units of ranges, bounds and noise.

The starts are Riccati gains with the channels as further noise; from there BFGS with the exact
gradient of the sums, which copes with kinks (A. S. Lewis and M. L. Overton, Nonsmooth optimization
via quasi-Newton methods, Mathematical Programming 141, 2013). Nothing that is proved rests on it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.designs.core.errors import SolverTrouble
from obsynth.designs.general.peak import absolute_sums, spectral_radius
from obsynth.designs.general.record import GeneralDesign
from obsynth.designs.general.system import error_system
from obsynth.symbolic.arrays import FloatArray, IntArray

# Responses are followed until they have decayed so far; the bound found is proved afterwards.
HORIZON = 1e-6
MOST_STEPS = 6000
LEFT = 1e-4
SLOWEST = LEFT ** (1.0 / MOST_STEPS)
INFEASIBLE = 1e9
INFLATIONS = (1.0, 10.0, 0.1, 100.0)
ERRORS = (0.02, 0.2)
# Noise of every state and the decay that is asked for: what comes after the first pair is for
# errors that it leaves too slow to be summed, as of constants, which nothing drives.
STARTS = ((1e-10, 1.0), (1e-4, 1.0), (1e-10, SLOWEST), (1e-10, 0.99))
# Evaluations of a search, and numbers that all of them together may handle.
MOST_EVALUATIONS, WORK = 1500, 6e10
SMALL = 1e-12
MOST_DENSE = 400
# Relative gain of a search that is worth another one.
WORTH = 5e-4
# Searches: from which start (-1 for the best so far), in which units of small entries of a gain
# relative to the largest of their rows, and moved by which share at random.
SEARCHES = (
    (0, 0.1, 0.0),
    (1, 1.0, 0.0),
    (-1, 0.01, 0.0),
    (-1, 1.0, 0.0),
    (-1, 0.1, 0.2),
    (-1, 1.0, 0.2),
    (-1, 0.1, 0.0),
)


@dataclass(frozen=True, eq=False)
class Scaled:
    """The error system in units x, v, y of the ranges; see `ErrorSystem`.

    of_h, of_F: columns of the channels times their radii, in these units
    drives_h, drives_F: by which error a channel is driven, -1 for a disturbance
    free: outputs whose column of Z is free
    """

    x: FloatArray
    v: FloatArray
    y: FloatArray
    A0: FloatArray
    W0: FloatArray
    C0: FloatArray
    T: FloatArray
    L0V: FloatArray
    V: FloatArray
    of_h: FloatArray
    of_F: FloatArray
    drives_h: IntArray
    drives_F: IntArray
    free: IntArray

    def gain(self, design_gain: FloatArray) -> FloatArray:
        """Return the free columns of a Z in these units, (N, free)."""
        return np.asarray(design_gain[:, self.free] * self.y / self.x[:, None])

    def deployed(self, point: FloatArray, m: int) -> FloatArray:
        """Return Z (N, m) from its free columns in these units."""
        Z = np.zeros((len(self.x), m))
        Z[:, self.free] = point.reshape(len(self.x), -1) * self.x[:, None] / self.y
        return Z


def scaled(design: GeneralDesign) -> Scaled:
    """Put the error system of a design in units of the ranges."""
    system, plant = error_system(design), design.extended.plant
    N = system.size
    box = plant.box("x")
    half = 0.5 * (box[:, 1] - box[:, 0])
    x = np.where(np.isfinite(half) & (half > 0.0), half, 1.0)
    v = system.v_radius
    noise = np.abs(system.V0) @ v
    y = np.maximum(noise, 1e-6 * (np.abs(system.C0) @ x))
    y = np.where(y > 0.0, y, 1.0)
    h, F = system.of_h, system.of_F

    def columns(channels: FloatArray, radii: FloatArray, sources: IntArray) -> FloatArray:
        units = np.concatenate([x, v])[sources]
        return np.asarray(channels * radii * units)

    picked = set(design.extended.picked)
    free = np.array([i for i in range(len(y)) if i not in picked], dtype=np.int64)
    L0V = (system.L0 @ system.V0) * v / x[:, None]
    return Scaled(
        x=x,
        v=v,
        y=y[free],
        A0=system.A0 * x / x[:, None],
        W0=system.W0 * v / x[:, None],
        C0=(system.C0 * x / y[:, None])[free],
        T=system.T.mid * x / x[:, None],
        L0V=L0V,
        V=((system.V0 - system.C0 @ (system.L0 @ system.V0)) * v / y[:, None])[free],
        of_h=(columns(h.columns, h.radii, h.sources) / y[:, None])[free],
        of_F=columns(F.columns, F.radii, F.sources) / x[:, None],
        drives_h=np.where(h.sources < N, h.sources, -1),
        drives_F=np.where(F.sources < N, F.sources + N, -1),
        free=free,
    )


@dataclass(frozen=True, eq=False)
class Value:
    """Bounds for a gain: mean, b (2 N,), rho(G) and the spectral radius of the errors."""

    mean: float
    b: FloatArray
    rho: float
    radius: float


class GainSearch:
    """The mean of the bounds with weights (N,), and its gradient, for a share of the deviations."""

    def __init__(self, data: Scaled, weights: FloatArray, kappa: float = 1.0) -> None:
        self.data, self.kappa = data, kappa
        self.weights = np.concatenate([np.zeros(len(data.x)), weights])
        self.targets = np.concatenate([np.full(data.W0.shape[1], -1), data.drives_h, data.drives_F])
        n_v = data.W0.shape[1]
        share = np.full(len(self.targets), kappa)
        share[:n_v] = 1.0
        self.sizes = np.where(self.targets < 0, share, 0.0)
        self.coupling = np.zeros((len(self.targets), 2 * len(data.x)))
        inner = np.flatnonzero(self.targets >= 0)
        self.coupling[inner, self.targets[inner]] = share[inner]
        self.count = 0
        self.numbers = 0.0

    def value(self, point: FloatArray) -> Value:
        """Return the bounds, infinite where there are none."""
        return self._evaluate(point)[0]

    def value_and_gradient(self, point: FloatArray) -> tuple[float, FloatArray]:
        """Return the mean and its gradient; a large number and zero where there is none."""
        found, gradient = self._evaluate(point, gradient=True)
        if gradient is None:
            return INFEASIBLE, np.zeros(point.size)
        return found.mean, gradient.ravel()

    def _evaluate(
        self, point: FloatArray, gradient: bool = False
    ) -> tuple[Value, FloatArray | None]:
        self.count += 1
        data, N = self.data, len(self.data.x)
        Z = point.reshape(N, -1)
        nothing = np.full(2 * N, np.inf)
        if not np.all(np.isfinite(Z)) or np.abs(Z).max(initial=0.0) > 1e12:
            return Value(np.inf, nothing, np.inf, np.inf), None
        M = (np.eye(N) - Z @ data.C0) @ data.T
        closed = M @ data.A0
        radius = spectral_radius(closed)
        if not radius < SLOWEST:
            return Value(np.inf, nothing, np.inf, radius), None
        direct, own = data.L0V + Z @ data.V, Z @ data.of_h
        B = np.hstack([data.W0 - data.A0 @ direct, -data.A0 @ own, data.of_F])
        n_v, n_h = direct.shape[1], own.shape[1]
        MB = M @ B
        Q = np.vstack([data.T @ data.A0, np.eye(N)])
        wanted = min(MOST_STEPS, max(6.0, np.log(HORIZON) / np.log(max(radius, 1e-3)) + N))
        sums = absolute_sums(closed, MB, Q, wanted)
        self.numbers += sums.responses.size
        TB = data.T @ B
        S = sums.total.copy()
        S[:N] += np.abs(TB)
        S[:N, :n_v] += np.abs(data.L0V)
        S[N:, :n_v] += np.abs(direct)
        S[N:, n_v : n_v + n_h] += np.abs(own)
        n, G = S @ self.sizes, S @ self.coupling
        rho = spectral_radius(G)
        if not rho < 1.0:
            return Value(np.inf, nothing, rho, radius), None
        b = np.asarray(np.linalg.solve(np.eye(2 * N) - G, n), dtype=float)
        found = Value(float(self.weights @ b), b, rho, radius)
        if not gradient:
            return found, None
        lam = np.linalg.solve(np.eye(2 * N) - G.T, self.weights)
        bar = np.outer(lam, self.sizes + self.coupling @ b)
        closed_bar, MB_bar = sums.derivative(bar)
        B_bar = M.T @ MB_bar + data.T.T @ (bar[:N] * np.sign(TB))
        M_bar = closed_bar @ data.A0.T + MB_bar @ B.T
        direct_bar = -data.A0.T @ B_bar[:, :n_v] + bar[N:, :n_v] * _sign(direct)
        own_bar = -data.A0.T @ B_bar[:, n_v : n_v + n_h]
        own_bar += bar[N:, n_v : n_v + n_h] * _sign(own)
        Z_bar = direct_bar @ data.V.T + own_bar @ data.of_h.T - M_bar @ (data.C0 @ data.T).T
        return found, Z_bar

    def descend(self, point: FloatArray, steps: int, most: int, share: float = 1.0) -> FloatArray:
        """Return the best point that BFGS meets in so many steps and evaluations."""
        from scipy.optimize import minimize

        best: list[tuple[float, FloatArray]] = [(np.inf, point.ravel())]
        start, unit = self.count, _units(point, share).ravel()

        def evaluate(z: FloatArray) -> tuple[float, FloatArray]:
            if self.count - start >= most:
                raise StopIteration
            mean, gradient = self.value_and_gradient(z * unit)
            if mean < best[0][0]:
                best[0] = (mean, z * unit)
            return mean, gradient * unit

        try:
            with np.errstate(all="ignore"):
                minimize(
                    evaluate,
                    point.ravel() / unit,
                    jac=True,
                    **_options(point.size, steps),
                )
        except StopIteration:
            pass
        return best[0][1].reshape(point.shape)


def _options(size: int, steps: int) -> dict[str, Any]:
    """Return the method of descent: with many gains one that keeps no matrix of their number."""
    if size <= MOST_DENSE:
        return {"method": "BFGS", "options": {"maxiter": steps, "gtol": 1e-10}}
    return {"method": "L-BFGS-B", "options": {"maxiter": steps, "maxcor": 30, "ftol": 1e-9}}


def _units(point: FloatArray, share: float) -> FloatArray:
    """Return the sizes of the entries of a gain, no less than a share of the largest of a row."""
    size = np.abs(point)
    largest = size.max(axis=1, initial=0.0, keepdims=True)
    largest = np.maximum(largest, 1e-6 * max(float(size.max(initial=0.0)), 1e-30))
    return np.asarray(np.maximum(size, share * largest))


def _sign(values: FloatArray) -> FloatArray:
    """Return signs, zero where nothing but rounding is left."""
    small = SMALL * max(float(np.abs(values).max(initial=0.0)), 1e-30)
    return np.where(np.abs(values) > small, np.sign(values), 0.0)


def riccati_starts(data: Scaled) -> Iterator[FloatArray]:
    """Yield steady Kalman gains with the channels as noise of some size."""
    from scipy.linalg import solve_discrete_are

    N = len(data.x)
    AT = data.T @ data.A0
    if not data.free.size:
        yield np.zeros((N, 0))
        return
    for inflation in INFLATIONS:
        for error in ERRORS:

            def reach(drives: IntArray, inflation: float, error: float) -> FloatArray:
                return inflation * np.where(drives >= 0, error, 1.0)

            Q = np.hstack(
                [
                    data.T @ data.W0 - AT @ data.L0V,
                    data.of_F * reach(data.drives_F, inflation, error),
                ]
            )
            R = np.hstack([data.V, data.of_h * reach(data.drives_h, inflation, error)])
            noise = R @ R.T
            floor = max(float(np.trace(noise)) / max(len(noise), 1), 1e-9)
            noise = noise + 1e-5 * floor * np.eye(len(noise))
            C = data.C0 @ data.T
            for least, decay in STARTS:
                # the filter of A / decay leaves errors of A that fall at least so fast
                try:
                    X = solve_discrete_are(AT.T / decay, C.T, Q @ Q.T + least * np.eye(N), noise)
                    Z = X @ C.T @ np.linalg.inv(C @ X @ C.T + noise)
                except (np.linalg.LinAlgError, ValueError):
                    continue
                yield Z
                fast = spectral_radius(AT - Z @ (data.C0 @ AT)) < SLOWEST
                if fast and (least, decay) == STARTS[0]:
                    break


def find_gain(design: GeneralDesign, weights: FloatArray, seed: int = 0) -> FloatArray:
    """Return Z (N, m) for narrow peak bounds, weights (N,) of the errors, or refuse."""
    data = scaled(design)
    m = design.L0.shape[1]
    if not data.free.size:
        return np.zeros_like(design.L0)
    weights = weights * data.x
    total = weights.sum()
    weights = weights / total if total > 0 else np.ones(len(weights)) / len(weights)
    search = GainSearch(data, weights)
    tried = [(search.value(Z), Z) for Z in riccati_starts(data)]
    tried = [(v, Z) for v, Z in tried if np.isfinite(v.radius)]
    per_call = max(search.numbers / max(search.count, 1), 1.0)
    most = int(np.clip(WORK / per_call / 60.0, 40, MOST_EVALUATIONS))
    good = sorted((pair for pair in tried if np.isfinite(pair[0].mean)), key=lambda p: p[0].mean)
    if not good:
        good = [_continued(data, weights, tried, design, most)]
    best = good[0]
    rng = np.random.default_rng(seed)
    idle = 0
    for start, share, moved in SEARCHES:
        if search.count > 3 * most or idle == 3:
            break
        if start >= len(good):
            continue
        near = best[1] if start < 0 else good[start][1]
        near = near * (1.0 + moved * rng.standard_normal(near.shape))
        found = search.descend(near, 200, most, share)
        value = search.value(found)
        idle = 0 if value.mean < best[0].mean * (1.0 - WORTH) else idle + 1
        if value.mean < best[0].mean:
            best = value, found
    return data.deployed(best[1], m)


def _continued(
    data: Scaled,
    weights: FloatArray,
    tried: list[tuple[Value, FloatArray]],
    design: GeneralDesign,
    most: int,
) -> tuple[Value, FloatArray]:
    """Let the deviations grow from where a start holds to what they are."""
    tried = [(v, Z) for v, Z in tried if np.isfinite(v.rho)]
    if not tried:
        raise SolverTrouble(
            "peak bounds: no Riccati gain makes the middle of the Jacobians stable",
            ["give gains to analyse(), or measure another state"],
        )
    value, Z = min(tried, key=lambda pair: pair[0].rho)
    whole = GainSearch(data, weights)
    kappa = min(1.0, 0.9 / value.rho)
    for _ in range(40):
        Z = GainSearch(data, weights, kappa).descend(Z, 80, max(most // 4, 20))
        value = whole.value(Z)
        if value.rho < 1.0:
            return value, Z
        further = min(1.0, 0.98 / value.rho)
        if further <= kappa * 1.002:
            break
        kappa = further
    strongest = _strongest(data, design)
    raise SolverTrouble(
        f"peak bounds: the search ends where {kappa:.3f} of the Jacobian's variation is certified, "
        f"not all of it (spectral radius of the small-gain matrix {value.rho:.3f}); this does not "
        "prove that no gain exists",
        [
            f"the variation comes from {', '.join(strongest)}: narrow their ranges by about "
            f"{1.0 / kappa:.2g}, or measure another state",
        ],
        kappa=kappa,
        symbols=tuple(strongest),
    )


def _strongest(data: Scaled, design: GeneralDesign) -> list[str]:
    """Return the names of the signals on which the Jacobian depends."""
    labels = " ".join(design.family.labels)
    plant = design.extended.plant
    inside = set(labels.replace("(", " ").replace(")", " ").replace(",", " ").split())
    return [s.name for s in (*plant.x, *plant.u, *plant.w) if s.name in inside] or [
        s.name for s in plant.x
    ]
