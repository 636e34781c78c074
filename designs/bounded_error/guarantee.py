"""What an observer of the method promises, and what it shows of itself."""

from __future__ import annotations

import numpy as np

from obsynth.designs.bounded_error.record import EllipsoidBound, UioDesign
from obsynth.designs.bounded_error.step import running_bound
from obsynth.designs.core.certificate import Guarantee
from obsynth.designs.core.method import Numbers
from obsynth.symbolic.arrays import FloatArray


def numbers(design: UioDesign) -> Numbers:
    """Return gains, performance and steady half widths."""
    widths = running_bound(design).steady
    return Numbers(_gains(design), _performance(design, widths), widths)


def guarantee(design: UioDesign) -> Guarantee:
    """Return what is promised of the intervals, and what has to hold for it."""
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


def _performance(design: UioDesign, widths: FloatArray) -> dict[str, float]:
    values = {"sum_half_widths": float(widths.sum())}
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
