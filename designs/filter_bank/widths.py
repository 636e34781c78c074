"""How wide the sets of a bank are in the long run, at most."""

import numpy as np
import sympy as sp

from obsynth.derive import DerivationError, UnboundedError, jacobian_bounds
from obsynth.derive.jacobian.matrix_entries import matrix_entries
from obsynth.derive.jacobian.slope_signs import with_ranges
from obsynth.derive.rigour import substitute
from obsynth.designs.filter_bank.record import BankDesign
from obsynth.symbolic.arrays import FloatArray

# far above the rounding of the sums below
_UP = 1.0 + 1e-9


def steady_half_widths(design: BankDesign) -> FloatArray | None:
    """Return bounds of the half widths of states, then faults, in the limit of many steps.

    None where a slope has no bound over the region, as at a flow sqrt(z) through zero, or where
    the unmeasured states may drive each other apart.

    With slopes |df_i/dx_j| <= s_ij, own slopes of the unmeasured states <= -d_i and speeds at most
    R_i, the envelope of a step is wider than the sets by 2 Ts R_i, so the widths w of the
    unmeasured states settle below (diag(d) - s)^-1 of what the other widths feed in, and the
    interval of a fault below (l (w_y + e_y) + sum_j s_ij e_j) / g with the envelopes e.
    """
    found = _slopes(design)
    if found is None:
        return None
    lower, upper, speed, drift = found
    n, hidden = len(design.plant.x), design.hidden
    slope = np.maximum(np.abs(lower), np.abs(upper))
    width = np.zeros(n)
    magnitude = np.abs(design.region).max(axis=1)
    rounding = 4.0 * design.rounding * magnitude
    for k, i in enumerate(design.outputs.tolist()):
        width[i] = float(design.noise[k, 1] - design.noise[k, 0]) / float(design.scale[k])
        width[i] += rounding[i]
    moved = 2.0 * (design.Ts * speed + rounding)
    if hidden:
        own = -upper[hidden, hidden]
        if np.any(own * design.Ts >= 1.0):
            return None
        coupling = slope[np.ix_(hidden, hidden)].copy()
        np.fill_diagonal(coupling, 0.0)
        others = slope[hidden].copy()
        others[np.arange(len(hidden)), hidden] = 0.0
        fed = others @ (width + moved) + drift[hidden]
        fed += 2.0 * slope[hidden, hidden] * design.Ts * speed[hidden]
        fed += 2.0 * rounding[hidden] / design.Ts
        system = np.diag(own) - coupling
        if np.linalg.eigvals(system).real.min() <= 0.0:
            return None
        width[hidden] = np.linalg.solve(system, fed)
    envelope = width + moved
    faults = []
    rate = float(design.filters[0])
    forgotten = -np.expm1(-rate * design.Ts)
    for i, gain in zip(design.fault_rows.tolist(), design.gain.tolist(), strict=True):
        spread = float(slope[i] @ envelope) + float(drift[i])
        lost = 2.0 * design.rounding * (4.0 * magnitude[i] + design.Ts * speed[i]) / forgotten
        faults.append((rate * (width[i] + envelope[i] + lost) + spread) / gain)
    half: FloatArray = 0.5 * np.concatenate([width, faults]) * _UP
    declared = np.concatenate([np.diff(design.region)[:, 0], np.diff(design.plant.box("f"))[:, 0]])
    return np.minimum(half, 0.5 * declared)


def _slopes(
    design: BankDesign,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray] | None:
    """Return bounds of the Jacobian, of speeds, and of what unknown disturbances span."""
    regional = with_ranges(design.plant, design.region)
    if regional.p or any(not s.measured for s in regional.rho):
        return None
    values = regional.constant_values
    rows = [sp.expand(substitute(row, values)) for row in regional.rhs]
    drift = np.zeros(len(rows))
    for i, row in enumerate(rows):
        for signal in regional.w:
            factor = sp.diff(row, signal.symbol)
            if not factor.is_number:
                return None
            drift[i] += abs(float(factor)) * (signal.upper - signal.lower)
    try:
        jacobian = jacobian_bounds(regional)
        entries = matrix_entries({(i, 0): row for i, row in enumerate(rows)}, regional)
        ranges = entries.ranges(1e-3, "fast", "speed")
    except (UnboundedError, DerivationError):
        return None
    speed = np.zeros(len(rows))
    for position, (i, _) in enumerate(entries.places):
        speed[i] = max(-float(ranges.lower[position]), float(ranges.upper[position]), 0.0)
    if not np.isfinite(speed).all():
        return None
    return jacobian.min, jacobian.max, speed, drift
