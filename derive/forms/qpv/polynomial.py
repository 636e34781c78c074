"""Coefficients of quadratic systems: every monomial of every row to its matrix."""

from collections.abc import Sequence

import sympy as sp

from obsynth.derive.algebra.factorise import expand_terms
from obsynth.derive.algebra.sizes import text
from obsynth.derive.errors import StructureError
from obsynth.derive.forms.qpv.augment import Augmented
from obsynth.derive.forms.qpv.form import QPVLayout

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
