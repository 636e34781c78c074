"""The quadratic parameter-varying form of a plant, its text, and where its matrices stand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import casadi as ca
import sympy as sp

from obsynth.derive.forms.qpv.augment import Augmented
from obsynth.derive.forms.varying import Layout, VaryingForm
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.convert import sx_function
from obsynth.symbolic.display import short
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.shown import aligned, card, formulas
from obsynth.symbolic.signals import KINDS
from obsynth.symbolic.table import Table

_DYNAMICS = {"c": "1", "A": "x", "N": "xx", "M": "ux", "B": "u", "D": "d", "B_f": "f", "G": "w"}
_OUTPUTS = {"C": "x", "feedthrough": "u", "D_f": "f", "H": "w", "output_offset": "1"}


class QPVLayout(Layout):
    """Columns [c A N M B D B_f G]; a row of N holds N_i row by row, one of M those of all M_j."""

    @classmethod
    def of(cls, n: int, m: int, n_u: int, n_d: int, n_f: int, n_w: int) -> QPVLayout:
        """Return the layout for numbers of signals, states after augmentation."""
        counts = (1, n, n * n, n * n_u, n_u, n_d, n_f, n_w)
        widths = dict(zip(_DYNAMICS.values(), counts, strict=True))
        return cls((_DYNAMICS, _OUTPUTS), (n, m), widths)

    @property
    def states(self) -> int:
        """Number of states after augmentation."""
        return self.heights[0]

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


@dataclass(frozen=True, eq=False, repr=False)
class QPV(VaryingForm):
    """x' = c + A x + [x'N_i x] + sum_j u_j M_j x + B u + D d + B_f f + G w, y = C x + H w + ...

    Equations (5)-(6) of Rotondo, Buciakowski and Witczak for a plant with process faults: x is
    the augmented state, faults last. For a discrete plant x' stands for the next state. The
    matrices are functions of scheduling variables and uncertain parameters.

    layout: where the blocks are: the constant part c (n, 1), A, B, D of the unknown inputs, B_f of
        the faults that are no states, G of the disturbances; C, feedthrough, D_f, H of the
        disturbances, output_offset
    plant: plant, augmented states, remaining faults
    form_of_N: ``"upper"`` or ``"symmetric"``: the same dynamics, different LMIs
    matrix, schedule, proof: as of every `VaryingForm`
    """

    layout: QPVLayout
    plant: Augmented
    form_of_N: Literal["upper", "symmetric"]

    @property
    def model(self) -> Plant:
        """The plant before augmentation."""
        return self.plant.model

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the augmented states."""
        return tuple(s.name for s in self.plant.states)

    @property
    def box(self) -> FloatArray:
        """Ranges of the augmented states, shape (n, 2)."""
        return self.plant.box

    @property
    def N(self) -> tuple[sp.Matrix, ...]:
        """Quadratic part: row i is x'N_i x."""
        n = self.layout.states
        rows = self.block("N")
        return tuple(sp.ImmutableMatrix(n, n, list(rows[i, :])) for i in range(n))

    @property
    def M(self) -> tuple[sp.Matrix, ...]:
        """State-by-input terms: the sum of u_j M_j x."""
        n = self.layout.states
        columns = self.block("M")
        return tuple(columns[:, j * n : (j + 1) * n] for j in range(self.layout.widths["u"]))

    def function(self) -> ca.Function:
        """Return (x, u, d, f, w, p, rho) -> (rhs, y), x augmented and f the remaining faults."""
        groups = {kind: getattr(self.model, kind) for kind in KINDS}
        groups |= {"x": self.plant.states, "f": self.plant.faults}
        inputs = {kind: [s.symbol for s in part] for kind, part in groups.items()}
        outputs = {"rhs": sp.Matrix(self.plant.rows), "y": sp.Matrix(self.plant.outputs)}
        return sx_function("qpv", inputs, outputs)

    def __repr__(self) -> str:
        return f"QPV({self.model.name!r}, states {', '.join(self.names)}, N {self.form_of_N})"

    def __str__(self) -> str:
        time = "x+" if self.model.Ts is not None else "x'"
        lines = [
            f"{self.model.name}: {time} = c + A x + [x'N_i x] + sum_j u_j M_j x + B u + ...; "
            f"x = ({', '.join(self.names)}), N {self.form_of_N}"
        ]
        x, u = sp.Matrix([s.symbol for s in self.plant.states]), [s.symbol for s in self.model.u]
        for i, name in enumerate(self.names):
            products = (s * (part[i, :] * x)[0] for s, part in zip(u, self.M, strict=True))
            parts = [p for p in ((x.T * self.N[i] * x)[0], sum(products, sp.Integer(0))) if p != 0]
            if parts:
                listed = " + ".join(sp.sstr(short(p)) for p in parts).replace("+ -", "- ")
                lines.append(f"  {name}: {listed}")
        lines += [f"  scheduling {v}" for v in self.scheduling]
        lines.append(str(self.proof))
        return "\n".join(lines)

    def _repr_latex_(self) -> str:
        blocks: list[tuple[str, sp.Matrix]] = [("c", self.c), ("A", self.A)]
        blocks += [(f"N_{{{i + 1}}}", part) for i, part in enumerate(self.N)]
        blocks += [(f"M_{{{j + 1}}}", part) for j, part in enumerate(self.M)]
        blocks += [("B", self.B), ("D", self.D), ("B_f", self.B_f), ("G", self.G)]
        blocks += [("C", self.C), ("D_f", self.D_f), ("H", self.H)]
        rows = [
            f"{name} &= {sp.latex(sp.Matrix(part).applyfunc(short))}"
            for name, part in blocks
            if any(entry != 0 for entry in part)
        ]
        return aligned(rows)

    def _repr_html_(self) -> str:
        states = [
            (s.name, str(s.role), f"{s.lower:.6g}", f"{s.upper:.6g}") for s in self.plant.states
        ]
        head, *_ = str(self).split("\n")
        table = Table("", ("state", "role", "min", "max"), states)
        return card(head, formulas(self._repr_latex_()), table, [*self.scheduling, self.proof])
