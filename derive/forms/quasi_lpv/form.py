"""The quasi-LPV form of a plant, and where its blocks stand in one stacked matrix."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import casadi as ca
import sympy as sp
from numpy.typing import ArrayLike

from obsynth.derive.forms.measured import read_measured
from obsynth.derive.forms.quasi_lpv.display import form_html, form_latex, form_text
from obsynth.derive.forms.quasi_lpv.interval_form import IntervalForm, make_interval_form
from obsynth.derive.forms.quasi_lpv.polytopic import (
    CentredForm,
    PolytopicForm,
    centre_form,
)
from obsynth.derive.forms.quasi_lpv.ranking import RowRanking
from obsynth.derive.forms.quasi_lpv.terms import Centre
from obsynth.derive.forms.scheduling import Lift, SchedulingVariable
from obsynth.derive.forms.varying import Layout, VaryingForm, casadi_elements
from obsynth.symbolic.convert import to_sx
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
    def of(cls, model: Plant) -> LinearLayout:
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


@dataclass(frozen=True, eq=False)
class Ranging:
    """How ranges of the entries of a form are found.

    matrix: the stacked matrix with symbols in place of the lifted secants
    lifts: these symbols, with the ranges of the derivatives whose means they are
    rtol: wanted gap
    effort: of the interval engine
    """

    matrix: sp.Matrix
    lifts: tuple[Lift, ...]
    rtol: float
    effort: str


@dataclass(frozen=True, eq=False, repr=False)
class QuasiLPV(VaryingForm):
    """x+ = A(rho) (x - x_c) + B(rho) (u - u_c) + D d + B_f f + W1 w + offset, and the outputs.

    For a continuous plant x+ stands for the time derivative; x_c = 0 and u_c = 0 by default. The
    outputs are y = C (x - x_c) + feedthrough (u - u_c) + D_y d + D_f f + W2 w + output_offset.

    Attributes
    ----------
    matrix : sympy.Matrix, shape (n + m, n + n_u + n_d + n_f + n_w + 1)
        All blocks in one matrix, exact, as functions of the plant's signals.
    layout : LinearLayout
        Where the blocks are; see `block`.
    schedule : AffineSchedule
        The same matrix, affine in the scheduling variables.
    proof : FormProof
        That the form is the plant.
    model : Plant
        The plant.
    centre : Centre
        The point (x_c, u_c) about which deviations are taken.
    ranking : tuple of RowRanking
        The ways to write every row, the chosen one first.
    unfactored : tuple of (str, sympy.Expr, str)
        Terms that stay in the offset although they vary: row, term, reason.
    ranging : Ranging
        How ranges of entries are found.

    Notes
    -----
    The form is not unique; `ranking` tells what else there was. It is the plant wherever its
    entries are defined; about another centre than the origin, |g| and sign(g) are taken with the
    sign that g has on the whole box, and the form is the plant on the box.
    """

    model: Plant
    centre: Centre
    ranking: tuple[RowRanking, ...]
    unfactored: tuple[tuple[str, sp.Expr, str], ...]
    ranging: Ranging

    @property
    def offset(self) -> sp.Matrix:
        """What is left of the dynamics at the centre, shape (n, 1)."""
        return self.block("offset")

    @property
    def unmeasured(self) -> tuple[SchedulingVariable, ...]:
        """Scheduling variables whose values are not known on line."""
        return tuple(v for v in self.scheduling if not v.measured)

    @cached_property
    def scheduled(self) -> sp.Matrix:
        """All blocks, affine in the symbols of the scheduling variables."""
        return sp.ImmutableMatrix(self.schedule.matrix(self.layout.shape))

    def vertices(self) -> PolytopicForm:
        """Polytopic form: vertex matrices over the ranges of the scheduling variables.

        Returns
        -------
        PolytopicForm
            With all blocks, labelled exact or outer, and the proof that they vary affinely.

        Raises
        ------
        UnboundedError
            A scheduling variable has no finite range.

        Examples
        --------
        >>> from obsynth.derive import quasi_lpv
        >>> from obsynth.symbolic.plants import quadruple_tank
        >>> form = quasi_lpv(quadruple_tank()).vertices()
        >>> form.A.shape, form.exact
        ((16, 4, 4), True)
        """
        family = self.schedule.family(self.layout.shape)
        return PolytopicForm(family, self.layout, dict(self.schedule.methods))

    def centred(self, nominal: ArrayLike | None = None) -> CentredForm:
        """Nominal matrices plus a remainder, for interval observers.

        Parameters
        ----------
        nominal : array_like, shape (n, n), optional
            Nominal A; by default the middle of the ranges, which leaves nothing constant in the
            remainder.

        Returns
        -------
        CentredForm
            Nominal, vertices and elementwise bounds of the remainder.

        Examples
        --------
        >>> from obsynth.derive import quasi_lpv
        >>> from obsynth.symbolic.plants import interval_example
        >>> form = quasi_lpv(interval_example()).centred()
        >>> form.A[0].tolist(), form.A_vertices[3].diagonal().tolist()
        ([-1.0, 1.5, 0.1], [0.1, 0.0, 0.05])
        """
        return centre_form(self.vertices(), nominal)

    def interval(self, measured: Any = None, margin: float = 0.0) -> IntervalForm:
        """Elementwise bounds of A, B and the offset.

        Parameters
        ----------
        measured : None, "outputs" or sequence of names
            None: constant bounds. ``"outputs"``: functions of what the outputs show (noise
            included), the inputs and the measured scheduling variables, as far as they schedule.
            Names of states, inputs, scheduling variables (known exactly) or outputs (with their
            noise).
        margin : float
            How far the arguments may be off beyond their noise, for instance what they move
            between two samples.

        Returns
        -------
        IntervalForm
            Constant bounds, or bounds as functions of the arguments with their domain.

        Raises
        ------
        UnboundedError
            An entry has no finite bound.
        DerivationError
            ``measured`` is not understood.

        Examples
        --------
        >>> from obsynth.derive import quasi_lpv
        >>> from obsynth.symbolic.plants import quadruple_tank
        >>> bounds = quasi_lpv(quadruple_tank()).interval()
        >>> bounds.A_min[0, 0].round(6), bounds.A_max[0, 0].round(6)
        (np.float64(-0.0145), np.float64(-0.006712))
        """
        way = self.ranging
        blocks = {name: way.matrix[self.layout.place(name)] for name in ("A", "B", "offset")}
        known = read_measured(self.model, measured, margin)
        if isinstance(measured, str) and measured == "outputs":
            used = {s for block in blocks.values() for s in block.free_symbols}
            used |= {s for lift in way.lifts for s in lift.meaning.free_symbols}
            known = tuple(k for k in known if k.signal in used)
        return make_interval_form(blocks, self.model, known, way.lifts, way.rtol, way.effort)

    def function(self) -> ca.Function:
        """Return the matrices as a CasADi function.

        Returns
        -------
        casadi.Function
            (x, u, p, rho, d, f, w) -> (A, B, offset, C).
        """
        kinds, sx = ("x", "u", "p", "rho", "d", "f", "w"), self.model.sx()
        columns, table = [getattr(sx, kind) for kind in kinds], casadi_elements(self.model)
        names = ("A", "B", "offset", "C")
        values = []
        for name in names:
            block = self.block(name)
            entries = to_sx(list(block.T), table, [name] * len(block))
            column = ca.vertcat(*entries) if entries else ca.SX(0, 1)
            values.append(ca.densify(ca.reshape(column, *block.shape)))
        return ca.Function("quasi_lpv", columns, values, list(kinds), list(names))

    def __repr__(self) -> str:
        return f"QuasiLPV({self.model.name!r}, {len(self.scheduling)} scheduling variables)"

    def __str__(self) -> str:
        return form_text(self)

    def _repr_latex_(self) -> str:
        return f"$${form_latex(self)}$$"

    def _repr_html_(self) -> str:
        return form_html(self)
