"""Proof that a stored design speaks of the stored equations."""

from __future__ import annotations

import numpy as np

from obsynth.derive import AffineFamily, JacobianBounds, Split, jacobian_bounds, split
from obsynth.designs.bounded_error.record import UioDesign
from obsynth.designs.core.certificate import Claim

# Magnitudes up to which signals without a declared range are covered.
LARGEST_SIGNAL = 1e6


def prove_derivation(
    design: UioDesign, parts: Split | None = None, bounds: JacobianBounds | None = None
) -> tuple[Claim, ...]:
    """Derive split and Jacobian bounds from the stored equations and compare."""
    if parts is None:
        parts = split(design.plant, at=(design.x_at, design.u_at), linear=design.linear)
    if bounds is None:
        bounds = jacobian_bounds(parts)
    names = ("A", "B", "B_f", "C", "D", "W1", "W2")
    same = all(np.array_equal(getattr(design, name), getattr(parts, name)) for name in names)
    lost = _rounding_of_matrices(design, parts)
    allowed = float(design.rounding.min(initial=np.inf))
    return (
        Claim(
            "model",
            "A x + B u + D d + B_f f + W1 w + g equals the stored dynamics, C x + W2 w the outputs",
            bool(same and parts.proof.holds),
            0.0,
            str(parts.proof),
        ),
        Claim(
            "matrix_rounding",
            "what rounding the matrices to doubles moves in one step is below the allowance "
            f"(signals without a range up to {LARGEST_SIGNAL:g})",
            bool(lost <= allowed),
            allowed - lost,
            "bounds of |exact - double| times the boxes",
        ),
        Claim(
            "jacobian",
            "every Jacobian of g over the box lies in the stored family",
            covers(design.family, bounds.family),
            float((bounds.family.ranges - design.family.ranges)[:, 0].min(initial=0.0))
            if design.family.ranges.shape == bounds.family.ranges.shape
            else -np.inf,
            "interval branch and bound with outward rounding; dependences proved symbolically",
        ),
    )


def covers(outer: AffineFamily, inner: AffineFamily) -> bool:
    """Whether one family with the same directions holds another."""
    return outer.covers(inner)


def _rounding_of_matrices(design: UioDesign, parts: Split) -> float:
    """Bound of the error that rounded D, B_f, W1, C, W2 cause in one step of the error."""
    rounding = parts.proof.rounding
    largest = {}
    for kind, names in (("x", ("C",)), ("d", ("D",)), ("f", ("B_f",)), ("w", ("W1", "W2"))):
        box = np.abs(design.plant.box(kind)).max(axis=1, initial=0.0)
        box = np.where(np.isfinite(box), box, LARGEST_SIGNAL)
        for name in names:
            largest[name] = float((rounding[name] @ box).max(initial=0.0))
    gain = float(np.abs(design.gain).sum(axis=1).max(initial=0.0))
    into_output = largest["C"] + largest["W2"]
    state = (1.0 + np.abs(design.E).sum(axis=1).max(initial=0.0)) * (
        largest["D"] + largest["B_f"] + largest["W1"]
    )
    through_E = float(np.abs(design.E).sum(axis=1).max(initial=0.0)) * into_output
    size = float(np.abs(design.A).sum(axis=1).max(initial=1.0))
    return float(state + (gain + size) * into_output + through_E)
