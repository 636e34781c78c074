"""What bounds that were fitted to a record are worth for the next one."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import betaincinv

from obsynth.evaluate.bounds.certified import least
from obsynth.evaluate.bounds.problem import Problem
from obsynth.evaluate.errors import BoundsError
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.table import Table, Tabled

CONFIDENCE = 0.95


@dataclass(frozen=True, eq=False, repr=False)
class Validation(Tabled):
    """Factors of the bounds that single windows of the record need, (n,): attained, certified.

    free: number of bounds and parameters that were fitted
    """

    factors: FloatArray
    certified: FloatArray
    free: int

    @property
    def exceeded(self) -> float:
        """Probability that a window like these needs more than all of them: 1 / (n + 1)."""
        return 1.0 / (len(self.factors) + 1)

    @property
    def violation(self) -> float:
        """Share of windows to come that may violate the bounds, with 95 per cent confidence.

        The root in eps of ``sum_{i < d} C(n, i) eps^i (1 - eps)^(n - i) = .05`` for d numbers
        (Campi, Garatti 2008), for exchangeable windows.
        """
        n, d = len(self.factors), min(self.free, len(self.factors))
        return float(betaincinv(d, n - d + 1, CONFIDENCE))

    @property
    def safety(self) -> float:
        """Factor that holds with 95 per cent confidence if the tail is uniform up to its bound."""
        return float((1.0 - CONFIDENCE) ** (-1.0 / len(self.factors)))

    def table(self) -> Table:
        """Factors by window, with what they mean."""
        pairs = enumerate(zip(self.factors.tolist(), self.certified.tolist(), strict=True), 1)
        return Table(
            "Windows of the record",
            ["window", "factor attained", "certified"],
            [[k, *pair] for k, pair in pairs],
            note=f"If windows are exchangeable, the next needs more than all of these with "
            f"probability {self.exceeded:.3g}; with 95 % confidence at most {self.violation:.3g} "
            f"of all windows violate the bounds. If what is needed is uniform up to its bound, "
            f"{self.safety:.3g} times the bounds hold with the same confidence.",
        )


def validate(problem: Problem, bounds: FloatArray, windows: int, free: int) -> Validation:
    """Return the factors of bounds that equal windows of the record need."""
    if not 2 <= windows <= len(problem):
        raise BoundsError(f"{windows} windows: give 2 to {len(problem)}.", windows=windows)
    edges = np.linspace(0, len(problem), windows + 1).round().astype(int)
    scaled = problem.scaled(bounds)
    found = [
        least(scaled.window(a, b), np.ones(1), contractions=0) for a, b in pairwise(edges.tolist())
    ]
    factors = np.array([one.upper for one in found])
    return Validation(factors, np.array([one.lower for one in found]), free)
