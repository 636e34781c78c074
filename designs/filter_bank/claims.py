"""Proofs for the bank as it is stored, and that it speaks of the stored plant."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from obsynth.designs.core.certificate import Claim, Guarantee
from obsynth.designs.core.method import Numbers
from obsynth.designs.core.signals import within
from obsynth.designs.filter_bank.record import UNKNOWN, BankDesign, BankModel
from obsynth.designs.filter_bank.widths import steady_half_widths


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
    """Return the rates of the filters, the slowest as decay, and steady half widths.

    ``mean_half_widths`` are those of the faults' intervals by filters, (n_f, n_l); any of them may
    be returned.
    """
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
