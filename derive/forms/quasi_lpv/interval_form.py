"""Constant elementwise bounds of a quasi-linear model."""

from dataclasses import dataclass

import numpy as np
import sympy as sp

from obsynth.derive.forms.scheduling import Lift
from obsynth.derive.jacobian.matrix_entries import matrix_entries
from obsynth.derive.rigour import enclose_number
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.shown import Shown


@dataclass(frozen=True, eq=False)
class Ranging:
    """How ranges of entries of a form are found; ``lifts`` are symbols with ranges of slopes."""

    matrix: sp.Matrix
    lifts: tuple[Lift, ...]
    rtol: float
    effort: str


@dataclass(frozen=True, eq=False, repr=False)
class IntervalForm(Shown):
    """A_min <= A(rho) <= A_max elementwise over the box, and the same for B and the offset.

    minimum, maximum: guaranteed bounds of ``"A"`` (n, n), ``"B"`` (n, n_u), ``"offset"`` (n, 1)
    """

    minimum: dict[str, FloatArray]
    maximum: dict[str, FloatArray]

    @property
    def A_min(self) -> FloatArray:
        """Lower bound of A, shape (n, n)."""
        return self.minimum["A"]

    @property
    def A_max(self) -> FloatArray:
        """Upper bound of A, shape (n, n)."""
        return self.maximum["A"]

    def __str__(self) -> str:
        lines = ["bounds of A"]
        for (i, j), low in np.ndenumerate(self.A_min):
            if (high := self.A_max[i, j]) > low:
                lines.append(f"  a{i + 1}{j + 1} in [{low:.8g}, {high:.8g}]")
        return "\n".join(lines)


def make_interval_form(blocks: dict[str, sp.Matrix], model: Plant, way: Ranging) -> IntervalForm:
    """Bound the blocks of a form elementwise."""
    minimum, maximum = {}, {}
    for name, block in blocks.items():
        low, high = np.zeros(block.shape), np.zeros(block.shape)
        varying = {}
        for place in np.ndindex(*block.shape):
            if block[place].free_symbols:
                varying[place] = block[place]
            else:
                low[place], high[place] = enclose_number(block[place])
        entries = matrix_entries(varying, model, [lift.signal for lift in way.lifts])
        if entries.places:
            found = entries.ranges(way.rtol, way.effort, name)
            for k, place in enumerate(entries.places):
                low[place], high[place] = found.lower[k], found.upper[k]
        minimum[name], maximum[name] = low, high
    return IntervalForm(minimum, maximum)
