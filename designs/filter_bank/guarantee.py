"""What the bank promises, and what it shows of itself."""

from __future__ import annotations

from obsynth.designs.core.certificate import Guarantee
from obsynth.designs.core.method import Numbers
from obsynth.designs.filter_bank.record import BankDesign
from obsynth.designs.filter_bank.widths import steady_half_widths


def numbers(design: BankDesign) -> Numbers:
    """Return the rates of the filters, the slowest as decay, and steady half widths."""
    decay = {"decay": float(design.filters.min())}
    return Numbers({"filters": design.filters}, decay, steady_half_widths(design))


def guarantee(design: BankDesign) -> Guarantee:
    """Return what is promised of the intervals, and what has to hold for it."""
    plant = design.plant
    names = plant.names("x")
    hidden = ", ".join(names[i] for i in design.hidden)
    measured = ", ".join(names[i] for i in design.outputs.tolist())
    first = float(design.filters[0])
    rates = ", ".join(f"{rate:g}" for rate in design.filters.tolist())
    where = ", ".join(
        f"{name} in [{low:g}, {high:g}]"
        for name, (low, high) in zip(names, design.region.tolist(), strict=True)
    )
    sizes = ", ".join(f"{s.name} in [{s.lower:g}, {s.upper:g}]" for s in plant.f)
    noise = ", ".join(
        f"{name} in [{low:g}, {high:g}]"
        for name, (low, high) in zip(plant.names("w"), plant.box("w").tolist(), strict=True)
    )
    claims = [
        f"[f_lower, f_upper] holds the mean of the fault since the start with the weights "
        f"exp(-{first:g} age), age in seconds, at every sample, however the fault moves; not its "
        "present value. A constant fault is its own mean; without fault zero is never excluded",
        f"the memory holds the same for every rate ({rates}), see bank_intervals: an alarm of any "
        "of them is right",
        f"{measured} lie in [x_lower, x_upper] at every sample",
    ]
    if hidden:
        claims.insert(2, f"{hidden} too, whatever the faults do")
    assumptions = [
        f"the plant is {plant.name} in continuous time, its inputs held between the samples "
        f"(Ts = {design.Ts:g} s)",
        f"the states stay in the region {where} at all times [monitored for {measured}: status "
        "bit 4; after it the bank starts again from the region]",
        f"the faults stay in {sizes}",
        "what happens between two samples is enclosed by an envelope whose containment every step "
        "checks; where it fails the bank starts again",
        f"the step is evaluated in IEEE {design.precision} precision: the rounding errors of one "
        f"step stay below {design.rounding:.1e} of the size of its terms, which is "
        "added to the bounds",
    ]
    if noise:
        assumptions.append(f"{noise} [monitored in part: status bit 8]")
    return Guarantee(tuple(claims), tuple(assumptions))
