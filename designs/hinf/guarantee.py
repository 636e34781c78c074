"""What an observer of the method promises, and what it shows of itself."""

from __future__ import annotations

import numpy as np

from obsynth.designs.core.certificate import Guarantee
from obsynth.designs.core.method import Numbers
from obsynth.designs.hinf.claims import decoupling_residual
from obsynth.designs.hinf.record import HinfDesign
from obsynth.symbolic.arrays import FloatArray


def numbers(design: HinfDesign) -> Numbers:
    """Return gains and performance; no set is carried along, so there are no half widths."""
    return Numbers(_gains(design), _performance(design))


def _gains(design: HinfDesign) -> dict[str, FloatArray]:
    """Gains by the paper's letters, eqs. (16)-(19), and those of the general filter.

    Z and Y are free only up to what Pi = I - C L (C L)^+ lets through, and are returned
    projected: F = L (C L)^+ + Z, H = (C L)^+ + Y.
    """
    data, gains = design.data, design.gains
    G, C = data.G, data.C
    base = data.standard_filter(gains.K)
    HC = data.H[: data.n_f] @ C
    return {
        "K": gains.K,
        "F": gains.F,
        "H": gains.H,
        "D": gains.D,
        "Z": gains.F - base.F,
        "Y": gains.H - base.H,
        "G": G,
        "Abar": G @ design.A,
        "Bbar": G @ design.B,
        "Lbar": data.L @ data.H,
        "Wbar": G @ design.W,
        "Hbar": HC.T @ HC,
    }


def _performance(design: HinfDesign) -> dict[str, float]:
    values = {
        "l2_gain": design.bound.mu,
        "mu": design.bound.mu,
        "trace_P": float(np.trace(design.bound.P)),
    }
    if design.bound.least_mu is not None:
        values["least_mu"] = design.bound.least_mu
    if design.bound.decay is not None:
        values["decay"] = design.bound.decay
    return values


def guarantee(design: HinfDesign) -> Guarantee:
    """Return what is promised of the fault estimates, and what has to hold for it."""
    plant, bound = design.plant, design.bound
    faults = ", ".join(plant.names("f"))
    noise = ", ".join(plant.names("w"))
    start = "e_0'Pe_0 + s_0'Qs_0" if bound.printed.size else "e_0'Pe_0"
    claims = [
        f"sum_k |f_k - fhat_k|^2 <= mu^2 sum_k |w_k|^2 + {start} over every horizon, with "
        f"mu = {bound.mu:.9g}, f = ({faults}), w = ({noise}) and e = x - xhat",
        f"xhat -> x and fhat -> ({faults}) where w = 0, whatever ({faults}) does",
    ]
    if bound.decay is not None:
        claims.append(f"V+ <= {bound.decay:g} V for V = e'Pe where w = 0")
    if plant.d:
        claims.append(f"whatever {', '.join(plant.names('d'))} does")
    ranges = ", ".join(
        f"{s.name} in [{s.lower:g}, {s.upper:g}]{' ' + s.unit if s.unit else ''}" for s in plant.x
    )
    residual = max(decoupling_residual(design))
    seen = "[monitored: status bit 4, as far as y and xhat show it]"
    inside = "x lies in the box" if design.sector is not None else "x and xhat lie in the box"
    assumptions = [
        f"the plant is {plant.name} in discrete time with Ts = {plant.Ts:g}",
        f"{inside}: {ranges} {seen}",
        *_inputs_assumed(design),
        "every sample arrives (status bit 2); one that is missing counts as a new initial error",
        f"({noise}) has finite energy over the horizon; no bound is used",
        "rounding errors of the step, about 1e-16 of the signals, are not counted as disturbances",
    ]
    if residual > 0.0:
        assumptions.append(
            f"nor is what rounding of F and H leaves of the faults, {residual:.1e} of their size"
        )
    return Guarantee(tuple(claims), tuple(assumptions))


def _inputs_assumed(design: HinfDesign) -> list[str]:
    bounded = [s for s in design.plant.u if np.isfinite([s.lower, s.upper]).any()]
    ranges = ", ".join(f"{s.name} in [{s.lower:g}, {s.upper:g}]" for s in bounded)
    return [f"{ranges} [monitored: status bit 4]"] if bounded else []
