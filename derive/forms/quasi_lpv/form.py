"""The quasi-LPV form of a plant."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import sympy as sp
from numpy.typing import ArrayLike, NDArray

from obsynth.derive.algebra.zero_test import FormProof
from obsynth.derive.errors import StructureError
from obsynth.derive.forms.quasi_lpv.centre import Centre
from obsynth.derive.forms.quasi_lpv.display import form_html, form_latex, form_text
from obsynth.derive.forms.quasi_lpv.interval_form import IntervalForm, make_interval_form
from obsynth.derive.forms.quasi_lpv.known import read_measured
from obsynth.derive.forms.quasi_lpv.layout import Layout
from obsynth.derive.forms.quasi_lpv.polytopic import (
    CentredForm,
    PolytopicForm,
    centre_form,
    make_polytope,
)
from obsynth.derive.forms.quasi_lpv.ranking import RowRanking
from obsynth.derive.forms.quasi_lpv.scheduling import AffineSchedule, SchedulingVariable
from obsynth.derive.forms.quasi_lpv.widths import Lift
from obsynth.derive.rigour.numbers import round_number
from obsynth.symbolic.convert import to_sx
from obsynth.symbolic.plant import Plant

UNMEASURED_NOTE = (
    "With unmeasured scheduling A(x) x - A(xhat) xhat is not A(x) (x - xhat): an observer that "
    "schedules with its estimate needs the Jacobian form (jacobian_bounds), or bounds that hold "
    "for every value (vertices, interval)."
)


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
class QuasiLPV:
    """x+ = A(rho) (x - x_c) + B(rho) (u - u_c) + D d + B_f f + W1 w + offset, and the outputs.

    For a continuous plant x+ stands for the time derivative; x_c = 0 and u_c = 0 by default. The
    outputs are y = C (x - x_c) + feedthrough (u - u_c) + D_y d + D_f f + W2 w + output_offset.

    Attributes
    ----------
    model : Plant
        The plant.
    matrix : sympy.Matrix, shape (n + m, n + n_u + n_d + n_f + n_w + 1)
        All blocks in one matrix, exact, as functions of the plant's signals.
    layout : Layout
        Where the blocks are; see `block`.
    centre : Centre
        The point (x_c, u_c) about which deviations are taken.
    schedule : AffineSchedule
        The same matrix, affine in the scheduling variables.
    ranking : tuple of RowRanking
        The ways to write every row, the chosen one first.
    unfactored : tuple of (str, sympy.Expr, str)
        Terms that stay in the offset although they vary: row, term, reason.
    proof : FormProof
        That the form is the plant.
    ranging : Ranging
        How ranges of entries are found.

    Notes
    -----
    The form is not unique; `ranking` tells what else there was. It is the plant wherever its
    entries are defined; about another centre than the origin, |g| and sign(g) are taken with the
    sign that g has on the whole box, and the form is the plant on the box.
    """

    model: Plant
    matrix: sp.Matrix
    layout: Layout
    centre: Centre
    schedule: AffineSchedule
    ranking: tuple[RowRanking, ...]
    unfactored: tuple[tuple[str, sp.Expr, str], ...]
    proof: FormProof
    ranging: Ranging

    def block(self, name: str) -> sp.Matrix:
        """Return a block of the form, exactly.

        Parameters
        ----------
        name : str
            ``"A"``, ``"B"``, ``"D"``, ``"B_f"``, ``"W1"``, ``"offset"``, ``"C"``,
            ``"feedthrough"``, ``"D_y"``, ``"D_f"``, ``"W2"`` or ``"output_offset"``.

        Returns
        -------
        sympy.Matrix
            As a function of the plant's signals.
        """
        rows, columns = self.layout.place(name)
        return self.matrix[rows, columns]

    @property
    def A(self) -> sp.Matrix:
        """State matrix A(rho), shape (n, n)."""
        return self.block("A")

    @property
    def B(self) -> sp.Matrix:
        """Input matrix B(rho), shape (n, n_u)."""
        return self.block("B")

    @property
    def C(self) -> sp.Matrix:
        """Output matrix, shape (m, n)."""
        return self.block("C")

    @property
    def offset(self) -> sp.Matrix:
        """What is left of the dynamics at the centre, shape (n, 1)."""
        return self.block("offset")

    @property
    def scheduling(self) -> tuple[SchedulingVariable, ...]:
        """The scheduling variables with their ranges."""
        return self.schedule.variables

    @property
    def unmeasured(self) -> tuple[SchedulingVariable, ...]:
        """Scheduling variables whose values are not known on line."""
        return tuple(v for v in self.scheduling if not v.measured)

    @cached_property
    def scheduled(self) -> sp.Matrix:
        """All blocks, affine in the symbols of the scheduling variables."""
        return sp.ImmutableMatrix(self.schedule.matrix(self.layout.shape))

    def constant(self, name: str) -> NDArray[np.float64]:
        """Return a block that does not vary as doubles.

        Parameters
        ----------
        name : str
            As for `block`.

        Returns
        -------
        ndarray
            The nearest doubles.

        Raises
        ------
        StructureError
            An entry varies; row, column and signals are named.

        Examples
        --------
        >>> from obsynth.derive import quasi_lpv
        >>> from obsynth.symbolic.plants import quadruple_tank
        >>> quasi_lpv(quadruple_tank()).constant("C")[2].tolist()
        [0.0, 0.0, 1.0, 0.0]
        """
        block = self.block(name)
        values = np.zeros(block.shape)
        for i in range(block.rows):
            for j in range(block.cols):
                entry = block[i, j]
                if entry.free_symbols:
                    signals = ", ".join(sorted(map(str, entry.free_symbols)))
                    raise StructureError(
                        f"{name}[{i + 1},{j + 1}] = {entry} varies with {signals}; a constant "
                        f"{name} is needed here",
                        entry=(i, j),
                        symbols=tuple(sorted(map(str, entry.free_symbols))),
                        condition="constant block",
                    )
                values[i, j] = round_number(entry)[0]
        return values

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
        return make_polytope(self.schedule, self.layout)

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
        kinds = ("x", "u", "p", "rho", "d", "f", "w")
        columns, table = [], {}
        for kind in kinds:
            elements = [ca.SX.sym(name) for name in self.model.names(kind)]
            columns.append(ca.vertcat(*elements) if elements else ca.SX(0, 1))
            signals = getattr(self.model, kind)
            table.update({s.symbol: e for s, e in zip(signals, elements, strict=True)})
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
