"""Gains that minimise the sum of the peak bounds themselves.

The bound is a piecewise smooth function of the gains that is cheap to evaluate,
so it is minimised directly: BFGS with its gradient, which copes with kinks
(A. S. Lewis and M. L. Overton, Nonsmooth optimization via quasi-Newton methods,
Mathematical Programming 141, 2013), from the given gains and from random
neighbours of them, since there are many local minima. What is found is rounded
to few digits and proved by `peak_bound`; nothing rests on the search.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from obsynth.designs.bounded_error.peak.bound import PeakBound, channel_inputs, peak_bound
from obsynth.designs.bounded_error.peak.system import PeakSystem, projected_gains
from obsynth.designs.general.peak import spectral_radius
from obsynth.designs.general.responses import absolute_sums
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

# Responses are followed until they have decayed so far; the bound found is proved afterwards.
HORIZON = 1e-7
MOST_STEPS = 2**15
INFEASIBLE = 1e30
# Relative loss that rounding the gains to fewer digits may cost.
ROUNDING_LOSS = 1e-4


@dataclass(frozen=True, eq=False)
class PeakGain:
    """Gains designed for narrow peak bounds.

    K, F: as to be deployed; ``T K Pi`` and ``F Pi`` up to the last digit
    bound: the proof for these gains
    value: weighted sum of the proved bounds
    start_value: the same for the gains at the start, as computed
    evaluations: how often the bound was evaluated
    """

    K: FloatArray
    F: FloatArray
    bound: PeakBound
    value: float
    start_value: float
    evaluations: int


def peak_gain(
    start: PeakSystem,
    wbar: ArrayLike,
    epsbar: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    rounding: ArrayLike | None = None,
    dbar: ArrayLike | None = None,
    starts: int = 4,
    evaluations: int = 4_000,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> PeakGain:
    """Minimise the weighted sum of the peak bounds over the gains."""
    start = start.with_gains(*projected_gains(start.K, start.F, start.E, start.C))
    bound = peak_bound(start, wbar, epsbar, rounding=rounding, dbar=dbar)
    size = start.n + start.n_f
    weight = np.ones(size) if weights is None else np.asarray(weights, dtype=float)
    if weight.shape != (size,) or not np.all((weight >= 0) & np.isfinite(weight)):
        raise ObsynthError(
            f"weights = {weight.tolist()}: {size} numbers are needed, finite and not negative",
            argument="weights",
        )
    search = _Search(bound, weight)
    origin = search.coordinates(start.K, start.F)
    start_value = search.value(origin)
    best, best_value = origin, start_value
    rng = np.random.default_rng(seed)
    for number in range(starts):
        if number and search.count >= evaluations:
            break
        point = origin if number == 0 else search.neighbour(origin, rng)
        found = search.descend(point)
        value = search.value(found)
        if value < best_value:
            best, best_value = found, value
        if progress is not None:
            progress(min(max((number + 1) / starts, search.count / evaluations), 1.0))
    K, F = search.short_gains(best)
    final = peak_bound(
        start.with_gains(K, F), bound.wbar, bound.epsbar, rounding=bound.rounding, dbar=dbar
    )
    if progress is not None:
        progress(1.0)
    return PeakGain(
        K=K,
        F=F,
        bound=final,
        value=float(weight @ final.steady),
        start_value=start_value,
        evaluations=search.count,
    )


class _Search:
    """The bound in doubles as a function of scaled coordinates of the projected gains."""

    def __init__(self, peak: PeakBound, weights: FloatArray) -> None:
        from scipy.linalg import qr

        system = peak.system
        n, size = system.n, system.n + system.n_f
        self.system, self.n, self.size, self.count = system, n, size, 0
        Pi = np.eye(system.C.shape[0]) + system.C @ system.E
        T = system.T.mid
        q = int(np.linalg.matrix_rank(system.D)) if system.D.size else 0
        # picked columns of T and rows of Pi, not a rotated basis: gains keep their zeros
        self.picked = np.sort(qr(T, pivoting=True)[2][: n - q])
        rows = np.sort(qr(Pi.T, pivoting=True)[2][: Pi.shape[0] - q])
        self.left, self.right = T[:, self.picked], Pi[rows]
        innovation = np.abs(system.C) @ peak.steady[:n] + np.abs(system.W2) @ peak.wbar
        errors = np.concatenate([peak.steady[self.picked], peak.steady[n:]])
        self.scale = np.outer(_positive(errors), 1.0 / _positive(innovation[rows]))
        jacobian = system.constant + np.tensordot(
            system.ranges.mean(axis=1), system.directions, axes=1
        )
        TA = T @ (system.A + jacobian)
        self.open = np.block([[TA, T @ system.B_f], [np.zeros((size - n, n)), np.eye(size - n)]])
        EW2 = system.E @ system.W2
        B_c, self.coupling = channel_inputs(system)
        self.n_w, self.n_c = EW2.shape[1], B_c.mid.shape[1]
        self.inputs = np.zeros((size, self.n_w + self.n_c + size))
        self.inputs[:n, : self.n_w] = TA @ EW2 + T @ system.W1
        self.inputs[:, self.n_w : self.n_w + self.n_c] = B_c.mid
        self.inputs[:, self.n_w + self.n_c :] = np.eye(size)
        self.Pi_W2 = Pi @ system.W2
        self.through = np.abs(system.outputs @ system.D_w.mid) @ peak.wbar
        extra = peak.rounding.copy()
        extra[:n] += system.residual @ peak.dbar
        extra[n:] += peak.epsbar
        self.sizes = np.concatenate([peak.wbar, np.zeros(self.n_c), extra])
        self.weights = np.zeros(len(system.outputs))
        self.weights[:size] = weights

    def coordinates(self, K: FloatArray, F: FloatArray) -> FloatArray:
        """Return the scaled coordinates of gains of the form T K Pi, F Pi."""
        inverse = np.linalg.pinv(self.right)
        theta = np.vstack([np.linalg.pinv(self.left) @ K @ inverse, F @ inverse])
        return np.asarray((theta / self.scale).ravel())

    def gains(self, point: FloatArray, digits: int | None = None) -> tuple[FloatArray, FloatArray]:
        """Return K and F; coordinates to so many digits below their scale if asked."""
        theta = point.reshape(self.scale.shape) * self.scale
        if digits is not None:
            unit = 10.0 ** (np.floor(np.log10(self.scale)) - digits)
            theta = _decimal(theta, unit)
        rows = len(self.picked)
        return self.left @ theta[:rows] @ self.right, theta[rows:] @ self.right

    def value(self, point: FloatArray) -> float:
        """Return the weighted sum of the bounds, `INFEASIBLE` or more where there are none."""
        return self.value_and_gradient(point)[0]

    def value_and_gradient(self, point: FloatArray) -> tuple[float, FloatArray]:
        """Return the weighted sum of the bounds and its gradient; zero where there is none."""
        self.count += 1
        nowhere = np.zeros(point.size)
        K, F = self.gains(point)
        gain = np.vstack([K, F])
        matrix = self.open.copy()
        matrix[:, : self.n] -= gain @ self.system.C
        inputs = self.inputs.copy()
        inputs[:, : self.n_w] -= gain @ self.Pi_W2
        if not np.all(np.isfinite(matrix)):
            return INFEASIBLE * 10, nowhere
        radius = spectral_radius(matrix)
        if not radius < 1.0:
            return INFEASIBLE * (1.0 + radius), nowhere
        wanted = np.log(HORIZON) / np.log(max(radius, 1e-3))
        if wanted > MOST_STEPS:
            return INFEASIBLE * (1.0 + radius), nowhere
        sums = absolute_sums(matrix, inputs, self.system.outputs, wanted)
        channels = slice(self.n_w, self.n_w + self.n_c)
        n = self.through + sums.total @ self.sizes
        G = sums.total[:, channels] @ self.coupling
        rho = spectral_radius(G)
        if not rho < 1.0:
            return INFEASIBLE * (1.0 + min(rho, 1e6)), nowhere
        b = np.linalg.solve(np.eye(len(n)) - G, n)
        # d(w'b) = v' (dn + dG b) with v = (I - G)^-T w, and both are linear in the sums
        v = np.linalg.solve(np.eye(len(n)) - G.T, self.weights)
        driving = self.sizes.copy()
        driving[channels] += self.coupling @ b
        matrix_bar, inputs_bar = sums.derivative(np.outer(v, driving))
        gain_bar = -matrix_bar[:, : self.n] @ self.system.C.T
        gain_bar -= inputs_bar[:, : self.n_w] @ self.Pi_W2.T
        rows = gain_bar @ self.right.T
        theta_bar = np.vstack([self.left.T @ rows[: self.n], rows[self.n :]])
        return float(self.weights @ b), (theta_bar * self.scale).ravel()

    def neighbour(self, origin: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return a random feasible point, nearer and nearer until there is one."""
        for attempt in range(200):
            reach = 0.98**attempt
            factor = rng.uniform(0.3, 3.0, origin.shape)
            moved = origin * factor + rng.normal(size=origin.shape) * 0.1
            point = origin + reach * (moved - origin)
            if self.value(point) < INFEASIBLE:
                return np.asarray(point)
        return origin

    def descend(self, point: FloatArray) -> FloatArray:
        """Return a local minimum."""
        from scipy.optimize import minimize

        with np.errstate(all="ignore"):
            found = minimize(
                self.value_and_gradient, point, jac=True, method="BFGS", options={"maxiter": 200}
            )
        return np.asarray(found.x, dtype=float)

    def short_gains(self, point: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the gains rounded to as few digits as the bound allows."""
        limit = self.value(point) * (1.0 + ROUNDING_LOSS)
        for digits in range(2, 12):
            K, F = self.gains(point, digits)
            if self.value(self.coordinates(K, F)) <= limit:
                return K, F
        return self.gains(point)


def _positive(values: FloatArray) -> FloatArray:
    """Replace what is negligible by the largest, so that it can divide."""
    largest = max(float(np.max(values, initial=0.0)), 1e-300)
    return np.where(values > 1e-12 * largest, values, largest)


def _decimal(values: FloatArray, unit: FloatArray) -> FloatArray:
    """Round to multiples of powers of ten, as the double nearest to the decimal number."""
    decimals = -np.round(np.log10(unit)).astype(int)
    rounded = [
        round(float(value), int(digits))
        for value, digits in zip(values.ravel(), decimals.ravel(), strict=True)
    ]
    return np.array(rounded).reshape(values.shape) + 0.0
