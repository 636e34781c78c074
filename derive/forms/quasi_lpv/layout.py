"""Where the blocks of a linear form stand in one stacked matrix."""

from dataclasses import dataclass

from obsynth.derive.errors import DerivationError
from obsynth.symbolic.plant import Plant

BLOCKS: dict[str, tuple[str, str]] = {
    "A": ("dynamics", "x"),
    "B": ("dynamics", "u"),
    "D": ("dynamics", "d"),
    "B_f": ("dynamics", "f"),
    "W1": ("dynamics", "w"),
    "offset": ("dynamics", "1"),
    "C": ("outputs", "x"),
    "feedthrough": ("outputs", "u"),
    "D_y": ("outputs", "d"),
    "D_f": ("outputs", "f"),
    "W2": ("outputs", "w"),
    "output_offset": ("outputs", "1"),
}
"""Names of the blocks with the rows and the columns they take."""


@dataclass(frozen=True)
class Layout:
    """Sizes of [A B D B_f W1 offset; C feedthrough D_y D_f W2 output_offset].

    rows: number of states and of outputs
    columns: number of states, inputs, unknown inputs, faults, disturbances, and 1 for the offset
    """

    rows: tuple[int, int]
    columns: tuple[int, int, int, int, int, int]

    @classmethod
    def of(cls, model: Plant) -> "Layout":
        """Return the layout of a plant."""
        n, n_u, n_d, n_f, n_w = (len(model.names(kind)) for kind in "xudfw")
        return cls((n, len(model.output_names)), (n, n_u, n_d, n_f, n_w, 1))

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the stacked matrix."""
        return sum(self.rows), sum(self.columns)

    def place(self, block: str) -> tuple[slice, slice]:
        """Rows and columns of a block."""
        if block not in BLOCKS:
            raise DerivationError(
                f"there is no block {block!r}; there are {', '.join(BLOCKS)}", block=block
            )
        row, column = BLOCKS[block]
        n, m = self.rows
        vertical = slice(0, n) if row == "dynamics" else slice(n, n + m)
        k = "xudfw1".index(column)
        start = sum(self.columns[:k])
        return vertical, slice(start, start + self.columns[k])

    def block_of(self, i: int, j: int) -> tuple[str, int, int]:
        """Name of the block that holds an entry, with the row and column inside it."""
        for block in BLOCKS:
            vertical, horizontal = self.place(block)
            if vertical.start <= i < vertical.stop and horizontal.start <= j < horizontal.stop:
                return block, i - vertical.start, j - horizontal.start
        raise DerivationError(f"the entry ({i}, {j}) is outside of {self.shape}", entry=(i, j))
