"""What the guarantee rests on, proved for the stored numbers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from luenberger.model import LuenbergerModel, read
from luenberger.record import LuenbergerDesign
from luenberger.synthesis import compare
from obsynth.derive.rigour import ExactMatrix
from obsynth.designs.core.certificate import Claim, Guarantee
from obsynth.designs.core.method import Numbers


def read_again(design: LuenbergerDesign) -> LuenbergerModel:
    """Read the stored equations."""
    return read(design.plant)


def claims(design: LuenbergerDesign) -> Iterator[Claim]:
    """Prove N and n for the stored gain, and the peak bound for N and n."""
    room = np.inf
    for stored, L in ((design.closed, design.L), (design.missing, np.zeros_like(design.L))):
        fresh = compare(design.model, L, design.precision)
        room = min(room, float((stored.N - fresh.N).min()), float((stored.n - fresh.n).min()))
    yield Claim(
        "comparison",
        "|e+| <= N |e| + n for every Jacobian, every declared disturbance and rounding",
        room >= 0.0,
        room,
        "enclosures, rounded upwards",
    )
    b, n, N = (
        ExactMatrix.of(v) for v in (design.b[:, None], design.closed.n[:, None], design.closed.N)
    )
    left = [row[0] for row in (b - n - N @ b).to_fractions()]
    yield Claim(
        "peak",
        "N b + n <= b: errors below b stay below b, and all others decay to it",
        min(left) > 0 and bool(design.b.min() > 0.0),
        float(min(left)),
        "exact rational arithmetic",
    )


def covers(design: LuenbergerDesign, fresh: LuenbergerModel) -> Iterator[Claim]:
    """Compare what is stored of the plant with what is derived from its stored equations."""
    stored = design.model
    names = ("A", "C", "W1", "W2")
    held = (fresh.w_centre == stored.w_centre) & (fresh.w_radius <= stored.w_radius)
    yield Claim(
        "model",
        "A, C, W1, W2 are those of the stored equations, the box of the disturbances holds theirs",
        all(np.array_equal(getattr(stored, k), getattr(fresh, k)) for k in names)
        and bool(held.all()),
        0.0,
        "comparison with a new split, which is proved",
    )
    yield Claim(
        "jacobian",
        "every Jacobian of g over the box lies in the stored family",
        stored.family.covers(fresh.family),
        0.0,
        "interval branch and bound with outward rounding",
    )


def guarantee(design: LuenbergerDesign) -> Guarantee:
    """Return what is promised, and what has to hold for it."""
    plant = design.plant
    where = ", ".join(f"{s.name} in [{s.lower:g}, {s.upper:g}]" for s in (*plant.x, *plant.w))
    return Guarantee(
        (f"{', '.join(plant.names('x'))} lie inside the returned intervals at every k >= 0",),
        (
            f"the plant is {plant.name} in discrete time with Ts = {plant.Ts:g}",
            f"{where} [states monitored: status bit 4]",
            "the first state lies in the box given to memory0",
        ),
    )


def numbers(design: LuenbergerDesign) -> Numbers:
    """Return the gain, the decay and the peak bound."""
    radius = float(np.abs(np.linalg.eigvals(design.closed.N)).max())
    return Numbers({"L": design.L}, {"decay": radius}, design.b)
