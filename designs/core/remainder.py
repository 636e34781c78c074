"""What a remainder adds to every method: its proof, and that the continuous plant is meant."""

from collections.abc import Iterator

import numpy as np

from obsynth.derive.remainder.enclosure import carries_remainder
from obsynth.designs.core.certificate import Claim, Guarantee
from obsynth.symbolic import Plant


def prove_remainder(plant: Plant) -> Iterator[Claim]:
    """Prove that the stored ranges hold what the step leaves out of the continuous plant."""
    if plant.remainder is None:
        return
    wrong = carries_remainder(plant)
    yield Claim(
        "remainder",
        f"what a step of {plant.discretisation} leaves out of the continuous plant lies in the "
        f"ranges of {_names(plant)}",
        not wrong,
        -np.inf if wrong else np.inf,
        wrong or "terms of Taylor's formula over a box that no solution leaves within a step",
    )


def of_continuous(guarantee: Guarantee, plant: Plant) -> Guarantee:
    """Add that a guarantee speaks of the continuous plant, and of which motions within a step."""
    if plant.remainder is None:
        return guarantee
    said = (
        f"states and readings are those of the continuous plant at the instants k Ts, Ts = "
        f"{plant.Ts:g} s: what a step of {plant.discretisation} leaves out is a disturbance "
        f"({_names(plant)})"
    )
    moving = [s.name for s in plant.f if s.rate is not None and not s.constant]
    still = [s.name for k in ("u", "d", "w", "rho") for s in getattr(plant, k)]
    still = [name for name in still if name not in {s.name for s in plant.remainder}]
    still += [s.name for s in plant.f if s.name not in moving]
    within = []
    if still:
        within.append(f"{', '.join(still)} held over every step")
    if moving:
        within.append(
            f"{', '.join(moving)} within range and rate at all times, between the instants too"
        )
    return Guarantee((*guarantee.claims, said), (*guarantee.assumptions, *within))


def _names(plant: Plant) -> str:
    return ", ".join(s.name for s in plant.remainder or ()) or "no disturbance: nothing is left out"
