"""Proofs for the bank as it is stored, and that it speaks of the stored plant."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from obsynth.designs.core.certificate import Claim
from obsynth.designs.filter_bank.record import UNKNOWN, BankDesign, BankModel


def claims(design: BankDesign) -> Iterator[Claim]:
    """Prove what the guarantee of a stored bank rests on, its signs and gains taken as they are."""
    own = [int(design.signs.x[i, i]) for i in design.hidden]
    slowest = float(design.filters.min())
    same = design.filters.tolist() == list(design.options["filters"])
    yield Claim(
        "falling",
        "the flow of every unmeasured state falls with the state itself",
        all(sign <= 0 for sign in own),
        float(-max(own, default=-1)),
        "signs of slopes",
    )
    yield Claim(
        "filters",
        "the filters are those of the options, each forgets, and its response to a fault is "
        "positive",
        bool(same and slowest > 0.0 and design.gain.min() > 0.0 and design.Ts > 0.0),
        min(slowest, float(design.gain.min())),
        "comparison",
    )


def covers(design: BankDesign, fresh: BankModel) -> Iterator[Claim]:
    """Compare the stored signs, gains and noise with those derived from the stored equations."""
    yield Claim(
        "monotone",
        "every equation is monotone in every unknown signal over the region, with the stored signs",
        all(np.array_equal(design.signs[kind], fresh.signs[kind]) for kind in UNKNOWN),
        0.0,
        "interval branch and bound on slopes; sign(g)|g|^a counts as one increasing function",
    )
    names = ("outputs", "scale", "fault_rows", "gain")
    equal = all(np.array_equal(getattr(design, name), getattr(fresh, name)) for name in names)
    room = np.concatenate(
        [fresh.noise[:, 0] - design.noise[:, 0], design.noise[:, 1] - fresh.noise[:, 1]]
    )
    yield Claim(
        "structure",
        "every fault enters the equation of one measured state, additively and alone; the "
        "stored noise holds the declared one",
        bool(equal and room.min(initial=0.0) >= 0.0),
        float(room.min(initial=0.0)),
        "exact derivatives",
    )
