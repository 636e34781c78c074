"""What an observer of the method promises, and what it shows of itself."""

from __future__ import annotations

import numpy as np

from obsynth.derive.rigour import exact, nearest
from obsynth.designs.core.certificate import Guarantee
from obsynth.designs.core.method import Numbers
from obsynth.designs.interval.model import LARGEST_SIGNAL
from obsynth.designs.interval.record import IntervalDesign
from obsynth.symbolic import Signal


def numbers(design: IntervalDesign) -> Numbers:
    """Return gains and transformations by the paper's letters, performance, half widths."""
    model, chosen = design.model, design.transformation
    R = nearest(design.prediction.on_r(exact(model.middle)))
    E = chosen.K1 @ np.linalg.inv(chosen.R1) @ chosen.N[:, : model.q].T
    performance = {
        "sum_half_widths": float(design.half_widths.sum()),
        "spectral_radius": design.spectral_radius,
        "vertices": float(len(model.vertices)),
    }
    gains = {"P": design.P, "L": design.L, "R": R, "E": E, **vars(chosen)}
    return Numbers(gains, performance, design.half_widths)


def guarantee(design: IntervalDesign) -> Guarantee:
    """Return what is promised of the intervals, and what has to hold for it."""
    plant = design.plant
    claims = [f"{', '.join(plant.names('x'))} lie inside the returned intervals at every k >= 0"]
    if plant.f:
        faults = ", ".join(plant.names("f"))
        claims.append(f"{faults} of the instant before: inside the intervals at every k >= 1")
    free = (*plant.names("f"), *plant.names("d"))
    if free:
        claims.append(f"for all values of {', '.join(free)}, however fast they change")
    claims.append(f"all of this with the step evaluated in IEEE {design.precision} precision")

    def ranges(*signals: Signal) -> str:
        return ", ".join(f"{s.name} in [{s.lower:g}, {s.upper:g}]" for s in signals)

    watched = [s for s in (*plant.x, *plant.u) if s.name in design.model.scheduled]
    assumptions = [
        f"the plant is {plant.name} in discrete time with Ts = {plant.Ts:g}",
        "the first state lies in the box given to memory0",
    ]
    if plant.rho or plant.p:
        assumptions.append(ranges(*plant.rho, *plant.p))
    if watched:
        assumptions.append(f"{ranges(*watched)} [monitored: status bit 4]")
    if plant.w:
        tail = " [monitored in part: status bit 8]" if design.contraction_rows else ""
        assumptions.append(ranges(*plant.w) + tail)
    assumptions += [
        "the half widths hold in the limit while states and inputs keep to their ranges "
        f"(up to {LARGEST_SIGNAL:g} where none is declared)",
        "after a missing sample the state lies in its declared range once",
        "rounding to nearest; sums are not reordered by the compiler",
    ]
    return Guarantee(tuple(claims), tuple(assumptions))
