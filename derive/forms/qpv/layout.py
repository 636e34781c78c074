"""Where the matrices of a quadratic system stand in one stacked matrix."""

from dataclasses import dataclass

from obsynth.derive.errors import DerivationError
from obsynth.derive.forms.qpv.augment import Augmented

_ORDER = ("c", "A", "N", "M", "B", "D", "B_f", "G")


@dataclass(frozen=True)
class QPVLayout:
    """Columns [c A N M B D B_f G] over the rows of the dynamics, then of the outputs.

    A row of N holds the matrix N_i row by row, a row of M the rows of M_1, M_2, ... one after the
    other.

    states, outputs, inputs, unknown, faults, disturbances: numbers of signals, states after
        augmentation
    """

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
    def widths(self) -> dict[str, int]:
        """Number of columns of every block."""
        n = self.states
        counts = (1, n, n * n, n * self.inputs, self.inputs)
        return dict(
            zip(_ORDER, (*counts, self.unknown, self.faults, self.disturbances), strict=True)
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the stacked matrix."""
        return self.states + self.outputs, sum(self.widths.values())

    def start(self, block: str) -> int:
        """First column of a block."""
        if block not in _ORDER:
            raise DerivationError(
                f"there is no block {block!r}; there are {', '.join(_ORDER)}", block=block
            )
        widths = self.widths
        return sum(widths[name] for name in _ORDER[: _ORDER.index(block)])

    def columns(self, block: str) -> slice:
        """Columns of a block."""
        start = self.start(block)
        return slice(start, start + self.widths[block])

    def quadratic(self, a: int, b: int) -> int:
        """Column of the entry (a, b) of N_i."""
        return self.start("N") + a * self.states + b

    def bilinear(self, j: int, a: int) -> int:
        """Column of u_j x_a."""
        return self.start("M") + j * self.states + a

    @property
    def dynamics(self) -> slice:
        """Rows of the dynamics."""
        return slice(0, self.states)

    @property
    def measurement(self) -> slice:
        """Rows of the outputs."""
        return slice(self.states, self.states + self.outputs)
