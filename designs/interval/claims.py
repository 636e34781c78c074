"""Proofs of a stored design, all of them in rational arithmetic."""

from collections.abc import Iterator

import numpy as np

from obsynth.derive.rigour import UNIT, exact, nearest
from obsynth.designs.core.certificate import Claim, Guarantee
from obsynth.designs.core.guard import Watch
from obsynth.designs.core.method import Numbers
from obsynth.designs.core.signals import LARGEST_SIGNAL, within
from obsynth.designs.interval.model import IntervalModel
from obsynth.designs.interval.record import IntervalDesign
from obsynth.designs.interval.rows import Rows
from obsynth.designs.interval.widths import steady_holds

IN_PART = "monitored in part: status bit 8"
EXACT = "exact rational arithmetic on the stored numbers"


def claims(design: IntervalDesign) -> Iterator[Claim]:
    """Prove decoupling, stability with the steady widths, and the rounding of the step."""
    yield _prove_decoupling(design)
    if design.bound == "paper":
        yield _prove_nonnegative(design)
    yield _prove_stability(design)
    yield _prove_rounding(design)


def _prove_decoupling(design: IntervalDesign) -> Claim:
    model, free, S = design.model, design.decoupled, design.S
    residuals = (
        free.T2 @ model.F,
        free.Phi @ model.C + free.W @ free.T2 - exact(np.eye(model.n)),
        free.F_left @ model.F - exact(np.eye(model.q)),
        free.N12 @ model.C - free.C2 @ free.T2,
        exact(design.P) @ S - exact(np.eye(len(S))),
    )
    return Claim(
        "decoupling",
        "T2 F = 0, Phi C + W T2 = I, F_left F = I, N12 C = C2 T2 and P S = I: whatever the faults "
        "do, they do not enter the bounds of z2",
        not any(np.any(matrix != 0) for matrix in residuals),
        0.0,
        EXACT,
    )


def _prove_nonnegative(design: IntervalDesign) -> Claim:
    return Claim(
        "nonnegative",
        "R = P (A2 - L C2) P^-1 is nonnegative (Theorem 1); what rounding leaves below zero is "
        "bounded apart",
        design.nonnegative,
        design.least_entry,
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
    moving = (design.prediction_rows, design.share_rows)
    return (design.first_rows, *moving, design.state_rows, design.estimate_rows, *contraction)


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


def covers(design: IntervalDesign, fresh: IntervalModel) -> Iterator[Claim]:
    """Compare the stored matrices with those derived from the stored equations."""
    stored = design.model
    same = all(
        np.array_equal(getattr(stored, name), getattr(fresh, name))
        for name in ("F", "C", "W1", "W2")
    )
    yield Claim(
        "model",
        "F, C, W1 and W2 are those of the stored equations",
        bool(same and fresh.scheduled == stored.scheduled),
        0.0,
        "exact comparison; the quasi-LPV form is proved to be the plant",
    )
    yield Claim(
        "vertices",
        f"[A(rho) B(rho) o(rho)] lies in the hull of {len(stored.vertices)} vertices for all "
        "values of the scheduling variables",
        stored.family.covers(fresh.family),
        0.0,
        "ranges by interval branch and bound with outward rounding; affinity proved",
    )


def numbers(design: IntervalDesign) -> Numbers:
    """Return gains and transformations by the paper's letters, performance, half widths."""
    model, chosen = design.model, design.transformation
    R = nearest(design.prediction.on_r(exact(model.middle)))
    E = chosen.K1 @ np.linalg.inv(chosen.R1) @ chosen.N[:, : model.q].T
    performance = {
        "sum_half_widths": float(design.half_widths.sum()),
        "spectral_radius": design.spectral_radius,
        "vertices": float(len(model.vertices)),
    }
    gains = {"P": design.P, "L": design.L, "R": R, "E": E, **vars(chosen)}
    return Numbers(gains, performance, design.half_widths)


def guarantee(design: IntervalDesign) -> Guarantee:
    """Return what is promised of the intervals, and what has to hold for it."""
    plant, claims = design.plant, []
    if plant.f:
        claims.append(f"{', '.join(plant.names('f'))}: of the instant before, from k = 1 on")
    free = (*(s.name for s in plant.f if not s.bounded), *plant.names("d"))
    if free:
        claims.append(f"for all values of {', '.join(free)}, however fast they change")
    claims.append(f"all of this with the step evaluated in IEEE {design.precision} precision")
    watched = [s for s in plant.x if s.name in design.model.scheduled]
    held = [s for s in plant.u if s.name in design.model.scheduled]
    assumptions = [
        f"the plant is {plant.name} in discrete time with Ts = {plant.Ts:g}",
        "the first state lies in the box given to memory0",
    ]
    if plant.rho or plant.p:
        assumptions.append(within((*plant.rho, *plant.p)))
    bounded = [s for s in plant.f if s.bounded]
    if held:
        assumptions.append(f"{within(held)} [monitored: status bit 4]")
    assumptions += [f"{within(some)} [{IN_PART}]" for some in (watched, bounded, plant.w) if some]
    slow = [(s.name, 0.0 if s.constant else s.rate) for s in plant.f]
    moves = ", ".join(f"{name} by {rate:g}" for name, rate in slow if rate is not None)
    if moves and "rates" in Watch.of(design.options).cuts:
        assumptions.append(f"from call to call {moves} at most [{IN_PART}]")
    assumptions += [
        "the half widths hold in the limit while states and inputs keep to their ranges "
        f"(up to {LARGEST_SIGNAL:g} where none is declared)",
        "rounding to nearest; sums are not reordered by the compiler",
    ]
    return Guarantee(tuple(claims), tuple(assumptions))
