"""From a plant to its quadratic parameter-varying form: every monomial to its matrix."""

from collections.abc import Sequence
from typing import Any, Literal

import sympy as sp

from obsynth.derive.algebra.factorise import expand_terms
from obsynth.derive.algebra.sizes import text
from obsynth.derive.algebra.zero_test import FormProof
from obsynth.derive.errors import DerivationError, StructureError
from obsynth.derive.forms.qpv.augment import Augmented, augment_plant
from obsynth.derive.forms.qpv.form import QPV, QPVLayout
from obsynth.derive.forms.scheduling import make_schedule
from obsynth.derive.forms.varying import prove_rows
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.taking import takes

_KINDS = ("states", "inputs", "unknown inputs", "faults", "disturbances")


Monomial = tuple[sp.Expr, tuple[tuple[int, ...], ...]]
"""A coefficient, and the positions of the signals that it is multiplied by, kind by kind."""


def read_coefficients(
    plant: Augmented, layout: QPVLayout, form_of_N: str
) -> dict[tuple[int, int], sp.Expr]:
    """Sort the monomials of all rows into the matrices of a quadratic system."""
    model = plant.model
    groups = [
        [s.symbol for s in plant.states],
        [s.symbol for s in model.u],
        [s.symbol for s in model.d],
        [s.symbol for s in plant.faults],
        [s.symbol for s in model.w],
    ]
    names = [s.name for s in plant.states]
    found: dict[tuple[int, int], sp.Expr] = {}

    def add(row: int, column: int, value: sp.Expr) -> None:
        found[(row, column)] = found.get((row, column), sp.Integer(0)) + value

    named = zip((*names, *model.output_names), (*plant.rows, *plant.outputs), strict=True)
    for i, (name, row) in enumerate(named):
        dynamics = i < len(names)
        for term in expand_terms(row):
            for coefficient, positions in _monomials(term, groups, name):
                columns = _columns(positions, layout, form_of_N)
                if not columns or not (dynamics or sum(map(len, positions)) <= 1):
                    raise _too_high(term, groups, name, positions, dynamics)
                for column, share in columns:
                    add(i, column, share * coefficient)
    return {place: value for place, value in found.items() if sp.expand(value) != 0}


def _monomials(term: sp.Expr, groups: Sequence[Sequence[sp.Symbol]], row: str) -> list[Monomial]:
    generators = [symbol for group in groups for symbol in group]
    present = [s for s in generators if term.has(s)]
    if not present:
        return [(term, ((),) * len(groups))]
    try:
        polynomial = sp.Poly(term, *present)
    except sp.PolynomialError as error:
        raise _not_polynomial(term, present, row) from error
    inner = polynomial.as_expr().free_symbols - set(present)
    if any(c.free_symbols & set(present) for c in polynomial.coeffs()) or not inner <= (
        term.free_symbols
    ):
        raise _not_polynomial(term, present, row)
    result = []
    for powers, coefficient in polynomial.terms():
        power = dict(zip(present, powers, strict=True))
        positions = tuple(
            tuple(k for k, s in enumerate(group) for _ in range(power.get(s, 0)))
            for group in groups
        )
        result.append((coefficient, positions))
    return result


def _columns(
    positions: tuple[tuple[int, ...], ...], layout: QPVLayout, form_of_N: str
) -> list[tuple[int, sp.Expr]]:
    """Columns of the stacked matrix for a monomial, with the share of its coefficient."""
    one, half = sp.Integer(1), sp.Rational(1, 2)
    states, inputs = positions[:2]
    match states, inputs, sum(map(len, positions)):
        case (), (), 0:
            return [(layout.start("c"), one)]
        case (a, b), (), 2:
            if a == b or form_of_N == "upper":
                return [(layout.quadratic(a, b), one)]
            return [(layout.quadratic(a, b), half), (layout.quadratic(b, a), half)]
        case (a,), (j,), 2:
            return [(layout.start("M") + j * layout.states + a, one)]
        case _, _, 1:
            pairs = zip(("A", "B", "D", "B_f", "G"), positions, strict=True)
            return [(layout.start(block) + at[0], one) for block, at in pairs if at]
    return []


def _not_polynomial(term: sp.Expr, present: Sequence[sp.Symbol], row: str) -> StructureError:
    names = ", ".join(map(str, present))
    return StructureError(
        f"the row of {row} has the term {text(term)}, which is no polynomial in {names}; a "
        "quadratic form needs polynomials of degree 2 at most. Use quasi_lpv or jacobian_bounds "
        "for this plant",
        row=row,
        term=term,
        degree=None,
        symbol=names,
        condition="polynomial",
    )


def _too_high(
    term: sp.Expr,
    groups: Sequence[Sequence[sp.Symbol]],
    row: str,
    positions: tuple[tuple[int, ...], ...],
    dynamics: bool,
) -> StructureError:
    parts = []
    for kind, group, own in zip(_KINDS, groups, positions, strict=True):
        if own:
            listed = ", ".join(dict.fromkeys(str(group[k]) for k in own))
            parts.append(f"{len(own)} in the {kind} {listed}")
    total = sum(map(len, positions))
    if not dynamics:
        allowed = "outputs have to be affine in states and signals"
    else:
        allowed = (
            "there is place for 1, x, x x, x u, u and for unknown inputs, faults and disturbances "
            "on their own"
        )
        if positions[3] and total > 1:
            allowed += "; a fault that multiplies others has to become a state (augment=)"
    return StructureError(
        f"the row of {row} has the term {text(term)} of degree {total} "
        f"({'; '.join(parts)}); {allowed}",
        row=row,
        term=term,
        degree=total,
        condition="degree",
    )


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
