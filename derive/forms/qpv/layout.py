"""Where the matrices of a quadratic system stand in one stacked matrix."""

from dataclasses import dataclass
from typing import ClassVar

from obsynth.derive.forms.qpv.augment import Augmented
from obsynth.derive.forms.varying import Layout
from obsynth.symbolic.arrays import FloatArray


@dataclass(frozen=True)
class QPVLayout(Layout):
    """Columns [c A N M B D B_f G] over the rows of the dynamics, then of the outputs.

    A row of N holds the matrix N_i row by row, a row of M the rows of M_1, M_2, ... one after the
    other.

    states, outputs, inputs, unknown, faults, disturbances: numbers of signals, states after
        augmentation
    """

    BLOCKS: ClassVar[dict[str, tuple[str, str]]] = {
        "c": ("dynamics", "1"),
        "A": ("dynamics", "x"),
        "N": ("dynamics", "xx"),
        "M": ("dynamics", "ux"),
        "B": ("dynamics", "u"),
        "D": ("dynamics", "d"),
        "B_f": ("dynamics", "f"),
        "G": ("dynamics", "w"),
        "C": ("outputs", "x"),
        "feedthrough": ("outputs", "u"),
        "D_f": ("outputs", "f"),
        "H": ("outputs", "w"),
        "output_offset": ("outputs", "1"),
    }

    states: int
    outputs: int
    inputs: int
    unknown: int
    faults: int
    disturbances: int

    @classmethod
    def of(cls, plant: Augmented) -> "QPVLayout":
        """Return the layout of an augmented plant."""
        model = plant.model
        return cls(
            len(plant.states),
            len(plant.outputs),
            len(model.u),
            len(model.d),
            len(plant.faults),
            len(model.w),
        )

    @property
    def heights(self) -> tuple[int, int]:
        """Number of states and of outputs."""
        return self.states, self.outputs

    @property
    def widths(self) -> dict[str, int]:
        """Columns by the signals they multiply."""
        n, k = self.states, self.inputs
        counts = (1, n, n * n, n * k, k, self.unknown, self.faults, self.disturbances)
        return dict(zip(("1", "x", "xx", "ux", "u", "d", "f", "w"), counts, strict=True))

    def unfold(self, block: str, values: FloatArray) -> FloatArray:
        """Give N and M their shapes, (n, n, n) and (n_u, n, n)."""
        n, before = self.states, values.shape[:-1]
        if block == "N":
            return values.reshape(*before, n, n)
        return values.reshape(*before, -1, n).swapaxes(-3, -2) if block == "M" else values

    def start(self, block: str) -> int:
        """First column of a block."""
        return int(self.place(block)[1].start)

    def quadratic(self, a: int, b: int) -> int:
        """Column of the entry (a, b) of N_i."""
        return self.start("N") + a * self.states + b

    def bilinear(self, j: int, a: int) -> int:
        """Column of u_j x_a."""
        return self.start("M") + j * self.states + a
