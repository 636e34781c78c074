"""Affine dependences between the entries of a matrix function: proposed by numbers, proved exactly.

The rank of centred, scaled samples tells which entries can be written through which others. The
coefficients then come from the exact expressions, compared monomial by monomial, and the
dependence counts only when the difference is proved to be identically zero.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import sympy as sp
from numpy.typing import NDArray

from obsynth.derive.exact import is_zero
from obsynth.derive.factorise import expand_terms

__all__ = ["AffineDependence", "find_dependences"]

Array = NDArray[np.float64]
Entry = tuple[int, int]
_RANK_TOLERANCE = 1e-8


@dataclass(frozen=True, eq=False)
class AffineDependence:
    """An entry that is an affine function of others, with the proof.

    Attributes
    ----------
    entry : (int, int)
        Row and column, from 0.
    coefficients : dict of (int, int) to sympy.Expr
        Exact coefficient of every entry it is written through; empty for a constant entry.
    constant : sympy.Expr
        Exact constant.
    proof : str
        How the difference was proved to be zero.
    shared : tuple of str
        Names of the variables on which the entries depend.
    name : str
        How entries are called, for the text.
    """

    entry: Entry
    coefficients: dict[Entry, sp.Expr]
    constant: sp.Expr
    proof: str
    shared: tuple[str, ...]
    name: str = "m"

    def __str__(self) -> str:
        def call(entry: Entry) -> str:
            return f"{self.name}{entry[0] + 1}{entry[1] + 1}"

        terms = []
        for other, coefficient in self.coefficients.items():
            number = float(coefficient.evalf(17))
            factor = {1.0: "", -1.0: "-"}.get(number, f"{number:.6g} ")
            terms.append(f"{factor}{call(other)}")
        constant = float(sp.N(self.constant, 17))
        if constant != 0.0 or not terms:
            terms.append(f"{constant:.6g}")
        text = " + ".join(terms).replace("+ -", "- ")
        reason = (
            f"both depend on {', '.join(self.shared)} only"
            if len(self.coefficients) == 1
            else (f"all depend on {', '.join(self.shared)}" if self.coefficients else "constant")
        )
        return f"{call(self.entry)} = {text}: {reason}; difference proved zero ({self.proof})"


def _monomials(entry: sp.Expr, variables: set[sp.Symbol]) -> dict[sp.Expr, sp.Expr]:
    """Coefficients of the products of non-constant factors; the constant stands at 1."""
    found: dict[sp.Expr, sp.Expr] = {}
    for term in expand_terms(entry):
        coefficient, monomial = term.as_independent(*variables, as_Add=False)
        found[monomial] = found.get(monomial, sp.Integer(0)) + coefficient
    return found


def _preferred(entry: Entry, expression: sp.Expr, variables: set[sp.Symbol]) -> tuple[int, ...]:
    """Few variables first, since such scalars are independent; then the diagonal."""
    count = len(expression.free_symbols & variables)
    return (count, int(entry[0] != entry[1]), *entry)


def _solve(
    target: Mapping[sp.Expr, sp.Expr], basis: Sequence[Mapping[sp.Expr, sp.Expr]]
) -> list[sp.Expr] | None:
    one = sp.Integer(1)
    monomials = sorted(
        {m for part in (target, *basis) for m in part} - {one}, key=sp.default_sort_key
    )
    zero = sp.Integer(0)
    unknowns = [sp.Dummy() for _ in basis]
    equations = [
        sum((c * part.get(m, zero) for c, part in zip(unknowns, basis, strict=True)), zero)
        - target.get(m, zero)
        for m in monomials
    ]
    solutions = sp.linsolve(equations, unknowns)
    if not solutions:
        return None
    values = [
        sp.radsimp(sp.nsimplify(v)) if v.is_Rational else sp.radsimp(v)
        for v in next(iter(solutions))
    ]
    return None if any(v.free_symbols for v in values) else values


def find_dependences(
    entries: Mapping[Entry, sp.Expr],
    samples: Mapping[Entry, Array],
    variables: Sequence[sp.Symbol],
    name: str = "m",
) -> tuple[list[Entry], list[AffineDependence]]:
    """Split entries into independent ones and ones that depend affinely on them.

    Parameters
    ----------
    entries : mapping of (row, column) to sympy.Expr
        Exact expressions without floating-point numbers.
    samples : mapping of (row, column) to ndarray, shape (N,)
        Their values at N points of the box.
    variables : sequence of sympy.Symbol
        The variables.
    name : str
        How entries are called in texts.

    Returns
    -------
    basis : list of (row, column)
        Entries that are not known to depend on others, in order of rows.
    dependences : list of AffineDependence
        One for every other entry, proved.

    Examples
    --------
    >>> x = sp.Symbol("x", real=True)
    >>> at = np.linspace(1, 2, 9)
    >>> entries = {(0, 0): sp.sin(x), (1, 0): 3 - 2 * sp.sin(x)}
    >>> samples = {(0, 0): np.sin(at), (1, 0): 3 - 2 * np.sin(at)}
    >>> basis, found = find_dependences(entries, samples, [x])
    >>> basis, str(found[0])
    ([(0, 0)], 'm21 = -2 m11 + 3: both depend on x only; difference proved zero (syntactic)')
    """
    known = set(variables)
    if any(len(values) <= len(entries) for values in samples.values()):
        return sorted(entries), []
    basis: list[Entry] = []
    columns: list[Array] = []
    dependences: list[AffineDependence] = []
    parts = {entry: _monomials(expression, known) for entry, expression in entries.items()}
    for entry in sorted(entries, key=lambda e: _preferred(e, entries[e], known)):
        expression = entries[entry]
        centred = samples[entry] - samples[entry].mean()
        size = float(np.linalg.norm(centred))
        floor = _RANK_TOLERANCE * max(float(np.abs(samples[entry]).max(initial=0.0)), 1e-300)
        if size <= floor * np.sqrt(len(centred)):
            candidates: list[Entry] = []
        else:
            matrix = np.array(columns).T if columns else np.zeros((len(centred), 0))
            unit = centred / size
            weights = np.linalg.lstsq(matrix, unit, rcond=None)[0]
            if np.linalg.norm(unit - matrix @ weights) > _RANK_TOLERANCE:
                basis.append(entry)
                columns.append(unit)
                continue
            candidates = [
                b for b, c in zip(basis, weights, strict=True) if abs(c) > _RANK_TOLERANCE
            ]
        proved = _prove(entry, expression, candidates, entries, parts, known, name)
        if proved is None:
            basis.append(entry)
            columns.append(centred / size if size > 0.0 else centred)
        else:
            dependences.append(proved)
    return sorted(basis), sorted(dependences, key=lambda d: d.entry)


def _prove(
    entry: Entry,
    expression: sp.Expr,
    candidates: list[Entry],
    entries: Mapping[Entry, sp.Expr],
    parts: Mapping[Entry, Mapping[sp.Expr, sp.Expr]],
    variables: set[sp.Symbol],
    name: str,
) -> AffineDependence | None:
    values = _solve(parts[entry], [parts[c] for c in candidates]) if candidates else []
    if values is None:
        return None
    combined = sum((v * entries[c] for v, c in zip(values, candidates, strict=True)), sp.Integer(0))
    rest = sp.expand(expression - combined)
    if rest.free_symbols & variables:
        rest = sp.simplify(rest)
        if rest.free_symbols & variables:
            return None
    proof = is_zero(expression - combined - rest)
    if not proof:
        return None
    shared = sorted(
        {str(s) for c in (entry, *candidates) for s in entries[c].free_symbols & variables}
    )
    return AffineDependence(
        entry, dict(zip(candidates, values, strict=True)), rest, proof, tuple(shared), name
    )
