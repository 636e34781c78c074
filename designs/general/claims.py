"""Proofs for the gains and bounds as they are stored, and that they speak of the stored plant."""

from collections.abc import Iterator

import numpy as np

from obsynth.designs.core.certificate import Claim, Guarantee
from obsynth.designs.core.errors import CertificateError, InfeasibleDesign
from obsynth.designs.core.method import Numbers
from obsynth.designs.general.fading import prove_fading
from obsynth.designs.general.model import GeneralModel, boxes
from obsynth.designs.general.peak import error_sums, prove_peak
from obsynth.designs.general.record import GeneralDesign
from obsynth.designs.general.rounding import prove_rounding
from obsynth.designs.general.step import Limits, curved, steady
from obsynth.designs.general.system import error_system, extra_inputs


def claims(design: GeneralDesign) -> Iterator[Claim]:
    """Prove everything that the guarantee of a stored design rests on."""
    yield _prove_boxes(design)
    yield prove_rounding(design)
    yield from prove_peak_claims(design)


def _prove_boxes(design: GeneralDesign) -> Claim:
    box = design.extended.plant.box("w").reshape(-1, 2)
    room = np.concatenate(
        [
            box[:, 0] - (design.v_centre - design.v_radius),
            (design.v_centre + design.v_radius) - box[:, 1],
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


def prove_peak_claims(design: GeneralDesign) -> Iterator[Claim]:
    """Prove the stored peak bounds from the stored data."""
    b, statement = design.bound.b, "n + G b <= b: the stored b bounds every error at every k"
    system = error_system(design)
    try:
        sums = error_sums(system, extra_inputs(system, design))
        proof = prove_peak(sums, b, design.extended.plant.names("x"))
    except (CertificateError, InfeasibleDesign) as error:
        yield Claim("peak", statement, False, -np.inf, str(error))
        return
    yield Claim(
        "peak",
        statement,
        True,
        float((proof.slack / np.maximum(b, 1e-300)).min()),
        f"sums of {proof.steps} powers with an enclosed remainder of {proof.remainder:.1e}, "
        "all numbers rounded up",
    )
    yield Claim(
        "small_gain",
        "the spectral radius of G is below 1",
        True,
        1.0 - proof.small_gain,
        "max (G v)_i / v_i for a positive v, rounded up",
    )
    yield from prove_fading(system, design.bound.fading)


def covers(design: GeneralDesign, fresh: GeneralModel) -> Iterator[Claim]:
    """Compare the stored family with that derived from the stored equations."""
    centre, radius = boxes(fresh.extended)
    same = (
        np.array_equal(design.L0, fresh.design.L0)
        and np.array_equal(design.v_centre, centre)
        and np.array_equal(design.v_radius, radius)
        and not np.any(design.Z[:, list(fresh.extended.picked)])
    )
    free = ", ".join(fresh.extended.free)
    yield Claim(
        "model",
        f"the rows of the error system do not know {free}, whatever its size"
        if free
        else "the stored numbers are those of the stored equations",
        bool(same),
        0.0,
        "constant directions proved symbolically, L0 in exact arithmetic" if free else "comparison",
    )
    yield Claim(
        "jacobian",
        "every Jacobian of rows and outputs over the box lies in the stored family",
        design.family.covers(fresh.bounds.family),
        design.family.room(fresh.bounds.family),
        "interval branch and bound with outward rounding; dependences proved symbolically",
    )


def numbers(design: GeneralDesign) -> Numbers:
    """Return gains, performance and steady half widths."""
    widths = steady(design)
    finite = widths[np.isfinite(widths)]
    performance = {
        "sum_half_widths": float(finite.sum()),
        "decay": design.bound.fading.decay,
    }
    return Numbers({"L": design.L}, performance, widths)


def guarantee(design: GeneralDesign) -> Guarantee:
    """Return what is promised of the intervals, and what has to hold for it."""
    plant, extended = design.plant, design.extended
    names = (*plant.names("x"), *extended.followed)
    bends = curved(extended.plant)
    where = ", ".join(
        f"{s.name} in [{s.lower:g}, {s.upper:g}]{' ' + s.unit if s.unit else ''}"
        for s, bent in zip(extended.plant.x, bends, strict=True)
        if bent
    )
    inputs = zip(extended.plant.names("w"), extended.plant.box("w").tolist(), strict=True)
    noise = ", ".join(f"{name} in [{low:g}, {high:g}]" for name, (low, high) in inputs)
    claims = [f"{', '.join(names)} lie inside the returned (peak) intervals while this holds"]
    if extended.free:
        claims.append(f"whatever {', '.join(extended.free)} does")
    if design.unfollowed:
        claims.append(
            f"{', '.join(design.unfollowed)} cannot be told from the states by the outputs and "
            "counts as a disturbance within its range: of it the data alone say something"
        )
    assumptions = [
        f"the plant is {plant.name} in discrete time with Ts = {plant.Ts:g}",
        *([f"{where} [monitored in part: status bit 8]"] if where else []),
        "the first state and fault lie in the boxes given to memory0",
    ]
    if noise:
        steps = " (steps of faults per sample)" if extended.followed else ""
        assumptions.append(f"{noise}{steps} [monitored in part: status bit 8]")
    assumptions.append(_on_rounding(design))
    return Guarantee(tuple(claims), tuple(assumptions))


def _on_rounding(design: GeneralDesign) -> str:
    """Say where the rounding of a step is bounded."""
    rounding = design.rounding
    largest = max(float(part.max(initial=0.0)) for part in (rounding.q, rounding.c, rounding.p))
    plant, limits = design.extended.plant, Limits.of(design.extended.plant)
    pairs = zip((*plant.x, *plant.u), np.vstack([limits.x, limits.u]).tolist(), strict=True)
    listed = [f"{s.name} in [{a:g}, {b:g}]" for s, (a, b) in pairs if (a, b) != (s.lower, s.upper)]
    where = f"estimates and inputs with {', '.join(listed)}: there " if listed else ""
    return (
        f"{where}the rounding errors of one step stay below {largest:.1e} in every component, "
        "which is proved for IEEE doubles rounded to nearest"
    )
