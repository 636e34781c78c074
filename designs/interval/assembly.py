"""From a stored design to an observer: proofs first, then the step."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from obsynth.derive.rigour import Exact, exact, nearest
from obsynth.designs.core.certificate import Certificate, Claim, Guarantee, Level
from obsynth.designs.core.observer import Observer
from obsynth.designs.core.record import with_header
from obsynth.designs.interval.claims import prove_design, prove_model
from obsynth.designs.interval.model import LARGEST_SIGNAL, IntervalModel
from obsynth.designs.interval.record import METHOD, IntervalDesign
from obsynth.designs.interval.start import make_start
from obsynth.designs.interval.step import build_step, memory_layout
from obsynth.symbolic.arrays import FloatArray


def to_record(design: IntervalDesign) -> dict[str, Any]:
    """Return the JSON-able record of a design, with the header that `load` reads."""
    return with_header(METHOD, design.to_record())


def prove(record: Mapping[str, Any], level: Level = "full") -> tuple[Claim, ...]:
    """Prove everything that the guarantee of a stored design rests on."""
    return _prove(IntervalDesign.from_record(record), level)


def read_start(record: Mapping[str, Any]) -> Callable[..., FloatArray]:
    """Return what `Observer.memory0` calls, from the stored design alone."""
    return make_start(IntervalDesign.from_record(record))


def _prove(design: IntervalDesign, level: Level) -> tuple[Claim, ...]:
    claims = prove_design(design)
    return (*claims, *prove_model(design)) if level == "full" else claims


def assemble(
    record_or_design: Mapping[str, Any] | IntervalDesign,
    level: Level = "lmi",
    derived: IntervalModel | None = None,
) -> Observer:
    """Prove a design and make its observer."""
    if isinstance(record_or_design, IntervalDesign):
        design = record_or_design
    else:
        design = IntervalDesign.from_record(record_or_design)
    claims = _prove(design, level)
    if derived is not None:
        claims += prove_model(design, derived)
    certificate = Certificate(claims, to_record(design)).require()
    plant = design.model.plant
    return Observer(
        method=METHOD,
        model=plant,
        step=build_step(design),
        memory_layout=memory_layout(len(plant.x), len(design.P), design.n_f),
        gains=_gains(design),
        performance=_performance(design),
        half_widths=design.half_widths,
        certificate=certificate,
        guarantee=_guarantee(design),
        start=make_start(design),
        fault_delay=1,
    )


def _gains(design: IntervalDesign) -> dict[str, FloatArray]:
    """Gains and transformations by the paper's letters."""
    chosen, q = design.chosen, design.model.q
    E = chosen.K1 @ np.linalg.inv(chosen.R1) @ chosen.N[:, :q].T
    middle = exact(design.model.middle)
    letters = {name: getattr(chosen, name) for name in ("H", "R0", "K0", "N", "R1", "K1")}
    R = nearest(design.prediction.on_r(middle))
    return {"P": design.P, "L": design.L, "R": R, "E": E, **letters}


def radius_of(matrix: Exact) -> float:
    """Return the spectral radius of a nonnegative exact matrix, in doubles."""
    return float(np.abs(np.linalg.eigvals(nearest(matrix))).max(initial=0.0))


def _performance(design: IntervalDesign) -> dict[str, float]:
    return {
        "sum_half_widths": float(design.half_widths.sum()),
        "spectral_radius": radius_of(design.width_map.part.E),
        "vertices": float(len(design.model.vertices)),
    }


def _guarantee(design: IntervalDesign) -> Guarantee:
    plant = design.model.plant
    claims = [f"{', '.join(plant.names('x'))} lie inside the returned intervals at every k >= 0"]
    if plant.f:
        faults = ", ".join(plant.names("f"))
        claims.append(f"{faults} of the instant before: inside the intervals at every k >= 1")
    free = (*plant.names("f"), *plant.names("d"))
    if free:
        claims.append(f"for all values of {', '.join(free)}, however fast they change")
    words = {"double": "IEEE double", "single": "IEEE single"}
    claims.append(f"all of this with the step evaluated in {words[design.precision]} precision")
    assumptions = [
        f"the plant is {plant.name} in discrete time with Ts = {plant.Ts:g}",
        "the first state lies in the box given to memory0",
    ]
    loose = (*plant.rho, *plant.p)
    ranges = [f"{s.name} in [{s.lower:g}, {s.upper:g}]" for s in loose]
    if ranges:
        assumptions.append(", ".join(ranges))
    watched = [
        f"{s.name} in [{s.lower:g}, {s.upper:g}]"
        for s in (*plant.x, *plant.u)
        if s.name in design.model.scheduled
    ]
    if watched:
        assumptions.append(f"{', '.join(watched)} [monitored: status bit 4]")
    noise = ", ".join(f"{s.name} in [{s.lower:g}, {s.upper:g}]" for s in plant.w)
    if noise:
        tail = " [monitored in part: status bit 8]" if design.contraction_rows else ""
        assumptions.append(noise + tail)
    assumptions.append(
        "the half widths hold in the limit while states and inputs keep to their ranges "
        f"(up to {LARGEST_SIGNAL:g} where none is declared)"
    )
    assumptions.append("after a missing sample the state lies in its declared range once")
    assumptions.append("rounding to nearest; sums are not reordered by the compiler")
    return Guarantee(tuple(claims), tuple(assumptions))
