"""From a stored design to an observer: proofs first, then the step."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive import JacobianBounds, Majorant, Split
from obsynth.designs.core.certificate import Certificate, Claim, Guarantee, Level
from obsynth.designs.core.observer import Observer
from obsynth.designs.core.record import with_header
from obsynth.designs.hinf.claims import decoupling_residual, prove_decoupling, prove_level
from obsynth.designs.hinf.derivation import prove_derivation
from obsynth.designs.hinf.record import METHOD, HinfDesign
from obsynth.designs.hinf.step import build_step, memory_layout
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError


def to_record(design: HinfDesign) -> dict[str, Any]:
    """Return the JSON-able record of a design, with the header that `load` reads."""
    return with_header(METHOD, design.to_record())


def prove(record: Mapping[str, Any], level: Level = "full") -> tuple[Claim, ...]:
    """Prove everything that the guarantee of a stored design rests on."""
    return _prove(HinfDesign.from_record(record), level)


def read_start(record: Mapping[str, Any]) -> Callable[..., FloatArray]:
    """Return what `Observer.memory0` calls, from the stored design alone."""
    return _make_start(HinfDesign.from_record(record))


def _prove(design: HinfDesign, level: Level) -> tuple[Claim, ...]:
    claims = (prove_decoupling(design), *prove_level(design))
    return claims + prove_derivation(design) if level == "full" else claims


def assemble(
    record_or_design: Mapping[str, Any] | HinfDesign,
    level: Level = "lmi",
    derived: tuple[Split, JacobianBounds, Majorant | None] | None = None,
) -> Observer:
    """Prove a design and make its observer."""
    if isinstance(record_or_design, HinfDesign):
        design = record_or_design
    else:
        design = HinfDesign.from_record(record_or_design)
    claims = _prove(design, level)
    if derived is not None:
        claims += prove_derivation(design, *derived)
    certificate = Certificate(claims, to_record(design)).require()
    n, m = len(design.A), len(design.C)
    return Observer(
        method=METHOD,
        model=design.plant,
        step=build_step(design.plant, design.A, design.C, design.gains),
        memory_layout=memory_layout(n, m),
        gains=_gains(design),
        performance=_performance(design),
        half_widths=None,
        certificate=certificate,
        guarantee=_guarantee(design),
        start=_make_start(design),
        fault_delay=1,
    )


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
    least = design.options.get("least_mu")
    if least is not None:
        values["least_mu"] = float(least)
    if design.bound.decay is not None:
        values["decay"] = design.bound.decay
    return values


def _guarantee(design: HinfDesign) -> Guarantee:
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


def _make_start(design: HinfDesign) -> Callable[..., FloatArray]:
    n, m = len(design.A), len(design.C)
    names = design.plant.names("x")

    def start(
        guess: ArrayLike,
        x_range: ArrayLike | None = None,
        f_range: ArrayLike | None = None,
        y0: ArrayLike | None = None,
    ) -> FloatArray:
        """Start at the guess; the boxes and y0 are not needed, as no set is carried along."""
        point = np.asarray(guess, dtype=float)
        if point.shape != (n,) or not np.all(np.isfinite(point)):
            raise ObsynthError(
                f"guess has to be {n} finite numbers ({', '.join(names)}); got {guess!r}"
            )
        layout = memory_layout(n, m)
        memory = np.zeros(layout["initialised"].stop)
        memory[layout["prediction"]] = point
        memory[layout["initialised"]] = 1.0
        return memory

    return start
