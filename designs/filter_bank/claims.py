"""From a stored bank to an observer: proofs first, then the step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive import StructureError
from obsynth.designs.core.certificate import Certificate, Claim, Guarantee, Level
from obsynth.designs.core.observer import Observer
from obsynth.designs.core.record import with_header
from obsynth.designs.filter_bank.model import UNKNOWN, BankDesign, read_bank
from obsynth.designs.filter_bank.step import (
    bank_layout,
    build_bank_ode,
    build_bank_step,
    first_memory,
)
from obsynth.designs.filter_bank.widths import steady_half_widths
from obsynth.designs.set_adaptive.record import METHOD
from obsynth.designs.starting import read_box, read_vector
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError


def bank_record(design: BankDesign) -> dict[str, Any]:
    """Return the JSON-able record of a bank, with the header that `load` reads."""
    return with_header(METHOD, design.to_record())


def prove_bank(design: BankDesign, level: Level) -> tuple[Claim, ...]:
    """Prove everything that the guarantee of a bank rests on."""
    own = [int(design.signs["x"][i, i]) for i in design.hidden]
    slowest = float(design.filters.min())
    claims = (
        Claim(
            "falling",
            "the flow of every unmeasured state falls with the state itself",
            all(sign <= 0 for sign in own),
            float(-max(own, default=-1)),
            "signs of slopes",
        ),
        Claim(
            "filters",
            "every filter forgets, and its response to a fault is positive",
            bool(slowest > 0.0 and design.gain.min() > 0.0 and design.Ts > 0.0),
            min(slowest, float(design.gain.min())),
            "comparison",
        ),
    )
    return claims + (_derived(design) if level == "full" else ())


def _derived(design: BankDesign) -> tuple[Claim, ...]:
    try:
        fresh = read_bank(design.plant, design.region, design.Ts, design.filters, design.options)
    except StructureError as error:
        return (Claim("monotone", str(error), False, -np.inf, "derivation"),)
    same = all(np.array_equal(design.signs[kind], fresh.signs[kind]) for kind in UNKNOWN)
    names = ("outputs", "scale", "fault_rows", "gain")
    equal = all(np.array_equal(getattr(design, name), getattr(fresh, name)) for name in names)
    room = np.concatenate(
        [fresh.noise[:, 0] - design.noise[:, 0], design.noise[:, 1] - fresh.noise[:, 1]]
    )
    return (
        Claim(
            "monotone",
            "every equation is monotone in every unknown signal over the region, with the stored "
            "signs",
            same,
            0.0,
            "interval branch and bound on slopes; sign(g)|g|^a counts as one increasing function",
        ),
        Claim(
            "structure",
            "every fault enters the equation of one measured state, additively and alone; the "
            "stored noise holds the declared one",
            bool(equal and room.min(initial=0.0) >= 0.0),
            float(room.min(initial=0.0)),
            "exact derivatives",
        ),
    )


def assemble_bank(design: BankDesign, level: Level) -> Observer:
    """Prove a bank and make its observer."""
    certificate = Certificate(prove_bank(design, level), bank_record(design)).require()
    return Observer(
        method=METHOD,
        model=design.plant.discretise("rk4", design.Ts),
        step=build_bank_step(design),
        ode=build_bank_ode(design),
        step_covered=True,
        memory_layout=bank_layout(design),
        gains={"filters": design.filters},
        performance={"decay": float(design.filters.min())},
        half_widths=steady_half_widths(design),
        certificate=certificate,
        guarantee=_guarantee(design),
        start=start_bank(design),
    )


def start_bank(design: BankDesign) -> Callable[..., FloatArray]:
    """Return what `Observer.memory0` calls."""
    plant = design.plant

    def start(
        guess: ArrayLike,
        x_range: ArrayLike | None = None,
        f_range: ArrayLike | None = None,
        y0: ArrayLike | None = None,
    ) -> FloatArray:
        """Start from a box of the state; guess and y0 are not used, faults have declared ranges."""
        read_vector(guess, "guess", plant.names("x"))
        region = design.region if x_range is None else x_range
        box = read_box(region, "x_range", plant.names("x"))
        inside = np.column_stack(
            [np.maximum(box[:, 0], design.region[:, 0]), np.minimum(box[:, 1], design.region[:, 1])]
        )
        if np.any(inside[:, 0] > inside[:, 1]):
            raise ObsynthError("x_range lies outside of the region of the bank", option="x_range")
        return first_memory(design, inside)

    return start


def _guarantee(design: BankDesign) -> Guarantee:
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
