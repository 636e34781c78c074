"""What an observer of the method promises, and what it shows of itself."""

from __future__ import annotations

import numpy as np

from obsynth.designs.core.certificate import Guarantee
from obsynth.designs.core.method import Numbers
from obsynth.designs.set_adaptive.record import SetDesign
from obsynth.designs.set_adaptive.transition import LARGEST_PRODUCT


def numbers(design: SetDesign) -> Numbers:
    """Return gains and performance; the steady widths are not predicted."""
    gains = {"L": design.L, "p": design.p, "Gamma": design.Gamma}
    return Numbers(gains, _performance(design))


def guarantee(design: SetDesign) -> Guarantee:
    """Return what is promised of the intervals, and what has to hold for it."""
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
        if design.noisy:
            assumptions.append(f"{noise} [monitored in part: status bit 8]")
        else:
            assumptions.append(f"the disturbances {', '.join(plant.names('w'))} are zero")
    assumptions.append(
        f"the step is evaluated in IEEE {design.precision} precision: the rounding errors of one "
        f"step stay below {design.rounding:.1e} of the size of its terms, which is "
        "added to the bounds"
    )
    return Guarantee(tuple(claims), tuple(assumptions))


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
