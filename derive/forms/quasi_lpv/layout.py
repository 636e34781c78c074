"""Where the blocks of a linear form stand in one stacked matrix."""

from dataclasses import dataclass
from typing import ClassVar

from obsynth.derive.forms.varying import Layout
from obsynth.symbolic.plant import Plant


@dataclass(frozen=True)
class LinearLayout(Layout):
    """Sizes of [A B D B_f W1 offset; C feedthrough D_y D_f W2 output_offset].

    rows: number of states and of outputs
    columns: number of states, inputs, unknown inputs, faults, disturbances, and 1 for the offset
    """

    BLOCKS: ClassVar[dict[str, tuple[str, str]]] = {
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

    rows: tuple[int, int]
    columns: tuple[int, int, int, int, int, int]

    @classmethod
    def of(cls, model: Plant) -> "LinearLayout":
        """Return the layout of a plant."""
        n, n_u, n_d, n_f, n_w = (len(model.names(kind)) for kind in "xudfw")
        return cls((n, len(model.output_names)), (n, n_u, n_d, n_f, n_w, 1))

    @property
    def heights(self) -> tuple[int, int]:
        """Number of states and of outputs."""
        return self.rows

    @property
    def widths(self) -> dict[str, int]:
        """Columns by the signals they multiply."""
        return dict(zip("xudfw1", self.columns, strict=True))
