"""What is proved of the stored numbers, and what the guarantee promises."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from obsynth.derive.rigour import ExactMatrix
from obsynth.designs.core.certificate import Claim, Guarantee
from obsynth.designs.core.method import Numbers
from obsynth.designs.core.record import plain
from obsynth.designs.core.signals import within
from obsynth.designs.general import claims as general
from obsynth.designs.general.model import read_again as general_again
from obsynth.designs.set_membership import synthesis
from obsynth.designs.set_membership.model import SetMembershipModel, read
from obsynth.designs.set_membership.record import SetMembershipDesign
from obsynth.designs.set_membership.step import fault_delay, peak_widths, rates_of

_RTOL = 1e-6


def read_again(design: SetMembershipDesign) -> SetMembershipModel:
    """Enclose the stored equations again around the point of operation."""
    found = None if design.peak is None else general_again(design.peak)
    return SetMembershipModel(design.plant, design.places, found)


def claims(design: SetMembershipDesign) -> Iterator[Claim]:
    """Prove the numbers that the reduction rests on, and the contraction where there is one."""
    off = synthesis.off_identity(design.V, design.W)
    size, exact_off = ExactMatrix.of(design.size), ExactMatrix.of(off)
    grown = size @ exact_off
    room = least(size - grown - ExactMatrix.of(np.abs(design.W)))
    leak = least(ExactMatrix.of(design.leak) - grown)
    regular = off.sum(axis=1).max() < 1.0 and 4.5 * len(off) * design.frame.rounding.max() < 1.0
    yield Claim(
        "frame",
        "size >= |W| (I - |I - V W|)^-1 and leak >= size |I - V W|: columns that are dropped lie "
        "in the box that takes their place",
        bool(room >= 0.0 and leak >= 0.0 and regular),
        min(room, leak),
        "exact rational arithmetic for an enclosed I - V W",
    )
    if design.peak is not None:
        yield from general.claims(design.peak)
    rho = synthesis.radius_bound(synthesis.closed_loop(design))
    if design.contraction < 1.0:
        yield Claim(
            "contraction",
            "the spectral radius of |V^-1 ((I - L C) A)^k V| is below 1, k the calls for which a "
            "generator is kept: what becomes a box fades in the equations at the point of "
            "operation; nothing is said of other points",
            rho <= design.contraction * (1.0 + 1e-9),
            1.0 - rho,
            "max (M v)_i / v_i for a positive v, rounded up",
        )


def least(matrix: ExactMatrix) -> float:
    """Return the least entry."""
    return float(min(entry for row in matrix.to_fractions() for entry in row))


def covers(design: SetMembershipDesign, fresh: SetMembershipModel) -> Iterator[Claim]:
    """Compare what is stored with the stored equations."""
    around = fresh.nearest
    size = np.abs(design.A).max(initial=1.0), np.abs(design.C).max(initial=1.0)
    same = np.allclose(design.A, around.J, rtol=_RTOL, atol=_RTOL * size[0])
    same &= np.allclose(design.C, around.H, rtol=_RTOL, atol=_RTOL * size[1])
    allowed = read(design.plant).followed
    yield Claim(
        "slopes",
        "A and C are slopes of the stored equations at the point of operation, and every fault "
        "that is followed has a rate",
        bool(same) and bool(np.isin(design.places, allowed).all()),
        0.0,
        "comparison with enclosures of the equations around the point; the zonotopes rest on the "
        "equations alone, which the step encloses anew at every call",
    )
    if design.peak is not None and fresh.general is not None:
        yield Claim(
            "plant",
            "the observer with peak bounds is one of the same plant",
            plain(design.peak.plant) == plain(design.plant),
            0.0,
            "comparison",
        )
        yield from general.covers(design.peak, fresh.general)


def numbers(design: SetMembershipDesign) -> Numbers:
    """Return the gain, the size of the bank and what is predicted."""
    performance: dict[str, Any] = {
        "columns": design.columns,
        "zonotopes": 1 + design.zonotopes,
        "contraction": design.contraction,
        "predicted_half_widths": design.predicted,
    }
    widths = None if design.peak is None else peak_widths(design, design.peak)
    return Numbers({"L": design.L}, performance, widths, searched=("predicted_half_widths",))


def guarantee(design: SetMembershipDesign) -> Guarantee:
    """Return what is promised of the intervals, and what has to hold for it."""
    plant = design.plant
    names = ", ".join((*plant.names("x"), *plant.names("f")))
    late = " (faults those of the call before)" if fault_delay(design) else ""
    half = synthesis.declared(plant)
    pairs = zip((*plant.names("x"), *plant.names("f")), design.predicted.tolist(), strict=True)
    listed = [
        f"{name} +-{width:.3g}" + (" (no more than is declared)" if width >= limit else "")
        for (name, width), limit in zip(pairs, half.tolist(), strict=True)
    ]
    once = f", once the sets are narrower than {design.share:g} of the declared ranges"
    begun = once if design.share < 1.0 else ""
    beyond = "beyond the half widths of the peak bounds, " if design.peak is not None else ""
    claims = [
        f"{names} lie inside the returned intervals{late}: the step evaluates the equations over "
        "the sets of the call before, every operation rounded outwards, so that by induction each "
        "set holds every trajectory that the assumptions allow; no gain, linearisation or "
        "prediction enters this",
        f"predicted, {beyond}not promised: half widths of {', '.join(listed)} at the point of "
        f"operation{begun}, with readings in the middle of their noise; where the plant leaves "
        "it, or inputs do not show what has to be seen, they may be wider",
    ]
    still = ", ".join(s.name for s in plant.p if s.constant)
    moving = (*plant.w, *plant.d, *(s for s in plant.p if not s.constant))
    where = within(s for s in moving if s.bounded)
    rates = [
        f"|{s.name}(k+1) - {s.name}(k)| <= {rate:g}"
        for s, rate in zip(plant.f, rates_of(design).tolist(), strict=True)
        if np.isfinite(rate)
    ]
    assumptions = [
        f"the plant is {plant.name} in discrete time with Ts = {plant.Ts:g}",
        "the first state and fault lie in the boxes given to memory0",
        *([f"{where} [monitored in part: status bit 8]"] if where else []),
        *([f"{', '.join(rates)} [monitored in part: status bit 8]"] if rates else []),
        *([f"{still} constant in their intervals"] if still else []),
    ]
    return Guarantee(tuple(claims), tuple(assumptions))
