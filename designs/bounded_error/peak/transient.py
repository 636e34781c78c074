"""How the initial error adds to the peak bounds, at every instant, with an exponential tail.

For the Jacobians that occur the error system is linear, so the responses to the
disturbances (within `PeakBound.b`) and to the initial error add up. The latter
is at most beta(k), with beta(0) = |Q| xibar_0 and

    beta(k) = |Q A0^k| xibar_0 + sum_{s<k} |Q A0^(k-1-s) B| coupling beta(s) .

Dividing by lambda^k gives the same recursion for A0 / lambda. If beta is known
for s < N, what remains for k >= N is at most tau + G_lambda times the largest
of the values from N on, with

    G_lambda = lambda^-1 sum_m |Q (A0/lambda)^m B| coupling,
    tau = sup_{k>=N} lambda^-k (|Q A0^k| xibar_0 + sum_{s<N} ...),

so that any c with ``tau + G_lambda c <= c`` and ``c >= lambda^-k beta(k)`` for
0 < k < N makes ``beta(k) <= c lambda^k`` for every k >= 1.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive.rigour import UNIT_ROUNDOFF, Enclosure, add_up, lowered, product_up, raised
from obsynth.designs.bounded_error.peak.bound import PeakBound, channel_inputs
from obsynth.designs.bounded_error.peak.system import PeakSystem, peak_system
from obsynth.designs.core.errors import CertificateError, InfeasibleDesign
from obsynth.designs.general.peak import small_gain_solution, spectral_radius
from obsynth.designs.general.responses import PowerSum, Response, power_sum, response
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

# Room for other orders of summation when the bounds are computed again elsewhere.
SLACK = 2.0**-36
# Products that the tail may cost unless the caller asks for more: some seconds.
MOST_PRODUCTS = 150_000_000


@dataclass(frozen=True, eq=False)
class Transient:
    """Bounds of the part of the errors that stems from the initial error.

    xibar_0: ``|[zeta_0; f_0 - fhat_0]| <= xibar_0``
    beta: bounds at the instants 0, 1, ..., steps - 1
    decay: lambda: the part is at most ``c decay^k`` for every k >= 1

    All bounds are rounded up.
    """

    peak: PeakBound
    xibar_0: FloatArray
    beta: FloatArray
    c: FloatArray
    decay: float

    @property
    def step_decay(self) -> float:
        """The decay for a recursion in doubles: t <- fl(step_decay t) stays above c decay^k."""
        return float(raised(np.array(self.decay), 1))

    def bound(self, k: int) -> FloatArray:
        """Return the bound at the instant k, shape (n_o,)."""
        if k == 0:
            return np.asarray(self.beta[0])
        tail = raised(self.c * self.decay**k, 64)
        return np.minimum(self.beta[k], tail) if k < len(self.beta) else tail

    def half_widths(self, k: int) -> FloatArray:
        """Return the half widths of the errors at the instant k, shape (n + n_f,)."""
        size = len(self.peak.steady)
        return add_up(self.peak.steady, self.bound(k)[:size])

    def check(self) -> float:
        """Compute all again from the data and compare."""
        system = peak_system(**self.peak.system.data)
        beta = _beta(system, self.xibar_0, len(self.beta))
        c = _tail(system, self.xibar_0, beta, self.decay)
        rooms = []
        for name, stored, proved in (("beta", self.beta, beta), ("c", self.c, c)):
            short = ~(proved <= stored)
            if np.any(short):
                where = np.argwhere(short)[0].tolist()
                raise CertificateError(
                    f"peak bounds: {name}{where} = {stored[tuple(where)]:.9g} is not proved",
                    [f"the data give {proved[tuple(where)]:.9g}"],
                    name=name,
                    index=tuple(where),
                )
            rooms.append(float(np.min((stored - proved) / stored)))
        return min(rooms)


def transient(
    peak: PeakBound,
    xibar_0: ArrayLike,
    *,
    steps: int | None = None,
    decay: float | None = None,
) -> Transient:
    """Bound the effect of the initial error."""
    system = peak.system
    size = system.n + system.n_f
    start = np.asarray(xibar_0, dtype=float)
    if start.shape != (size,) or not np.all((start >= 0) & np.isfinite(start)):
        raise ObsynthError(
            f"xibar_0 = {start.tolist()}: {size} numbers are needed, finite and not negative, the "
            "bounds of T (x_0 - xhat_0) and of the initial faults",
            argument="xibar_0",
        )
    trial = _Trial(system)
    slowest = trial.slowest()
    if steps is None:
        affordable = MOST_PRODUCTS // trial.feedback.size
        steps = int(np.clip(np.ceil(3.0 / (1.0 - slowest)), 64, max(affordable, 64)))
    if steps < 2:
        raise ObsynthError(f"steps = {steps}: at least 2 are needed", argument="steps")
    beta = _beta(system, start, steps)
    if decay is None:
        decay = trial.best(slowest, start, beta, peak.b)
    elif not slowest < decay < 1.0:
        raise InfeasibleDesign(
            f"peak bounds: no decay of {decay:.6g} can be guaranteed",
            [f"choose it above {slowest:.6g} and below 1"],
            slowest=slowest,
        )
    c = _tail(system, start, beta, decay)
    return Transient(
        peak=peak,
        xibar_0=start,
        beta=beta * (1.0 + SLACK),
        c=c * (1.0 + SLACK),
        decay=decay,
    )


def _beta(system: PeakSystem, start: FloatArray, steps: int) -> FloatArray:
    """Return beta(0), ..., beta(steps - 1), rounded up."""
    powers = power_sum(system.A0)
    B, coupling = channel_inputs(system)
    n_o, n_i = len(system.outputs), len(coupling)
    free = _free(response(powers, system.outputs, _unit(system)), start, steps)
    forced = response(powers, system.outputs, B)
    terms = np.zeros((steps, n_o, n_i))
    known = min(steps, powers.steps)
    terms[:known] = forced.terms[:known]
    # one row per output, so that each step is one product with the past inputs
    table = np.ascontiguousarray((terms + forced.spread).transpose(1, 0, 2)).reshape(n_o, -1)
    past = np.zeros((steps, n_i))
    beta = np.zeros((steps, n_o))
    beta[0] = product_up(np.abs(system.outputs), start)
    for k in range(1, steps):
        past[steps - k] = product_up(coupling, beta[k - 1])
        value = free[k] + table[:, : k * n_i] @ past[steps - k :].ravel()
        beta[k] = raised(value, k * n_i + 4)
    return beta


def decaying(system: PeakSystem, decay: float) -> tuple[PowerSum, Response, FloatArray]:
    """Return powers and responses of the system divided by powers of a decay, and their gain.

    InfeasibleDesign where the small-gain condition does not hold for the decay.
    """
    if not 0.0 < decay < 1.0:
        raise InfeasibleDesign(f"peak bounds: a decay of {decay:.6g} is none below 1")
    mid = system.A0.mid / decay
    rad = raised((system.A0.rad + 2.0 * UNIT_ROUNDOFF * np.abs(system.A0.mid)) / decay, 4)
    powers = power_sum(Enclosure(mid, rad))
    B, coupling = channel_inputs(system)
    forced = response(powers, system.outputs, B)
    gain = raised(product_up(forced.total, coupling) / decay, 1)
    rho = spectral_radius(gain)
    if not rho < 1.0:
        raise InfeasibleDesign(
            f"peak bounds: no decay of {decay:.6g} can be guaranteed, its small-gain condition has "
            f"spectral radius {rho:.6g}",
            ["choose a slower decay"],
            rho=rho,
        )
    return powers, forced, gain


def _tail(system: PeakSystem, start: FloatArray, beta: FloatArray, decay: float) -> FloatArray:
    """Return c, rounded up."""
    # the tail may begin anywhere: early enough for decay^k to stay a normal number
    steps = int(min(len(beta), max(2.0, 400.0 / -np.log(decay))))
    powers, forced, gain = decaying(system, decay)
    coupling = channel_inputs(system)[1]
    n_i = len(coupling)
    below = lowered(np.cumprod(np.concatenate([[1.0], np.full(steps - 1, decay)])), steps)
    scaled = raised(beta[:steps] / below[:, None], 1)
    inputs = product_up(scaled, np.ascontiguousarray(coupling.T))
    reach = powers.steps
    later = np.zeros((reach, len(system.outputs)))
    for s in range(max(steps - reach, 0), steps):
        first = steps - 1 - s
        later[: reach - first] += forced.terms[first:] @ inputs[s]
    everywhere = forced.spread @ np.sum(inputs, axis=0)
    later = raised((later + everywhere) / decay, 2 * steps + n_i + 8)
    free = _free(response(powers, system.outputs, _unit(system)), start, steps + reach)
    tau = np.max(add_up(free[steps:], later), axis=0)
    c: FloatArray = np.maximum(small_gain_solution(gain, tau), np.max(scaled[1:], axis=0))
    return c


def _unit(system: PeakSystem) -> Enclosure:
    return Enclosure.of(np.eye(system.n + system.n_f))


def _free(response_of_state: Response, start: FloatArray, steps: int) -> FloatArray:
    """Return ``|Q A^k| xibar_0`` for k < steps, rounded up."""
    free = np.zeros((steps, response_of_state.terms.shape[1]))
    known = min(steps, len(response_of_state.terms))
    free[:known] = response_of_state.terms[:known] @ start
    return raised(free + response_of_state.spread @ start, len(start) + 2)


class _Trial:
    """Unrounded responses, for the choice of the decay; what is chosen is proved afterwards."""

    def __init__(self, system: PeakSystem) -> None:
        powers = power_sum(system.A0)
        B, coupling = channel_inputs(system)
        self.spectral_radius = spectral_radius(system.A0.mid)
        self.free = response(powers, system.outputs, _unit(system)).terms
        self.feedback = response(powers, system.outputs, B).terms @ coupling

    def gain(self, decay: float) -> FloatArray:
        """Return G_lambda."""
        weights = decay ** -np.arange(1.0, len(self.feedback) + 1.0)
        return np.asarray(np.tensordot(weights, self.feedback, axes=1))

    def slowest(self) -> float:
        """Return where the spectral radius of G_lambda passes one, or that of A0 if never."""
        low, high = max(self.spectral_radius, 1e-3), 1.0
        for _ in range(40):
            middle = 0.5 * (low + high)
            if spectral_radius(self.gain(middle)) < 1.0:
                high = middle
            else:
                low = middle
        return high

    def best(self, slowest: float, start: FloatArray, beta: FloatArray, scale: FloatArray) -> float:
        """Return the decay with the smallest sum of c / scale times its time constant."""
        steps, reach = len(beta), len(self.feedback)
        later = np.zeros((reach, beta.shape[1]))
        for s in range(max(steps - reach, 0), steps):
            first = steps - 1 - s
            later[: reach - first] += self.feedback[first:] @ beta[s]
        known = max(min(reach - steps, reach), 0)
        later[:known] += self.free[steps : steps + known] @ start
        instants = np.arange(1.0, steps + reach)
        values = np.vstack([beta[1:], later])

        def cost(decay: float) -> float:
            scaled = values * np.exp(-np.log(decay) * instants)[:, None]
            tau = np.max(scaled[steps - 1 :], axis=0)
            c = np.linalg.solve(np.eye(len(tau)) - self.gain(decay), tau)
            c = np.maximum(c, np.max(scaled[: steps - 1], axis=0))
            return float(np.sum(c / scale) * decay / (1.0 - decay))

        candidates = 1.0 - (1.0 - slowest) * np.linspace(0.98, 0.02, 49)
        with np.errstate(over="ignore", invalid="ignore"):
            costs = [cost(decay) for decay in candidates]
        finite = np.where(np.isfinite(costs), costs, np.inf)
        chosen = float(candidates[int(np.argmin(finite))])
        short = float(np.format_float_positional(chosen, precision=7))
        return short if slowest < short < 1.0 else chosen
