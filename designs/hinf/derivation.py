"""Proof that a stored design speaks of the stored equations."""

from __future__ import annotations

import numpy as np

from obsynth.derive import JacobianBounds, Majorant, Split, jacobian_bounds, majorant, split
from obsynth.derive.errors import DerivationError
from obsynth.designs.bounded_error.derivation_proof import covers
from obsynth.designs.core.certificate import Claim
from obsynth.designs.hinf.record import HinfDesign
from obsynth.designs.hinf.sector import build_sector, covers_sector, derive_majorant
from obsynth.symbolic.arrays import FloatArray

# Magnitude up to which signals without a declared range are covered.
LARGEST_SIGNAL = 1e6
# What rounding C and L may move in one step, relative to the sizes of the signals.
ALLOWED = 2.0**-40


def prove_derivation(
    design: HinfDesign,
    parts: Split | None = None,
    bounds: JacobianBounds | None = None,
    found: Majorant | None = None,
) -> tuple[Claim, ...]:
    """Derive the split and what bounds g from the stored equations and compare."""
    if parts is None:
        parts = split(design.plant, at=(design.x_at, design.u_at), linear=design.linear)
    L = np.hstack([parts.B_f, parts.D])
    pairs = (
        (design.A, parts.A),
        (design.B, parts.B),
        (design.C, parts.C),
        (design.L, L),
        (design.W, parts.W1),
    )
    same = all(np.array_equal(stored, derived) for stored, derived in pairs)
    same = same and not parts.W2.any()
    rounding = parts.proof.rounding
    held = bool(np.all(design.W_radius >= rounding["W1"]))
    lost, size = _rounding_of_signals(design, rounding)
    claims: tuple[Claim, ...] = (
        Claim(
            "model",
            "A x + B u + L f + W w + g equals the stored dynamics, C x the outputs",
            bool(same and held and parts.proof.holds),
            0.0,
            str(parts.proof),
        ),
        Claim(
            "matrix_rounding",
            f"rounding C and L to doubles moves no signal by more than {ALLOWED:.0e} of its size "
            f"(signals without a range up to {LARGEST_SIGNAL:g})",
            bool(lost <= ALLOWED * size),
            ALLOWED * size - lost,
            "bounds of |exact - double| times the ranges",
        ),
    )
    # The step and the refusal of unstable gains use the vertices in every form.
    claims += (_prove_family(design, parts, bounds),)
    if design.sector is not None:
        claims += (_prove_sector(design, parts, found),)
    return claims


def _prove_family(design: HinfDesign, parts: Split, bounds: JacobianBounds | None) -> Claim:
    bounds = jacobian_bounds(parts) if bounds is None else bounds
    room = -np.inf
    if bounds.family.ranges.shape == design.family.ranges.shape:
        stored, derived = design.family.ranges, bounds.family.ranges
        room = float(
            min(
                (derived - stored)[:, 0].min(initial=0.0), (stored - derived)[:, 1].min(initial=0.0)
            )
        )
    return Claim(
        "jacobian",
        "every Jacobian of g over the box lies in the stored family",
        covers(design.family, bounds.family),
        room,
        "interval branch and bound with outward rounding; dependences proved symbolically",
    )


def _prove_sector(design: HinfDesign, parts: Split, found: Majorant | None) -> Claim:
    options = design.options
    multipliers, given = options["multipliers"], options["majorant"]
    given = None if given is None else tuple(float(v) for v in given)
    holds, room, detail = False, -np.inf, ""
    if found is None:
        try:
            found = derive_majorant(parts, given) if multipliers == "single" else majorant(parts)
        except DerivationError as refusal:
            detail = f"; {refusal}"
    if found is not None and design.sector is not None:
        derived = build_sector(found, multipliers, bool(options["drop_zero_rows"]), given)
        holds, room = covers_sector(design.sector, derived)
        holds = holds and bool(np.all(design.A_radius >= found.rounding))
    return Claim(
        "majorant",
        "g(a) - g(b) lies in the stored sector for all a, b in the box",
        holds,
        room,
        f"interval branch and bound of sum_j (dg_i/dx_j)^2 / R_jj{detail}",
    )


def _rounding_of_signals(
    design: HinfDesign, rounding: dict[str, FloatArray]
) -> tuple[float, float]:
    """Bound what rounding C, B_f and D moves in one step, and the size to compare it with."""
    lost, size = 0.0, 1.0
    for kind, name in (("x", "C"), ("f", "B_f"), ("d", "D")):
        box = np.abs(design.plant.box(kind)).max(axis=1, initial=0.0)
        box = np.where(np.isfinite(box), box, LARGEST_SIGNAL)
        lost += float((rounding[name] @ box).max(initial=0.0))
        size = max(size, float(box.max(initial=0.0)))
    return lost, size
