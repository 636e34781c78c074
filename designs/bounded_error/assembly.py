"""From a stored design to an observer: proofs first, then the step."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from obsynth.derive import JacobianBounds, Split
from obsynth.derive.structure.decoupling import decouple
from obsynth.designs.bounded_error.claims import prove_ellipsoid
from obsynth.designs.bounded_error.derivation_proof import prove_derivation
from obsynth.designs.bounded_error.noise import noise_box
from obsynth.designs.bounded_error.peak.design import peak_runtime, peak_start, prove_peak_claims
from obsynth.designs.bounded_error.record import METHOD, EllipsoidBound, UioDesign
from obsynth.designs.bounded_error.runtime import ellipsoid_first, ellipsoid_runtime, make_start
from obsynth.designs.bounded_error.step import RuntimeBound, build_step, memory_layout
from obsynth.designs.core.certificate import Certificate, Claim, Guarantee, Level
from obsynth.designs.core.observer import Observer
from obsynth.designs.core.record import with_header
from obsynth.symbolic.arrays import FloatArray


def to_record(design: UioDesign) -> dict[str, Any]:
    """Return the JSON-able record of a design, with the header that `load` reads."""
    return with_header(METHOD, design.to_record())


def prove(record: Mapping[str, Any], level: Level = "full") -> tuple[Claim, ...]:
    """Prove everything that the guarantee of a stored design rests on."""
    return _prove(UioDesign.from_record(record), level)


def read_start(record: Mapping[str, Any]) -> Callable[..., FloatArray]:
    """Return what `Observer.memory0` calls, from the stored design alone."""
    return _start(UioDesign.from_record(record))


def _start(design: UioDesign) -> Callable[..., FloatArray]:
    ellipsoid = isinstance(design.bound, EllipsoidBound)
    return make_start(design, ellipsoid_first(design) if ellipsoid else peak_start(design))


def _prove(design: UioDesign, level: Level) -> tuple[Claim, ...]:
    claims: tuple[Claim, ...] = (_prove_boxes(design), _prove_decoupling(design))
    if isinstance(design.bound, EllipsoidBound):
        claims += prove_ellipsoid(design)
    else:
        claims += prove_peak_claims(design)
    if level == "full":
        claims += prove_derivation(design)
    return claims


def _prove_boxes(design: UioDesign) -> Claim:
    boxes = noise_box(design.plant)
    w = design.plant.box("w")
    room = np.concatenate(
        [
            w[:, 0] - (design.w_centre - design.w_radius),
            (design.w_centre + design.w_radius) - w[:, 1],
            design.rate - boxes.rate,
        ]
    )
    margin = float(room.min(initial=np.inf))
    return Claim(
        "boxes",
        "the stored boxes hold the declared disturbances and fault rates",
        bool(margin >= 0.0),
        margin,
        "comparison",
    )


def _prove_decoupling(design: UioDesign) -> Claim:
    fresh = decouple(design.C, design.D)
    same = np.array_equal(fresh.E, design.E) and np.array_equal(fresh.T, design.T)
    return Claim(
        "decoupling",
        "(I + E C) D = 0: the unknown input does not enter the error"
        if fresh.residual == 0
        else f"|(I + E C) D| <= {fresh.residual:.1e}: covered by the rounding allowance",
        bool(same and np.array_equal(fresh.Pi, design.Pi)),
        0.0 - fresh.residual,
        "exact rational arithmetic on the stored E, C, D",
    )


def assemble(
    record_or_design: Mapping[str, Any] | UioDesign,
    level: Level = "lmi",
    derived: tuple[Split, JacobianBounds] | None = None,
) -> Observer:
    """Prove a design and make its observer."""
    if isinstance(record_or_design, UioDesign):
        design = record_or_design
    else:
        design = UioDesign.from_record(record_or_design)
    claims = _prove(design, level)
    if derived is not None:
        claims += prove_derivation(design, *derived)
    certificate = Certificate(claims, to_record(design)).require()
    if isinstance(design.bound, EllipsoidBound):
        runtime = ellipsoid_runtime(design)
    else:
        runtime = peak_runtime(design)
    step = build_step(
        design.plant,
        design.C,
        design.W2,
        design.E,
        design.T,
        design.K,
        design.F,
        design.w_centre,
        design.w_radius,
        runtime,
    )
    n, n_f = design.A.shape[0], design.rate.size
    return Observer(
        method=METHOD,
        model=design.plant,
        step=step,
        memory_layout=memory_layout(n, n_f),
        gains=_gains(design),
        performance=_performance(design, runtime),
        half_widths=runtime.steady,
        certificate=certificate,
        guarantee=_guarantee(design),
        start=_start(design),
    )


def _gains(design: UioDesign) -> dict[str, FloatArray]:
    """Gains by the paper's letters, eqs. (10)-(15)."""
    N = design.T @ design.A - design.K @ design.C
    return {
        "K": design.K,
        "F": design.F,
        "E": design.E,
        "T": design.T,
        "N": N,
        "L": design.K - N @ design.E,
        "G": design.T @ design.B,
    }


def _performance(design: UioDesign, runtime: RuntimeBound) -> dict[str, float]:
    values = {"sum_half_widths": float(runtime.steady.sum())}
    bound = design.bound
    if isinstance(bound, EllipsoidBound):
        eigenvalues = np.linalg.eigvalsh(bound.P[0])
        values |= {
            "gamma": float(bound.gamma.min()),
            "decay": float(1.0 - bound.gamma.min()),
            "trace_P_inv": float((1.0 / eigenvalues).sum()),
            "log_det_P": float(np.log(eigenvalues).sum()),
            "lambda_min_P": float(eigenvalues[0]),
            "trace_P": float(eigenvalues.sum()),
        }
    else:
        values["decay"] = bound.decay
    return values


def _guarantee(design: UioDesign) -> Guarantee:
    names = (*design.plant.names("x"), *design.plant.names("f"))
    where = ", ".join(
        f"{s.name} in [{s.lower:g}, {s.upper:g}]{' ' + s.unit if s.unit else ''}"
        for s in design.plant.x
    )
    noise = ", ".join(
        f"{name} in [{low:g}, {high:g}]"
        for name, (low, high) in zip(design.plant.names("w"), design.plant.box("w"), strict=True)
    )
    rates = ", ".join(
        f"|{name}(k+1) - {name}(k)| <= {rate:g}"
        for name, rate in zip(design.plant.names("f"), design.rate, strict=True)
    )
    kind = "ellipsoidal" if isinstance(design.bound, EllipsoidBound) else "peak"
    claims = [
        f"{', '.join(names)} lie inside the returned ({kind}) intervals at every k >= 0",
    ]
    if design.plant.d:
        claims.append(f"whatever {', '.join(design.plant.names('d'))} does")
    assumptions = [
        f"the plant is {design.plant.name} in discrete time with Ts = {design.plant.Ts:g}",
        f"state and estimate stay in the box: {where} [monitored: status bit 4]",
        "the first state and fault lie in the boxes given to memory0",
    ]
    if noise:
        assumptions.append(f"{noise} [monitored in part: status bit 8]")
    if rates:
        assumptions.append(rates)
    largest = float(design.rounding.max(initial=0.0))
    assumptions.append(
        f"the rounding errors of one step stay below {largest:.1e} in every component"
    )
    return Guarantee(tuple(claims), tuple(assumptions))
