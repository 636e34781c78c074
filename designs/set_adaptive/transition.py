"""The exact exponential of a Metzler matrix as a sum of nonnegative terms (uniformisation)."""

from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal, localcontext

import casadi as ca
import numpy as np

from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

SHOWN: Mapping[str, float] = {"double": 2.0**-48, "single": 2.0**-21}
"""Above the relative error of a measurement, its conversion into the precision included."""
LARGEST_PRODUCT = 64.0
"""Largest h mu: beyond it the sum has too many terms for one step."""
# What is left out stays below the rounding of the sum itself.
_TAIL = 2.0**-64


@dataclass(frozen=True, eq=False)
class Weights:
    """Weights of the powers of Q = I + M / mu: Poisson probabilities, and tails over mu."""

    h: float
    mu: float
    state: FloatArray
    drive: FloatArray


def uniformisation(h: float, mu: float) -> Weights:
    """Return the weights for a step h and a mu that no diagonal entry of -M exceeds."""
    product = h * mu
    if not 0.0 < product <= LARGEST_PRODUCT:
        raise ObsynthError(
            f"Ts = {h:g} is too long for this observer: its fastest mode is {mu:g} per second, so "
            f"take Ts <= {LARGEST_PRODUCT / mu:.3g}",
            option="Ts",
            largest=LARGEST_PRODUCT / mu,
        )
    chances, tails = _poisson(product)
    kept = next(j for j, tail in enumerate(tails) if tail <= _TAIL) + 1
    return Weights(h, mu, np.array(chances[:kept]), np.array(tails[:kept]) / mu)


def _poisson(mean: float) -> tuple[list[float], list[float]]:
    """Return the probabilities of 0, 1, ... and of more than that, rounded once each."""
    with localcontext() as context:
        context.prec = 50
        exact = Decimal(mean)
        term = (-exact).exp()
        terms = [term]
        while len(terms) <= mean or float(term) > _TAIL * 2.0**-20:
            term = term * exact / len(terms)
            terms.append(term)
        tails = [Decimal(0)] * len(terms)
        for j in range(len(terms) - 1, 0, -1):
            tails[j - 1] = tails[j] + terms[j]
        return [float(term) for term in terms], [float(tail) for tail in tails]


def apply(weights: Weights, M: ca.SX, state: ca.SX, drive: ca.SX) -> ca.SX:
    """Return e^{hM} state + (integral of e^{sM}) drive, (n, c) each, by Horner's scheme."""
    Q = M / weights.mu + ca.SX.eye(M.shape[0])
    result = weights.state[-1] * state + weights.drive[-1] * drive
    for chance, tail in zip(weights.state[-2::-1], weights.drive[-2::-1], strict=True):
        result = Q @ result + chance * state + tail * drive
    moved: ca.SX = ca.densify(result)
    return moved
