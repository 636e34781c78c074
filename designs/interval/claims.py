"""Proofs of a stored design, all of them in rational arithmetic."""

from __future__ import annotations

from typing import Any

import numpy as np

from obsynth.derive.forms.quasi_lpv.build import quasi_lpv
from obsynth.derive.rigour import UNIT, Exact, exact, nearest
from obsynth.designs.bounded_error.derivation_proof import covers
from obsynth.designs.core.certificate import Claim
from obsynth.designs.interval.model import IntervalModel, model_of
from obsynth.designs.interval.record import IntervalDesign
from obsynth.designs.interval.rows import Rows
from obsynth.designs.interval.theorem import NEGATIVE
from obsynth.designs.interval.widths import steady_holds

EXACT = "exact rational arithmetic on the stored numbers"


def prove_design(design: IntervalDesign) -> tuple[Claim, ...]:
    """Prove decoupling, stability with the steady widths, and the rounding of the step."""
    claims = [_prove_decoupling(design), _prove_stability(design), _prove_rounding(design)]
    if design.bound == "paper":
        claims.insert(1, _prove_nonnegative(design))
    return tuple(claims)


def _zero(matrix: Exact) -> bool:
    return all(v == 0 for v in matrix.ravel())


def _prove_decoupling(design: IntervalDesign) -> Claim:
    model, plant = design.model, design.plant
    n, q = model.n, model.q
    residuals: tuple[Any, ...] = (
        plant.T2 @ model.F,
        plant.Phi @ model.C + plant.W @ plant.T2 - exact(np.eye(n)),
        plant.F_left @ model.F - exact(np.eye(q)),
        plant.N12 @ model.C - plant.C2 @ plant.T2,
        exact(design.P) @ design.S - exact(np.eye(n - q)),
    )
    return Claim(
        "decoupling",
        "T2 F = 0, Phi C + W T2 = I, F_left F = I, N12 C = C2 T2 and P S = I: whatever the faults "
        "do, they do not enter the bounds of z2",
        all(_zero(matrix) for matrix in residuals),
        0.0,
        EXACT,
    )


def _prove_nonnegative(design: IntervalDesign) -> Claim:
    R = design.prediction.on_r(exact(design.nominal))
    least = float(nearest(R).min(initial=np.inf))
    return Claim(
        "nonnegative",
        "R = P (A2 - L C2) P^-1 is nonnegative (Theorem 1); what rounding leaves below zero is "
        "bounded apart",
        least >= -NEGATIVE,
        least,
        EXACT,
    )


def _prove_stability(design: IntervalDesign) -> Claim:
    holds, room = steady_holds(design.width_map, design.error, design.width)
    form = "at all vertices" if design.bound == "vertex" else "for the comparison matrix"
    return Claim(
        "stability",
        f"the errors of the bounds decay to the stored steady widths from any start, {form}",
        holds,
        room,
        f"{EXACT}: one step maps the stored bound into itself, with room",
    )


def _all_rows(design: IntervalDesign) -> tuple[Rows, ...]:
    contraction = tuple(rows for _, rows in design.contraction_rows)
    own = (design.prediction_rows, design.state_rows, design.share_rows, design.estimate_rows)
    return (*own, *contraction)


def _prove_rounding(design: IntervalDesign) -> Claim:
    unit = exact([UNIT[design.precision]])[0]
    room = np.inf
    for rows in _all_rows(design):
        slack = exact(rows.slack(design.precision))
        for table in (*rows.upper, *rows.lower):
            terms = (table != 0).sum(axis=1)
            for row, widening, radius, count in zip(
                np.abs(table), slack, rows.radius, terms, strict=True
            ):
                need = row * unit * (int(count) + 3) + radius
                left = [w - v for w, v in zip(widening, need, strict=True)]
                room = min(room, float(nearest(np.array([min(left)], dtype=object))[0]))
    return Claim(
        "rounding",
        f"every bound is widened by more than evaluating it in {design.precision} precision can "
        "cost",
        bool(room >= 0.0),
        room,
        f"{EXACT}: (t + 3) u per absolute term of a sum of t products",
    )


def derive_again(design: IntervalDesign) -> IntervalModel:
    """Derive the model from the stored equations."""
    return model_of(quasi_lpv(design.model.plant, prefer=design.options.get("prefer")))


def prove_model(design: IntervalDesign, fresh: IntervalModel | None = None) -> tuple[Claim, ...]:
    """Compare the stored matrices with those derived from the stored equations."""
    if fresh is None:
        fresh = derive_again(design)
    stored = design.model
    same = all(
        getattr(stored, name).shape == getattr(fresh, name).shape
        and _zero(getattr(stored, name) - getattr(fresh, name))
        for name in ("F", "C", "W1", "W2")
    )
    return (
        Claim(
            "model",
            "F, C, W1 and W2 are those of the stored equations",
            bool(same and set(fresh.scheduled) <= set(stored.scheduled)),
            0.0,
            "exact comparison; the quasi-LPV form is proved to be the plant",
        ),
        Claim(
            "vertices",
            f"[A(rho) B(rho) o(rho)] lies in the hull of {len(stored.vertices)} vertices for all "
            "values of the scheduling variables",
            covers(stored.family, fresh.family),
            0.0,
            "ranges by interval branch and bound with outward rounding; affinity proved",
        ),
    )
