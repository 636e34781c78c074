"""What the errors certainly reach: the worst constant Jacobian, with the worst disturbances.

For a constant M of the family the error system is linear and time-invariant,
and its peak under bounded disturbances is the sum of the absolute impulse
responses, which bang-bang disturbances attain. No bound that holds for the
family can be below the largest of these; the distance to `PeakBound` shows what
its small-gain argument may give away at most.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

from obsynth.designs.bounded_error.peak.bound import PeakBound
from obsynth.symbolic.arrays import FloatArray

MOST_FREE = 10
MOST_STEPS = 20_000
NEGLIGIBLE = 1e-12


@dataclass(frozen=True, eq=False)
class Attained:
    """Peaks that the error model reaches.

    peaks: errors of states, then faults, computed without guaranteed rounding
    scheduling: the parameters s of the affine family with which each peak is reached
    steps: length of the disturbance sequences
    """

    peaks: FloatArray
    scheduling: FloatArray
    steps: int


def attained(peak: PeakBound) -> Attained:
    """Compute the peaks at the vertices of the family of Jacobians.

    With more than ten directions only the vertices of the ten that matter most
    in `PeakBound.Hp` are tried and the others stay in the middle, which remains
    a lower bound. Rounding, `radius` and the unknown input are left out.
    """
    system = peak.system
    n, n_f, n_w = system.n, system.n_f, len(peak.wbar)
    schedules = _vertices(peak)
    jacobians = system.constant + np.tensordot(schedules, system.directions, axes=1)
    T = system.T.mid
    EW2 = system.E @ system.W2
    closed = T @ (system.A + jacobians) - system.K @ system.C
    count = len(schedules)
    matrix = np.zeros((count, n + n_f, n + n_f))
    matrix[:, :n, :n] = closed
    matrix[:, :n, n:] = T @ system.B_f
    matrix[:, n:, :n] = -system.F @ system.C
    matrix[:, n:, n:] = np.eye(n_f)
    inputs = np.zeros((count, n + n_f, n_w + n_f))
    # K Pi W2 = K W2 + K C E W2, and the second part is in closed E W2
    inputs[:, :n, :n_w] = closed @ EW2 + T @ system.W1 - system.K @ system.W2
    inputs[:, n:, :n_w] = -system.F @ (system.W2 + system.C @ EW2)
    inputs[:, n:, n_w:] = np.eye(n_f)
    size = np.concatenate([peak.wbar, peak.epsbar])
    total = np.zeros((count, n + n_f))
    total[:, :n] = np.abs(EW2) @ peak.wbar
    steps = 0
    while steps < MOST_STEPS:
        added = np.abs(inputs) @ size
        total += added
        inputs = matrix @ inputs
        steps += 1
        if np.all(added <= NEGLIGIBLE * total):
            break
    worst = np.argmax(total, axis=0)
    return Attained(
        peaks=np.max(total, axis=0) * (1.0 - NEGLIGIBLE), scheduling=schedules[worst], steps=steps
    )


def _vertices(peak: PeakBound) -> FloatArray:
    system = peak.system
    channels = system.channels
    middle = system.ranges.mean(axis=1)
    weight = np.zeros(len(middle))
    np.add.at(weight, channels.source, np.sum(peak.Hp / peak.b[:, None], axis=0) * channels.radii)
    free = np.sort(np.argsort(-weight)[: min(MOST_FREE, np.count_nonzero(weight))])
    corners = np.array(list(product((0, 1), repeat=len(free))), dtype=np.int64)
    schedules = np.tile(middle, (len(corners), 1))
    schedules[:, free] = system.ranges[free, corners]
    return schedules
