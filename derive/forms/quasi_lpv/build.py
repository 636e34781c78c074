"""From a plant to its quasi-LPV form."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import sympy as sp

from obsynth.derive.algebra.zero_test import FormProof
from obsynth.derive.errors import DerivationError, StructureError
from obsynth.derive.forms.quasi_lpv.form import QuasiLPV, linear_layout
from obsynth.derive.forms.quasi_lpv.interval_form import Ranging
from obsynth.derive.forms.quasi_lpv.options import Option
from obsynth.derive.forms.quasi_lpv.ranking import choose
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
from obsynth.derive.forms.scheduling import make_schedule
from obsynth.derive.forms.varying import Layout, prove_rows
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.taking import takes


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
