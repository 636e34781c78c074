"""What quasi-LPV and quadratic forms share: one stacked matrix, affine in scheduling variables."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import sympy as sp

from obsynth.derive.algebra.sizes import text
from obsynth.derive.algebra.zero_test import FormProof, prove_zero
from obsynth.derive.errors import DerivationError, StructureError
from obsynth.derive.forms.scheduling import AffineSchedule, SchedulingVariable
from obsynth.derive.jacobian.family import AffineFamily
from obsynth.derive.rigour import round_number
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.shown import Shown
from obsynth.symbolic.signals import Signal
from obsynth.symbolic.table import Table


@dataclass(frozen=True)
class Layout:
    """Where the blocks of a form stand in one matrix, the rows of the dynamics first.

    blocks: what the columns of every block multiply, those in the dynamics, those in the outputs
    heights: number of states and of outputs
    widths: columns by what they multiply, from left to right
    """

    blocks: tuple[dict[str, str], dict[str, str]]
    heights: tuple[int, int]
    widths: dict[str, int]

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the stacked matrix."""
        return sum(self.heights), sum(self.widths.values())

    def place(self, block: str) -> tuple[slice, slice]:
        """Rows and columns of a block."""
        dynamics, outputs = self.blocks
        if block not in dynamics | outputs:
            listed = ", ".join(dynamics | outputs)
            raise DerivationError(f"there is no block {block!r}; there are {listed}", block=block)
        n, m = self.heights
        factor, rows = (
            (dynamics[block], slice(0, n))
            if block in dynamics
            else (outputs[block], slice(n, n + m))
        )
        names = list(self.widths)
        start = sum(self.widths[name] for name in names[: names.index(factor)])
        return rows, slice(start, start + self.widths[factor])

    def unfold(self, block: str, values: FloatArray) -> FloatArray:
        """Give a block whose columns are several matrices the shape of these matrices."""
        return values


class Blocks(ABC):
    """Something made of blocks, which are its attributes."""

    layout: Layout

    @abstractmethod
    def block(self, name: str) -> Any:
        """Return a block."""

    def __getattr__(self, name: str) -> Any:
        layout = self.__dict__.get("layout")
        if layout is None or not any(name in blocks for blocks in layout.blocks):
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        return self.block(name)


@dataclass(frozen=True, eq=False, repr=False)
class Vertices(Shown, Blocks):
    """The blocks of a form at the vertices of its scheduling variables.

    Each block is an attribute, with the vertices first: ``A`` (V, n, n), ``B`` (V, n, n_u), ...; of
    a quadratic form N[v, i] is N_i and M[v, j] belongs to u_j, (V, n, n, n) and (V, n_u, n, n). The
    last scheduling variable changes fastest, the lower end comes first. Their hull holds the
    matrices of the form at every point of the box.

    family: the stacked matrix, affine in the scheduling variables; its radius bounds the rounding
    layout: where the blocks are
    affinity: how every varying entry was proved to be affine
    """

    family: AffineFamily
    layout: Layout
    affinity: dict[tuple[int, int], str] = field(default_factory=dict)

    @property
    def count(self) -> int:
        """Number of vertices V."""
        return self.family.vertex_count

    @property
    def exact(self) -> bool:
        """True when the hull is that of the matrices that occur, False for an outer box."""
        return self.family.exact

    def block(self, name: str) -> FloatArray:
        """Return a block at the vertices, (V, rows, columns)."""
        rows, columns = self.layout.place(name)
        return self.layout.unfold(name, self.family.vertices()[:, rows, columns])

    def radius(self, name: str) -> FloatArray:
        """Elementwise bound of the rounding of a block, shape (rows, columns)."""
        return self.layout.unfold(name, self.family.radius[self.layout.place(name)])

    def __str__(self) -> str:
        kind = "exact" if self.exact else "outer"
        ways = ", ".join(sorted(set(self.affinity.values()))) or "no entry varies"
        scalars = "; ".join(self.family.labels) or "none"
        return f"{self.count} vertices ({kind}) over {scalars}; affine dependence proved ({ways})"

    def _repr_html_(self) -> str:
        ends = ((f"{low:.8g}", f"{high:.8g}") for low, high in self.family.ranges)
        rows = [(label, *pair) for label, pair in zip(self.family.labels, ends, strict=True)]
        return Table(str(self), ("variable", "min", "max"), rows)._repr_html_()


@dataclass(frozen=True, eq=False, repr=False)
class VaryingForm(Blocks):
    """A plant as constant plus varying matrices, stacked in one; each block is an attribute."""

    matrix: sp.Matrix
    layout: Layout
    schedule: AffineSchedule
    proof: FormProof

    def block(self, name: str) -> sp.Matrix:
        """Return a block of the form, exactly, as a function of the plant's signals."""
        return self.matrix[self.layout.place(name)]

    @property
    def scheduling(self) -> tuple[SchedulingVariable, ...]:
        """The scheduling variables with their ranges."""
        return self.schedule.variables

    def constant(self, name: str) -> FloatArray:
        """Return a block that does not vary as the nearest doubles; StructureError if it does.

        ``"N"`` and ``"M"`` of a quadratic form have the shapes (n, n, n) and (n_u, n, n).
        """
        block = self.block(name)
        values = np.zeros(block.shape)
        for i, j in np.ndindex(block.shape):
            entry = block[i, j]
            free = tuple(sorted(map(str, entry.free_symbols)))
            if free:
                raise StructureError(
                    f"{name}[{i + 1},{j + 1}] = {text(entry)} varies with {', '.join(free)}; a "
                    f"constant {name} is needed here: fix {', '.join(free)}, or use vertices()",
                    entry=(i, j),
                    symbols=free,
                    condition="constant block",
                )
            values[i, j] = round_number(entry)[0]
        return self.layout.unfold(name, values)

    def vertices(self) -> Vertices:
        """Return the blocks at the corners of the scheduling ranges, one where nothing varies.

        UnboundedError where a scheduling variable has no finite range.
        """
        family = self.schedule.family(self.layout.shape)
        return Vertices(family, self.layout, dict(self.schedule.methods))


def prove_rows(
    matrix: sp.Matrix,
    column: Sequence[sp.Expr],
    rows: Sequence[sp.Expr],
    names: tuple[str, ...],
    signals: Iterable[Signal],
) -> FormProof:
    """Show that matrix times column is the plant, row by row, on the box of its signals."""
    box = {s.symbol: (s.lower, s.upper) for s in signals}
    methods = []
    for i, row in enumerate(rows):
        products = [matrix[i, j] * factor for j, factor in enumerate(column)]
        method = prove_zero(row - sp.Add(*products), box)
        if not method:
            raise DerivationError(
                f"the form of the row of {names[i]} is not the plant's {row}", row=names[i]
            )
        methods.append(method)
    return FormProof(names, tuple(methods))
