"""From a model to gains whose bounds are proved to stay bounded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive.rigour import exact, nearest
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.interval.decoupling import Reduced, shaped
from obsynth.designs.interval.gains import (
    lp_gain,
    placed_gains,
    predicted_size,
    refined,
    sylvester_gain,
)
from obsynth.designs.interval.printed import divergence
from obsynth.designs.interval.record import IntervalDesign
from obsynth.designs.interval.widths import steady, steady_holds
from obsynth.symbolic import ObsynthError
from obsynth.symbolic.arrays import FloatArray

STARTS = 3


def with_gains(design: IntervalDesign, P: FloatArray, L: FloatArray) -> IntervalDesign:
    """Return the design with other gains, its steady widths not yet known."""
    return replace(design, P=P, L=L, error=np.zeros(0), width=np.zeros(0))


def complete(design: IntervalDesign) -> IntervalDesign | None:
    """Find the steady widths; None if the bounds diverge or the paper's R is not nonnegative."""
    if design.bound == "paper" and not design.nonnegative:
        return None
    found = steady(design.width_map)
    if found is None or not steady_holds(design.width_map, *found)[0]:
        return None
    return replace(design, error=found[0], width=found[1])


def fitting_gains(
    design: IntervalDesign, P: ArrayLike, L: ArrayLike | None
) -> tuple[FloatArray, FloatArray]:
    """Check given gains; for L = None the linear programme chooses it."""
    m2, n2 = design.decoupled.C2.shape
    P = shaped(P, (n2, n2), "P", option="gains")
    if n2 and np.linalg.matrix_rank(P) < n2:
        raise ObsynthError(f"P has to be regular with shape {(n2, n2)}", option="gains")
    if L is None:
        return P, lp_gain(design.reduced, P)
    return P, shaped(L, (n2, m2), "L", option="gains")


def given_gains(design: IntervalDesign, P: ArrayLike, L: ArrayLike | None) -> IntervalDesign:
    """Complete a design with given P and L."""
    chosen = with_gains(design, *fitting_gains(design, P, L))
    done = complete(chosen)
    if done is None:
        raise divergence(chosen)
    return done


def lp_design(design: IntervalDesign) -> IntervalDesign:
    """Gains by the linear programme for P = I; where that has no solution, by `search_design`."""
    data = design.reduced
    identity = np.eye(data.A.shape[1])
    first = _try(design, identity, _programme(data, identity))
    return search_design(design) if first is None else first


def search_design(design: IntervalDesign) -> IntervalDesign:
    """Gains by a direct search that improves P and L together.

    Starts at the linear programme's gain for P = I and at gains that place real poles; what has
    the smallest steady widths is taken.
    """
    data = design.reduced
    identity = np.eye(data.A.shape[1])
    starts = list(placed_gains(data))
    programme = _programme(data, identity)
    if programme is not None:
        starts.append((identity, programme))
    starts.sort(key=lambda gains: predicted_size(data, *gains))
    tried = [*starts, *((identity, L) for _, L in starts)]
    if len(identity):
        tried += [refined(data, *gains) for gains in starts[:STARTS]]
    done = [d for d in (_try(design, P, L) for P, L in tried) if d is not None]
    if not done:
        gains = tried[0] if tried else (identity, np.zeros((len(identity), len(data.C2))))
        raise divergence(with_gains(design, *gains), "no P was found whose bounds stay bounded")
    return min(done, key=lambda d: float(d.half_widths.sum()))


def _programme(data: Reduced, P: FloatArray) -> FloatArray | None:
    try:
        return lp_gain(data, P)
    except InfeasibleDesign:
        return None


def _try(design: IntervalDesign, P: FloatArray, L: FloatArray | None) -> IntervalDesign | None:
    return None if L is None else complete(with_gains(design, P, L))


def sylvester_design(
    design: IntervalDesign, R: ArrayLike | None, Q: ArrayLike | None
) -> IntervalDesign:
    """Gains by P A2 - R P = Q C2, R nonnegative: given, or the best of several diagonal ones."""
    data = design.reduced
    A2 = nearest(design.decoupled.T2 @ exact(design.nominal) @ design.decoupled.W)
    n2, m2 = len(A2), len(data.C2)
    if R is not None:
        Q = np.ones((n2, m2)) if Q is None else np.array(Q)
        return given_gains(design, *sylvester_gain(A2, data.C2, np.array(R), Q))
    done, last = [], None
    for start in (0.0, 0.1, 0.2, 0.3, 0.5):
        poles = start + 0.1 * np.arange(n2) / max(n2 - 1, 1)
        try:
            P, L = sylvester_gain(A2, data.C2, np.diag(poles), np.ones((n2, m2)))
        except InfeasibleDesign:
            continue
        last = with_gains(design, P, L)
        found = complete(last)
        if found is not None:
            done.append(found)
    if done:
        return min(done, key=lambda d: float(d.half_widths.sum()))
    if last is None:
        raise InfeasibleDesign(
            "P A2 - R P = Q C2 has no regular solution for the R that were tried",
            ['give R= and Q=, or use gains="lp"'],
        )
    raise divergence(last, "the bounds diverge for every R that was tried")
