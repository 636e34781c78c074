"""Coefficients of quadratic systems: every monomial of every row to its matrix."""

from collections.abc import Sequence
from dataclasses import dataclass

import sympy as sp

from obsynth.derive.algebra.factorise import expand_terms
from obsynth.derive.errors import StructureError
from obsynth.derive.forms.qpv.augment import Augmented
from obsynth.derive.forms.qpv.form import QPVLayout

_KINDS = ("states", "inputs", "unknown inputs", "faults", "disturbances")


@dataclass(frozen=True, eq=False)
class _Monomial:
    """A product of powers of signals with its coefficient, as positions by kind."""

    coefficient: sp.Expr
    positions: tuple[tuple[int, ...], ...]

    def degrees(self) -> tuple[int, ...]:
        return tuple(len(p) for p in self.positions)


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

    for i, row in enumerate(plant.rows):
        for term in expand_terms(row):
            for monomial in _monomials(term, groups, names[i]):
                for column, share in _columns(monomial, layout, form_of_N):
                    add(i, column, share * monomial.coefficient)
                if not _columns(monomial, layout, form_of_N):
                    raise _too_high(term, groups, names[i], monomial, "dynamics")
    for k, row in enumerate(plant.outputs):
        name = model.output_names[k]
        for term in expand_terms(row):
            for monomial in _monomials(term, groups, name):
                if sum(monomial.degrees()) > 1:
                    raise _too_high(term, groups, name, monomial, "outputs")
                for column, share in _columns(monomial, layout, form_of_N):
                    add(len(plant.rows) + k, column, share * monomial.coefficient)
    return {place: value for place, value in found.items() if sp.expand(value) != 0}


def _monomials(term: sp.Expr, groups: Sequence[Sequence[sp.Symbol]], row: str) -> list[_Monomial]:
    generators = [symbol for group in groups for symbol in group]
    present = [s for s in generators if term.has(s)]
    if not present:
        return [_Monomial(term, ((),) * len(groups))]
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
        result.append(_Monomial(coefficient, positions))
    return result


def _columns(monomial: _Monomial, layout: QPVLayout, form_of_N: str) -> list[tuple[int, sp.Expr]]:
    """Columns of the stacked matrix for a monomial, with the share of its coefficient."""
    one, half = sp.Integer(1), sp.Rational(1, 2)
    states, inputs = monomial.positions[:2]
    match monomial.degrees():
        case (0, 0, 0, 0, 0):
            return [(layout.start("c"), one)]
        case (1, 0, 0, 0, 0):
            return [(layout.start("A") + states[0], one)]
        case (2, 0, 0, 0, 0):
            a, b = states
            if a == b or form_of_N == "upper":
                return [(layout.quadratic(a, b), one)]
            return [(layout.quadratic(a, b), half), (layout.quadratic(b, a), half)]
        case (1, 1, 0, 0, 0):
            return [(layout.start("M") + inputs[0] * layout.states + states[0], one)]
        case (0, 1, 0, 0, 0):
            return [(layout.start("B") + inputs[0], one)]
        case (0, 0, 1, 0, 0):
            return [(layout.start("D") + monomial.positions[2][0], one)]
        case (0, 0, 0, 1, 0):
            return [(layout.start("B_f") + monomial.positions[3][0], one)]
        case (0, 0, 0, 0, 1):
            return [(layout.start("G") + monomial.positions[4][0], one)]
    return []


def _not_polynomial(term: sp.Expr, present: Sequence[sp.Symbol], row: str) -> StructureError:
    names = ", ".join(map(str, present))
    return StructureError(
        f"the row of {row} has the term {term}, which is no polynomial in {names}; a quadratic "
        "form needs polynomials of degree 2 at most. Use quasi_lpv or jacobian_bounds for this "
        "plant",
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
    monomial: _Monomial,
    where: str,
) -> StructureError:
    parts = []
    for kind, group, positions in zip(_KINDS, groups, monomial.positions, strict=True):
        if positions:
            listed = ", ".join(dict.fromkeys(str(group[k]) for k in positions))
            parts.append(f"{len(positions)} in the {kind} {listed}")
    total = sum(monomial.degrees())
    if where == "outputs":
        allowed = "outputs have to be affine in states and signals"
    else:
        allowed = (
            "there is place for 1, x, x x, x u, u and for unknown inputs, faults and disturbances "
            "on their own"
        )
        if monomial.degrees()[3] and sum(monomial.degrees()) > 1:
            allowed += "; a fault that multiplies others has to become a state (augment=)"
    return StructureError(
        f"the row of {row} has the term {term} of degree {total} ({'; '.join(parts)}); {allowed}",
        row=row,
        term=term,
        degree=total,
        condition="degree",
    )
