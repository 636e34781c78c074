"""From a stored design to an observer: proofs first, then ode and step."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.designs.core.certificate import Certificate, Claim, Guarantee, Level
from obsynth.designs.core.observer import Observer
from obsynth.designs.core.record import with_header
from obsynth.designs.filter_bank.claims import assemble_bank, prove_bank, start_bank
from obsynth.designs.filter_bank.model import BankDesign
from obsynth.designs.set_adaptive.claims import prove_design
from obsynth.designs.set_adaptive.equations import memory_layout
from obsynth.designs.set_adaptive.model import Structure
from obsynth.designs.set_adaptive.ode import build_ode
from obsynth.designs.set_adaptive.record import METHOD, SetDesign
from obsynth.designs.set_adaptive.step import build_step, initial_memory
from obsynth.designs.set_adaptive.transition import LARGEST_PRODUCT
from obsynth.designs.starting import read_box, read_vector
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError


def to_record(design: SetDesign) -> dict[str, Any]:
    """Return the JSON-able record of a design, with the header that `load` reads."""
    return with_header(METHOD, design.to_record())


def prove(record: Mapping[str, Any], level: Level = "full") -> tuple[Claim, ...]:
    """Prove everything that the guarantee of a stored design rests on."""
    if record.get("kind") == "bank":
        return prove_bank(BankDesign.from_record(record), level)
    return prove_design(SetDesign.from_record(record), level)


def read_start(record: Mapping[str, Any]) -> Callable[..., FloatArray]:
    """Return what `Observer.memory0` calls, from the stored design alone."""
    if record.get("kind") == "bank":
        return start_bank(BankDesign.from_record(record))
    return _make_start(SetDesign.from_record(record))


def assemble(
    record_or_design: Mapping[str, Any] | SetDesign | BankDesign,
    derived: Structure | None = None,
    level: Level = "lmi",
) -> Observer:
    """Prove a design and make its observer."""
    if isinstance(record_or_design, BankDesign):
        return assemble_bank(record_or_design, level)
    if isinstance(record_or_design, SetDesign):
        design = record_or_design
    elif record_or_design.get("kind") == "bank":
        return assemble_bank(BankDesign.from_record(record_or_design), level)
    else:
        design = SetDesign.from_record(record_or_design)
    claims = prove_design(design, level, derived)
    certificate = Certificate(claims, to_record(design)).require()
    n, q = len(design.plant.x), len(design.plant.f)
    return Observer(
        method=METHOD,
        model=design.plant.discretise("rk4", design.Ts),
        step=build_step(design),
        ode=build_ode(design),
        step_covered=True,
        memory_layout=memory_layout(n, q),
        gains={"L": design.L, "p": design.p, "Gamma": design.Gamma},
        performance=_performance(design),
        half_widths=None,
        certificate=certificate,
        guarantee=_guarantee(design),
        start=_make_start(design),
    )


def _performance(design: SetDesign) -> dict[str, float]:
    fastest = float((-np.diag(design.A_lower - design.L @ design.C)).max())
    settled = design.C @ np.linalg.solve(design.L @ design.C - design.A_upper, design.G)
    shown = settled[design.fault_outputs, np.arange(len(design.Gamma))]
    return {
        "decay": design.alpha,
        "decay_step": design.alpha_step,
        "alpha": design.alpha,
        "adaptation": float((design.Gamma * shown**2).max()),
        "euler_step": 1.0 / fastest,
        "longest_step": LARGEST_PRODUCT / design.mu,
    }


def _make_start(design: SetDesign) -> Callable[..., FloatArray]:
    """Return the function behind `Observer.memory0`."""
    plant = design.plant

    def start(
        guess: ArrayLike,
        x_range: ArrayLike | None = None,
        f_range: ArrayLike | None = None,
        y0: ArrayLike | None = None,
    ) -> FloatArray:
        """Start from boxes of the state and of the constant faults; guess and y0 are not used."""
        names, faults = plant.names("x"), plant.names("f")
        read_vector(guess, "guess", names)
        x_box = read_box(plant.box("x") if x_range is None else x_range, "x_range", names)
        f_box = read_box(plant.box("f") if f_range is None else f_range, "f_range", faults)
        if np.any(x_box[:, 0] < 0.0):
            raise ObsynthError("x_range reaches below zero, which the method excludes")
        return initial_memory(design, x_box, f_box)

    return start


def _guarantee(design: SetDesign) -> Guarantee:
    plant = design.plant
    x, f = ", ".join(plant.names("x")), ", ".join(plant.names("f"))
    where = ", ".join(
        f"{s.name} in [{s.lower:g}, {s.upper:g}]{' ' + s.unit if s.unit else ''}" for s in plant.x
    )
    shown = ", ".join(s.name for s in design.bounds.states)
    if design.law == "cooperative":
        claims = [
            f"{f}, constant, lie in [f_lower, f_upper] at every sample; so a constant fault of "
            "zero is never excluded (no false alarm)",
            f"{x} lie in [x_lower, x_upper] at every sample",
            "after a fault has changed, its interval holds the new value again up to an error "
            f"that decays (rate {design.alpha_step:.3g} per second of the states, then Gamma); "
            "during that time it need not",
            f"the step is exact for the bounding systems: no discretisation error, for every Ts up "
            f"to {LARGEST_PRODUCT / design.mu:.3g} s",
            "the exact solution of ode, fed with y(t) and u(t), gives bounds of the same kind; "
            "what an integration formula leaves out is not covered",
        ]
    else:
        claims = [
            "zeta, Omega and xi stay bounded; neither fault bounds nor state bounds are "
            "guaranteed by the printed law, so infinite ones are returned",
        ]
    assumptions = [
        f"the plant is {plant.name} in continuous time, its inputs held between the samples "
        f"(Ts = {design.Ts:g} s)",
        f"the states stay in {where} at all times [monitored for {shown}: status bit 4; after it "
        "the method starts again from these ranges]",
        "the faults are constant and lie in the box given to memory0",
        f"a fault within {', '.join(f'[{s.lower:g}, {s.upper:g}]' for s in plant.f)} moves the "
        "outputs between the samples",
    ]
    if plant.w:
        noise = ", ".join(
            f"{name} in [{low:g}, {high:g}]"
            for name, (low, high) in zip(plant.names("w"), plant.box("w"), strict=True)
        )
        if design.options["noise"]:
            assumptions.append(f"{noise} [monitored in part: status bit 8]")
        else:
            assumptions.append(f"the disturbances {', '.join(plant.names('w'))} are zero")
    assumptions.append(
        f"the step is evaluated in IEEE {design.precision} precision: the rounding errors of one "
        f"step stay below {design.rounding:.1e} of the size of its terms, which is "
        "added to the bounds"
    )
    return Guarantee(tuple(claims), tuple(assumptions))
