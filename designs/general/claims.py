"""Proofs for the gains and bounds as they are stored, and that they speak of the stored plant."""

from collections.abc import Iterator
from itertools import compress

import numpy as np

from obsynth.derive.structure.following import NO_RATE, untold
from obsynth.designs.core import signals
from obsynth.designs.core.certificate import Claim, Guarantee
from obsynth.designs.core.equations import curved_states
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.core.method import Numbers
from obsynth.designs.general.fading import prove_fading
from obsynth.designs.general.lmis import error_loop
from obsynth.designs.general.model import GeneralModel, boxes
from obsynth.designs.general.peak import error_sums, prove_peak
from obsynth.designs.general.record import EllipsoidBound, EnergyBound, GeneralDesign, PeakBound
from obsynth.designs.general.rounding import prove_rounding
from obsynth.designs.general.step import steady
from obsynth.designs.general.storage import prove_storage
from obsynth.designs.general.system import error_system, extra_inputs

LOST = "no gain was found that follows it"


def claims(design: GeneralDesign) -> Iterator[Claim]:
    """Prove everything that the guarantee of a stored design rests on."""
    box = design.extended.plant.box("w").reshape(-1, 2)
    yield signals.prove_boxes(signals.DECLARED, box, design.v_centre, design.v_radius)
    yield prove_rounding(design)
    yield from prove_storage(design)
    if design.peak is not None:
        yield from prove_bound(design, design.peak)


def prove_bound(design: GeneralDesign, bound: PeakBound) -> Iterator[Claim]:
    """Prove the stored peak bounds from the stored data."""
    system = error_system(design)
    try:
        sums = error_sums(system, extra_inputs(system, design))
    except InfeasibleDesign as error:
        yield Claim("peak", "the responses of the errors can be summed", False, -np.inf, str(error))
        return
    yield from prove_peak(sums, bound.b, design.extended.plant.names("x"))
    yield from prove_fading(system, bound.fading)


def covers(design: GeneralDesign, fresh: GeneralModel) -> Iterator[Claim]:
    """Compare the stored family with that derived from the stored equations."""
    centre, radius = boxes(fresh.extended)
    same = (
        np.array_equal(design.L0, fresh.design.L0)
        and np.array_equal(design.v_centre, centre)
        and np.array_equal(design.v_radius, radius)
        and not np.any(design.Z[:, list(fresh.extended.picked)])
    )
    free = ", ".join(fresh.extended.free)
    yield Claim(
        "model",
        f"the rows of the error system do not know {free}, whatever its size"
        if free
        else "the stored numbers are those of the stored equations",
        bool(same),
        0.0,
        "constant directions proved symbolically, L0 in exact arithmetic" if free else "comparison",
    )
    yield signals.covers_jacobian("rows and outputs", design.family, fresh.bounds.family)


def numbers(design: GeneralDesign) -> Numbers:
    """Return gains, performance and steady half widths."""
    bound, gains, n = design.bound, {"L": design.L}, len(design.plant.x)
    if np.any(design.K):
        gains |= {"K": design.K[:n], "F": design.K[n:]}
    if isinstance(bound, EnergyBound):
        levels = {"l2_gain": bound.mu, "mu": bound.mu, "attained_gain": bound.attained}
        return Numbers(gains, levels, searched=("attained_gain",))
    widths = steady(design)
    finite = widths[np.isfinite(widths)]
    performance = {"sum_half_widths": float(finite.sum())}
    if isinstance(bound, PeakBound):
        performance["decay"] = bound.fading.decay
    else:
        performance |= {"gamma": bound.gamma, "decay": 1.0 - bound.gamma}
    return Numbers(gains, performance, widths)


def guarantee(design: GeneralDesign) -> Guarantee:
    """Return what is promised of the intervals, and what has to hold for it."""
    plant, extended = design.plant, design.extended
    names = (*plant.names("x"), *extended.followed)
    where = signals.within(
        compress(extended.plant.x, curved_states(extended.plant, noise=True)), units=True
    )
    noise = signals.within(extended.plant.w)
    bound = design.bound
    if isinstance(bound, EnergyBound):
        claims = [*_energy_claims(design, bound)]
    else:
        words = {EllipsoidBound: "ellipsoidal", PeakBound: "peak"}
        kind = " and ".join(words[type(part)] for part in design.bounds)
        claims = [f"{', '.join(names)} lie inside the returned ({kind}) intervals while this holds"]
    if extended.free:
        claims.append(f"whatever {', '.join(extended.free)} does")
    claims += _on_faults(design)
    assumptions = [
        f"the plant is {plant.name} in discrete time with Ts = {plant.Ts:g}",
        *([f"{where} [monitored in part: status bit 8]"] if where else []),
        "the first state and fault lie in the boxes given to memory0",
    ]
    if isinstance(bound, EnergyBound):
        assumptions.append(
            "every reading arrives (status bit 32); one that is missing counts as a new initial "
            "error, and rounding errors of the step are not counted as disturbances"
        )
    if noise:
        steps = " (steps of faults per sample)" if extended.followed else ""
        assumptions.append(f"{noise}{steps} [monitored in part: status bit 8]")
    assumptions.append(_on_rounding(design))
    return Guarantee(tuple(claims), tuple(assumptions))


def _on_faults(design: GeneralDesign) -> Iterator[str]:
    """Say what is made of every fault, and why; see `follow`."""
    plant, extended, asked = design.plant, design.extended, design.options.get("faults")
    reason = f'as faults="{asked}" asks' if asked in ("divided", "bounded") else ""
    for s in plant.f:
        if s.name in extended.followed:
            moves = "constant" if s.constant else f"by {s.rate:g} per sample at most"
            yield f"{s.name} is followed as a state, {moves}: the outputs tell it from the others"
    moving = [s.name for s in plant.f if s.rate is not None or s.constant]
    for name in design.divided:
        why = LOST if name in moving else NO_RATE
        yield (
            f"{name} of the call before is what moved the states, divided by its gain: it lies "
            f"inside the returned interval too; {reason or why}"
        )
    again = [name for name in design.unfollowed if name in moving and not reason]
    told = untold(extended, design.middle, again) if again else {}
    for name in design.unfollowed:
        why = told.get(name, LOST) if name in moving else NO_RATE
        yield (
            f"{name} counts as a disturbance within its range, of which the data alone say "
            f"something; {reason or why}"
        )


def _energy_claims(design: GeneralDesign, bound: EnergyBound) -> Iterator[str]:
    """Say what an energy gain promises, in the user's names."""
    states, v = design.extended.plant.x, design.extended.plant.names("w")
    loop = error_loop(error_system(design))
    parts = [
        f"{weight:.6g} ({s.name} - {s.name}hat)"
        for s, weight in zip(states, bound.weights.tolist(), strict=True)
        if weight
    ]
    at_k, next_k = (
        ", ".join(f"{v[i]} / {design.v_radius[i]:.6g}" for i in which)
        for which in (loop.before, loop.after)
    )
    yield (
        f"sum_k |z_k|^2 <= mu^2 sum_k (|a_k|^2 + |b_(k+1)|^2) + e_0'Pe_0 over every horizon with "
        f"mu = {bound.mu:.9g}, z = ({', '.join(parts)}), a = ({at_k}), b = ({next_k}), these about "
        "their middles, e the errors after a reading is used; what stands in both counts twice"
    )


def _on_rounding(design: GeneralDesign) -> str:
    """Say where the rounding of a step is bounded."""
    rounding = design.rounding
    largest = max(float(part.max(initial=0.0)) for part in (rounding.q, rounding.c, rounding.p))
    plant = design.extended.plant
    listed = signals.beyond((*plant.x, *plant.u), np.concatenate(design.limits))
    where = f"estimates and inputs with {listed}: there " if listed else ""
    return (
        f"{where}the rounding errors of one step stay below {largest:.1e} in every component, "
        f"which is proved for {signals.IEEE[design.precision]} rounded to nearest"
    )
