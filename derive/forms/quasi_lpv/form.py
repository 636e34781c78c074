"""The quasi-LPV form of a plant: how it is found, and where its blocks stand in one matrix."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from obsynth.derive.algebra.zero_test import FormProof
from obsynth.derive.errors import DerivationError, StructureError
from obsynth.derive.forms.quasi_lpv.elementwise import (
    CentredForm,
    IntervalForm,
    Ranging,
    centre_form,
    make_interval_form,
)
from obsynth.derive.forms.quasi_lpv.options import Option
from obsynth.derive.forms.quasi_lpv.ranking import RowRanking, choose
from obsynth.derive.forms.quasi_lpv.terms import (
    Centre,
    Term,
    decide_signs,
    deviations,
    list_terms,
    prefer_options,
    read_centre,
    row_names,
    stacked_rows,
)
from obsynth.derive.forms.scheduling import SchedulingVariable, make_schedule
from obsynth.derive.forms.varying import Layout, VaryingForm, prove_rows
from obsynth.symbolic.convert import sx_function
from obsynth.symbolic.display import short
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.shown import aligned, card, formulas
from obsynth.symbolic.table import Table
from obsynth.symbolic.taking import takes

_DYNAMICS = ("A", "B", "D", "B_f", "W1", "offset")
_OUTPUTS = ("C", "feedthrough", "D_y", "D_f", "W2", "output_offset")
_LONGEST = 60
UNMEASURED_NOTE = (
    "With unmeasured scheduling A(x) x - A(xhat) xhat is not A(x) (x - xhat): an observer that "
    "schedules with its estimate needs the Jacobian form (jacobian_bounds), or bounds that hold "
    "for every value (vertices, interval)."
)


def linear_layout(model: Plant) -> Layout:
    """Return the layout [A B D B_f W1 offset; C feedthrough D_y D_f W2 output_offset]."""
    widths = {kind: len(model.names(kind)) for kind in "xudfw"} | {"1": 1}
    dynamics, outputs = (dict(zip(b, widths, strict=True)) for b in (_DYNAMICS, _OUTPUTS))
    return Layout((dynamics, outputs), (widths["x"], len(model.output_names)), widths)


@dataclass(frozen=True, eq=False, repr=False)
class QuasiLPV(VaryingForm):
    """x+ = A(rho) (x - x_c) + B(rho) (u - u_c) + D d + B_f f + W1 w + offset, and the outputs.

    For a continuous plant x+ stands for the time derivative; x_c = 0 and u_c = 0 by default. The
    outputs are y = C (x - x_c) + feedthrough (u - u_c) + D_y d + D_f f + W2 w + output_offset.

    The form is not unique; `ranking` tells what else there was. It is the plant wherever its
    entries are defined; about another centre than the origin, |g| and sign(g) are taken with the
    sign that g has on the whole box, and the form is the plant on the box.

    matrix (n + m, n + n_u + n_d + n_f + n_w + 1), schedule, proof: as of every `VaryingForm`
    layout: where the blocks are: A, B, D, B_f, W1, ``offset`` (what is left of the dynamics at the
        centre, (n, 1)); C, feedthrough, D_y, D_f, W2, output_offset
    model: the plant
    centre: the point (x_c, u_c) about which deviations are taken
    ranking: the ways to write every row, the chosen one first
    unfactored: terms that stay in the offset although they vary: row, term, reason
    ranging: how ranges of entries are found
    """

    model: Plant
    centre: Centre
    ranking: tuple[RowRanking, ...]
    unfactored: tuple[tuple[str, sp.Expr, str], ...]
    ranging: Ranging

    @property
    def unmeasured(self) -> tuple[SchedulingVariable, ...]:
        """Scheduling variables whose values are not known on line."""
        return tuple(v for v in self.scheduling if not v.measured)

    @cached_property
    def scheduled(self) -> sp.Matrix:
        """All blocks, affine in the symbols of the scheduling variables."""
        return sp.ImmutableMatrix(self.schedule.matrix(self.layout.shape))

    def centred(self, nominal: ArrayLike | None = None) -> CentredForm:
        """Return nominal matrices plus a remainder, for interval observers.

        nominal (n, n): by default the middle of the ranges, which leaves nothing constant in the
            remainder
        """
        return centre_form(self.vertices(), nominal)

    def interval(self) -> IntervalForm:
        """Bound A, B and the offset elementwise over the box; UnboundedError where that fails."""
        matrix = self.ranging.matrix
        blocks = {name: matrix[self.layout.place(name)] for name in ("A", "B", "offset")}
        return make_interval_form(blocks, self.model, self.ranging)

    def function(self) -> ca.Function:
        """Return (x, u, p, rho, d, f, w) -> (A, B, offset, C)."""
        kinds = ("x", "u", "p", "rho", "d", "f", "w")
        inputs = {kind: [s.symbol for s in getattr(self.model, kind)] for kind in kinds}
        outputs = {name: self.block(name) for name in ("A", "B", "offset", "C")}
        return sx_function("quasi_lpv", inputs, outputs)

    def __repr__(self) -> str:
        return f"QuasiLPV({self.model.name!r}, {len(self.scheduling)} scheduling variables)"

    def __str__(self) -> str:
        names = self.model.names("x")
        lines = [self._title()]
        for block, columns in (("A", names), ("B", self.model.names("u"))):
            place = self.layout.place(block)
            matrix = self.scheduled[place]
            for i, row in enumerate(names):
                entries = [
                    f"{column}: {sp.sstr(short(matrix[i, j]))}"
                    for j, column in enumerate(columns)
                    if matrix[i, j] != 0
                ]
                if entries:
                    lines.append(f"  {block}, row of {row}: {'; '.join(entries)}")
        offset = self.scheduled[self.layout.place("offset")]
        if any(e != 0 for e in offset):
            listed = ", ".join(sp.sstr(short(e)) for e in offset)
            lines.append(f"  offset: ({listed})")
        lines.append("scheduling" if self.scheduling else "no scheduling: the form is linear")
        lines += [f"  {v}" for v in self.scheduling]
        lines += self.notes()
        return "\n".join(lines)

    def _title(self) -> str:
        time = "x+" if self.model.Ts is not None else "x'"
        if self.centre.is_origin:
            return f"{self.model.name}: {time} = A x + B u + ... + offset"
        return f"{self.model.name}: {time} = A (x - x_c) + B (u - u_c) + ... + offset"

    def notes(self) -> list[str]:
        """List what a user has to know: choices, terms left over, measurement, proof."""
        result = []
        for ranking in self.ranking:
            if ranking.total > 1:
                result.append(f"row of {ranking.row}: {ranking.total} ways, chosen is")
                result.append(f"  {ranking.alternatives[0]}")
        for row, term, reason in self.unfactored:
            text = sp.sstr(short(term))
            text = text if len(text) <= _LONGEST else text[: _LONGEST - 3] + "..."
            result.append(f"the term {text} in the row of {row} stays in the offset: {reason}")
        lost = self.unmeasured
        if lost:
            result.append(f"unmeasured scheduling: {', '.join(str(v.symbol) for v in lost)}")
            result.append(UNMEASURED_NOTE)
        result.append(str(self.proof))
        return result

    def _repr_latex_(self) -> str:
        rows = []
        for name, label in (("A", "A"), ("B", "B"), ("offset", "r")):
            matrix = self.scheduled[self.layout.place(name)]
            if matrix.cols and any(e != 0 for e in matrix):
                rows.append(f"{label} &= {sp.latex(sp.Matrix(matrix).applyfunc(short))}")
        for v in self.scheduling:
            own = "" if v.symbol == v.expression else f"= {sp.latex(short(v.expression))} "
            rows.append(f"{sp.latex(v.symbol)} &{own}\\in [{v.lower:.6g},\\, {v.upper:.6g}]")
        return aligned(rows)

    def _repr_html_(self) -> str:
        heads = ("variable", "function", "min", "max", "range", "known on line")
        variables = [
            (
                str(v.symbol),
                sp.sstr(short(v.expression)),
                f"{v.lower:.8g}",
                f"{v.upper:.8g}",
                v.status.word,
                "measured" if v.measured else f"needs {', '.join(v.unmeasured)}",
            )
            for v in self.scheduling
        ]
        ranked = [
            (r.row, str(k + 1), a.ways, f"{a.inflation:.4g}", ", ".join(a.unmeasured))
            for r in self.ranking
            if r.total > 1
            for k, a in enumerate(r.alternatives)
        ]
        columns = ("row", "rank", "term by divisor", "inflation", "unmeasured")
        return card(
            self._title(),
            formulas(self._repr_latex_()),
            Table("", heads, variables) if variables else "",
            self.notes(),
            Table("", columns, ranked) if ranked else "",
        )


@takes(model="Plant")
def quasi_lpv(
    model: Plant,
    prefer: Sequence[Any] | Mapping[Any, Any] | None = None,
    centre: Any = None,
    *,
    alternatives: int = 16,
    penalty: float = 3.0,
    rtol: float = 1e-6,
    effort: str = "normal",
) -> QuasiLPV:
    """Write a plant as x+ = A(rho) x + B(rho) u + offset, exactly.

    Every term of the dynamics and outputs is divided by a signal, or by a linear form of signals,
    with which it vanishes: x1 x2 by x1 or x2, sqrt(h) by h, phi(x1 - x3) by x1 - x3 (two columns).
    What does not vanish at the centre is written by secants in closed form, sqrt(x) - sqrt(c) =
    (x - c) / (sqrt(x) + sqrt(c)), and its value there goes to the offset. Where there is a choice,
    all choices are enumerated and the one with the least velocity inflation is taken, mean over
    the box of sum_j width(A_ij) |x_j - c_j| / range(f_i), with a penalty for coefficients that need
    unmeasured signals; choices whose coefficients have no bound over the box are left out.

    Parameters
    ----------
    model : Plant
        Continuous or discrete.
    prefer : sequence of names, or mapping, optional
        Signals to divide by, the most wanted first, or for single terms what to divide them by,
        ``{"x1*x2": "x2"}``; see ``QuasiLPV.ranking`` for what there is.
    centre : None, "origin", "equilibrium", Equilibrium or (x, u)
        Where deviations are zero; with another centre than the origin the form is
        A(rho) (x - x_c) + B(rho) (u - u_c) + offset.
    alternatives : int
        How many ways to write a row are bounded and ranked.
    penalty : float
        How many times more an entry counts that needs an unmeasured signal.
    rtol : float
        Wanted gap of the ranges of the scheduling variables.
    effort : {"fast", "normal", "tight"}
        Of the interval engine, for these ranges.

    Returns
    -------
    QuasiLPV
        Matrices, scheduling variables with guaranteed ranges, ranking and proof.

    Raises
    ------
    DerivationError
        An option that is not understood; parts that do not add up to the plant.
    StructureError
        A Runge-Kutta step, which has no such form.

    Examples
    --------
    >>> from obsynth.symbolic.plants import hinf_example
    >>> form = quasi_lpv(hinf_example())
    >>> form.offset.T
    Matrix([[3/50, 0, 0]])
    >>> form.A[2, 2]
    13/200 - 33*sinc(x3)/100
    >>> form.proof.holds
    True
    """
    model.check()
    if model.discretisation == "rk4":
        raise StructureError(
            f"a step of {model.discretisation} is no sum of terms that could be divided; use "
            "discretise('euler', Ts), the continuous plant, or jacobian_bounds",
            condition="quasi-LPV",
        )
    if alternatives < 1 or not penalty >= 0.0:
        raise DerivationError(
            f"alternatives= is at least 1 and penalty= not negative; given were {alternatives} and "
            f"{penalty}",
            alternatives=alternatives,
            penalty=penalty,
        )
    point = read_centre(model, centre)
    rows = stacked_rows(model)
    if not point.is_origin:
        rows = decide_signs(rows, model, point)
    terms = prefer_options(model, list_terms(model, rows, point), prefer)
    terms, chosen, rankings, lifts = choose(
        model, rows, terms, point, alternatives, penalty, "fast"
    )
    layout = linear_layout(model)
    proxy = assemble(model, layout, point, terms, chosen)
    matrix = sp.ImmutableMatrix(proxy.xreplace({k.signal.symbol: k.meaning for k in lifts}))
    proof = prove_form(model, matrix, point, rows)
    places = {place: proxy[place] for place in np.ndindex(*proxy.shape) if proxy[place] != 0}
    back = deviations(model, point)
    names = row_names(model)
    left = tuple((names[t.row], t.expression.xreplace(back), t.reason) for t in terms if t.reason)
    schedule = make_schedule(places, model, rtol, effort, lifts)
    ranging = Ranging(proxy, lifts, rtol, effort)
    return QuasiLPV(matrix, layout, schedule, proof, model, point, rankings, left, ranging)


def assemble(
    model: Plant,
    layout: Layout,
    centre: Centre,
    terms: Sequence[Term],
    chosen: Sequence[Option],
) -> sp.Matrix:
    """Add the chosen options of all terms up."""
    rows, columns = layout.shape
    total = sp.zeros(rows, columns)
    for term, option in zip(terms, chosen, strict=True):
        for share in option.shares:
            total[term.row, share.position] += share.bounded
        total[term.row, columns - 1] += option.rest
    back = deviations(model, centre)
    return sp.ImmutableMatrix(total.applyfunc(lambda e: e.xreplace(back)))


def prove_form(
    model: Plant, matrix: sp.Matrix, centre: Centre, rows: Sequence[sp.Expr]
) -> FormProof:
    """Show row by row that a stacked matrix is the plant."""
    back = deviations(model, centre)
    signals = [s.symbol for kind in "xudfw" for s in getattr(model, kind)]
    column = [*(back.get(s, s) for s in signals), sp.Integer(1)]
    return prove_rows(matrix, column, rows, row_names(model), model.signals)
