"""Proofs for the bank as it is stored, and that it speaks of the stored plant."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import sympy as sp

from obsynth.derive import DerivationError, UnboundedError, jacobian_bounds
from obsynth.derive.jacobian.entries import matrix_entries
from obsynth.derive.jacobian.slope_signs import with_ranges
from obsynth.derive.rigour import substitute
from obsynth.designs.core.certificate import Claim, Guarantee
from obsynth.designs.core.guard import Watch
from obsynth.designs.core.method import Numbers
from obsynth.designs.core.signals import within
from obsynth.designs.filter_bank.record import UNKNOWN, BankDesign, BankModel
from obsynth.symbolic.arrays import FloatArray

# far above the rounding of the sums below
_UP = 1.0 + 1e-9


def claims(design: BankDesign) -> Iterator[Claim]:
    """Prove what the guarantee of a stored bank rests on, its signs and gains taken as they are."""
    own = [int(design.signs.x[i, i]) for i in design.hidden]
    slowest = float(design.filters.min())
    slopes = design.signs.f[design.fault_rows, np.arange(len(design.gain))]
    smallest = float((slopes * design.gain).min())
    same = design.filters.tolist() == list(design.options["filters"])
    yield Claim(
        "falling",
        "the flow of every unmeasured state falls with the state itself",
        all(sign <= 0 for sign in own),
        float(-max(own, default=-1)),
        "signs of slopes",
    )
    yield Claim(
        "filters",
        "the filters are those of the options, each forgets, and its response to a fault has the "
        "sign of the slope",
        bool(same and slowest > 0.0 and smallest > 0.0 and design.Ts > 0.0),
        min(slowest, smallest),
        "comparison",
    )


def covers(design: BankDesign, fresh: BankModel) -> Iterator[Claim]:
    """Compare the stored signs, gains and noise with those derived from the stored equations."""
    yield Claim(
        "monotone",
        "every equation is monotone in every unknown signal over the region, with the stored signs",
        all(np.array_equal(design.signs[kind], fresh.signs[kind]) for kind in UNKNOWN),
        0.0,
        "interval branch and bound on slopes; sign(g)|g|^a counts as one increasing function",
    )
    names = ("outputs", "scale", "fault_rows", "gain")
    equal = all(np.array_equal(getattr(design, name), getattr(fresh, name)) for name in names)
    room = np.concatenate(
        [fresh.noise[:, 0] - design.noise[:, 0], design.noise[:, 1] - fresh.noise[:, 1]]
    )
    yield Claim(
        "structure",
        "every fault enters the equation of one measured state, additively and alone; the "
        "stored noise holds the declared one",
        bool(equal and room.min(initial=0.0) >= 0.0),
        float(room.min(initial=0.0)),
        "exact derivatives",
    )


def numbers(design: BankDesign) -> Numbers:
    """Return rates, steady half widths, and those of the faults by filters, `mean_half_widths`."""
    performance: dict[str, Any] = {"decay": float(design.filters.min())}
    found, half = steady_half_widths(design), None
    if found is not None:
        performance["mean_half_widths"] = found[1]
        half = np.concatenate([found[0], found[1].max(axis=1)])
    return Numbers({"filters": design.filters}, performance, half)


def guarantee(design: BankDesign) -> Guarantee:
    """Return what is promised of the intervals, and what has to hold for it."""
    plant = design.plant
    names = plant.names("x")
    hidden = ", ".join(names[i] for i in design.hidden)
    measured = ", ".join(names[i] for i in design.outputs.tolist())
    first = float(design.filters[0])
    rates = ", ".join(f"{rate:g}" for rate in design.filters.tolist())
    claims = [
        f"[f_lower, f_upper] holds a mean of the fault since the sets began, with the weights "
        f"exp(-{first:g} age), age in seconds, at every sample, however the fault moves; not its "
        f"present value. Where zero lies in it, but not in another filter's ({rates}), that one's "
        "is returned, of the mean with its own rate. A constant fault is its own mean; without "
        "fault since the sets began all means are zero, so zero is never excluded",
        f"{measured} lie in [x_lower, x_upper] at every sample",
    ]
    if hidden:
        claims.append(f"{hidden} too, whatever the faults do")
    assumptions = [
        f"the plant is {plant.name} in continuous time, its inputs held between the samples "
        f"(Ts = {design.Ts:g} s)",
        f"the states stay in the region {within(design.assumed.x)} at all times "
        f"[monitored for {measured}: status bit 8]",
        f"the faults stay in {within(plant.f)}",
        "what happens between two samples is enclosed by an envelope whose containment every step "
        "checks; where it fails the bank begins anew",
        f"the step is evaluated in IEEE {design.precision} precision: the rounding errors of one "
        f"step stay below {design.rounding:.1e} of the size of its terms, which is "
        "added to the bounds",
    ]
    if plant.w:
        assumptions.append(f"{within(plant.w)} [monitored in part: status bit 8]")
    return Guarantee(tuple(claims), tuple(assumptions))


def steady_half_widths(design: BankDesign) -> tuple[FloatArray, FloatArray] | None:
    """Return bounds of the half widths of states, (n,), and of faults by filters, (n_f, n_l).

    Of sets that are as old as the horizon: docs/methods/filter_bank.md. None where a slope has no
    bound over the region, or the unmeasured states may drive each other apart.
    """
    found = _slopes(design)
    if found is None:
        return None
    lower, upper, speed, drift = found
    n, hidden, Ts = len(design.plant.x), design.hidden, design.Ts
    slope = np.maximum(np.abs(lower), np.abs(upper))
    width, declared = np.zeros(n), np.diff(design.region)[:, 0]
    magnitude = np.abs(design.region).max(axis=1)
    rounding = 4.0 * design.rounding * magnitude
    for k, i in enumerate(design.outputs.tolist()):
        width[i] = float(design.noise[k, 1] - design.noise[k, 0]) / float(design.scale[k])
        width[i] += rounding[i]
    moved = 2.0 * (Ts * speed + rounding)
    own = -upper[hidden, hidden]
    if np.any(own * Ts >= 1.0):
        return None
    coupling = slope[np.ix_(hidden, hidden)].copy()
    np.fill_diagonal(coupling, 0.0)
    others = slope[hidden].copy()
    others[np.arange(len(hidden)), hidden] = 0.0
    fed = others @ (width + moved) + drift[hidden]
    fed += 2.0 * slope[hidden, hidden] * Ts * speed[hidden]
    fed += 2.0 * rounding[hidden] / Ts
    S = np.diag(own) - coupling
    if hidden and np.linalg.eigvals(S).real.min() <= 0.0:
        return None
    width[hidden] = np.linalg.solve(S, fed)
    even = np.linalg.solve(S, np.ones(len(hidden)))
    excess = even * np.max((declared[hidden] - width[hidden]) / even, initial=0.0)
    envelope, fades = width + moved, np.eye(len(hidden)) - Ts * S
    calls = Watch.of(design.options).calls
    faults = np.zeros((len(design.gain), len(design.filters)))
    for j, (i, gain) in enumerate(zip(design.fault_rows.tolist(), design.gain, strict=True)):
        for k, rate in enumerate(design.filters.tolist()):
            decay, gathered = np.exp(-rate * Ts), -np.expm1(-rate * Ts) / rate
            lost = 2.0 * design.rounding * (4.0 * magnitude[i] + Ts * speed[i]) / (rate * gathered)
            drive = float(slope[i] @ envelope) + float(drift[i]) + rate * float(envelope[i])
            # what the unmeasured states exceed, the width of the filter, one
            step = np.eye(len(hidden) + 2)
            step[:-2, :-2] = fades
            step[-2] = [*(gathered * slope[i, hidden]), decay, gathered * drive]
            ended = np.linalg.matrix_power(step, calls) @ [*excess, declared[i], 1.0]
            response = abs(float(gain)) * -np.expm1(-rate * Ts * calls) / rate
            faults[j, k] = (width[i] + lost + ended[-2]) / response
    width[hidden] += np.linalg.matrix_power(fades, calls) @ excess
    range_f = np.diff(design.plant.box("f"))
    return (
        0.5 * np.minimum(width * _UP, declared),
        0.5 * np.minimum(faults * _UP, range_f),
    )


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
