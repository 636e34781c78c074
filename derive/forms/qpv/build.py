"""From a plant to its quadratic parameter-varying form."""

from typing import Any, Literal

import sympy as sp

from obsynth.derive.algebra.zero_test import FormProof
from obsynth.derive.errors import DerivationError, StructureError
from obsynth.derive.forms.qpv.augment import Augmented, augment_plant
from obsynth.derive.forms.qpv.form import QPV, QPVLayout
from obsynth.derive.forms.qpv.polynomial import read_coefficients
from obsynth.derive.forms.scheduling import make_schedule
from obsynth.derive.forms.varying import prove_rows
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.taking import takes


@takes(model="Plant")
def qpv(
    model: Plant,
    form_of_N: Literal["upper", "symmetric"] = "upper",
    *,
    augment: Any = "process",
    effectiveness: Any = (),
    rtol: float = 1e-6,
    effort: str = "normal",
) -> QPV:
    """Write a plant as a quadratic system, with faults as states where they multiply states.

    Section 2 of Rotondo, Buciakowski and Witczak.

    Parameters
    ----------
    model : Plant
        Continuous or discrete; polynomial of degree 2 in states, inputs and added faults.
    form_of_N : {"upper", "symmetric"}
        Whether x_a x_b, a < b, stands above the diagonal of N_i, as in the paper, or half on
        either side. The dynamics are the same, but LMIs that use N_i and N_i + N_i' apart are not.
    augment : {"process", "all", "none"} or sequence of names
        Faults that become states with f' = 0; process faults by default.
    effectiveness : True, sequence of input names, or mapping of names to ranges
        Inputs that may lose effectiveness, B (I - diag(phi)) u; every phi is a further state.
    rtol, effort
        Of the ranges of scheduling variables.

    Returns
    -------
    QPV
        c, A, N_i, M_j (state-by-input terms), B, D, B_f, G, C, H, their vertices and the proof.

    Raises
    ------
    StructureError
        A term that has no place in a quadratic system; row, term and degree are named.
    DerivationError
        An option that is not understood.

    Examples
    --------
    >>> from obsynth.symbolic.plants import qpv_example
    >>> form = qpv(qpv_example())
    >>> form.N[1][1, :], form.A[0, :]
    (Matrix([[0, 0, 0, 0, 1, 0]]), Matrix([[-theta1 - 4, 10, 2*theta2 + 2, 0, 0, 0]]))
    >>> form.proof.holds
    True
    """
    if form_of_N not in ("upper", "symmetric"):
        raise DerivationError(
            f"form_of_N={form_of_N!r} is not known; choose 'upper' or 'symmetric'",
            form_of_N=form_of_N,
        )
    model.check()
    if model.discretisation not in (None, "euler"):
        raise StructureError(
            f"a step of {model.discretisation} raises the degree of a plant that is not linear; "
            "use discretise('euler', Ts) or the continuous plant",
            condition="degree",
            degree=None,
        )
    plant = augment_plant(model, augment, effectiveness)
    signals = (plant.states, plant.outputs, model.u, model.d, plant.faults, model.w)
    layout = QPVLayout.of(*map(len, signals))
    entries = read_coefficients(plant, layout, form_of_N)
    matrix = sp.zeros(*layout.shape)
    for place, value in entries.items():
        matrix[place] = value
    matrix = sp.ImmutableMatrix(matrix)
    proof = prove_quadratic(plant, layout, matrix)
    schedule = make_schedule(entries, model, rtol, effort)
    return QPV(matrix, layout, schedule, proof, plant, form_of_N)


def prove_quadratic(plant: Augmented, layout: QPVLayout, matrix: sp.Matrix) -> FormProof:
    """Show row by row that a stacked matrix is the augmented plant."""
    model = plant.model
    x = [s.symbol for s in plant.states]
    u = [s.symbol for s in model.u]
    rest = [s.symbol for group in (model.d, plant.faults, model.w) for s in group]
    column = [sp.Integer(1), *x, *(a * b for a in x for b in x), *(v * a for v in u for a in x)]
    column += [*u, *rest]
    names = (*(s.name for s in plant.states), *model.output_names)
    signals = (*plant.states, *model.signals)
    return prove_rows(matrix, column, (*plant.rows, *plant.outputs), names, signals)
