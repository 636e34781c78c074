"""One printed claim beside what is found."""

from collections.abc import Sequence
from dataclasses import dataclass

from obsynth.symbolic.table import Table


@dataclass(frozen=True)
class Claim:
    """What a paper prints at some place, what is computed in its stead, and whether it holds."""

    place: str
    printed: str
    found: str
    holds: bool


def claims_table(title: str, claims: Sequence[Claim]) -> Table:
    """Tabulate claims; those that do not hold are set in bold."""
    rows = [[c.place, c.printed, c.found, bool(c.holds)] for c in claims]
    wrong = [i for i, claim in enumerate(claims) if not claim.holds]
    note = f"{len(claims) - len(wrong)} of {len(claims)} hold."
    return Table(title, ["place", "in print", "found", "holds"], rows, note=note, marked=wrong)


def close(found: float, printed: float, decimals: int) -> bool:
    """Whether a number is the printed one, rounded to so many decimals."""
    return abs(found - printed) <= 0.5 * 10.0**-decimals * (1.0 + 1e-9)
