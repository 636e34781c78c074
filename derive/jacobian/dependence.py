"""Affine dependences between the entries of a matrix function: proposed by numbers, proved exactly.

The rank of centred, scaled samples tells which entries can be written through which others. The
coefficients then come from the exact expressions, compared monomial by monomial, and the
dependence counts only when the difference is proved to be identically zero.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import sympy as sp

from obsynth.derive.algebra.factorise import expand_terms
from obsynth.derive.algebra.zero_test import is_zero
from obsynth.symbolic.arrays import FloatArray

Entry = tuple[int, int]
_RANK_TOLERANCE = 1e-8
_LARGEST_DENOMINATOR = 1000
_ROUNDING = 1e-14


def entry_name(entry: Entry, name: str = "m") -> str:
    """Return what an entry is called in texts, counted from 1. Shapes: entry (int, int)."""
    i, j = entry[0] + 1, entry[1] + 1
    return f"{name}{i}{j}" if max(i, j) < 10 else f"{name}{i},{j}"


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
    size : float
        Largest magnitude of the entry at the samples; the text does not add constants to it that
        the rounding of a matrix has left.
    """

    entry: Entry
    coefficients: dict[Entry, sp.Expr]
    constant: sp.Expr
    proof: str
    shared: tuple[str, ...]
    name: str = "m"
    size: float = 0.0

    def __str__(self) -> str:
        terms = []
        for other, coefficient in self.coefficients.items():
            number = float(coefficient.evalf(17))
            factor = {1.0: "", -1.0: "-"}.get(number, f"{number:.6g} ")
            terms.append(f"{factor}{entry_name(other, self.name)}")
        constant = float(sp.N(self.constant, 17))
        small = bool(terms) and abs(constant) <= _ROUNDING * self.size
        if not terms or (constant != 0.0 and not small):
            terms.append(f"{constant:.6g}")
        text = " + ".join(terms).replace("+ -", "- ")
        if constant != 0.0 and small:
            text += f" up to {abs(constant):.1e}"
        reason = (
            f"both depend on {', '.join(self.shared)} only"
            if len(self.coefficients) == 1
            else (f"all depend on {', '.join(self.shared)}" if self.coefficients else "constant")
        )
        left = entry_name(self.entry, self.name)
        return f"{left} = {text}: {reason}; difference proved zero ({self.proof})"


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
    values = [sp.radsimp(value) for value in next(iter(solutions))]
    return None if any(v.free_symbols for v in values) else values


def find_dependences(
    entries: Mapping[Entry, sp.Expr],
    samples: Mapping[Entry, FloatArray],
    variables: Sequence[sp.Symbol],
    name: str = "m",
) -> tuple[list[Entry], list[AffineDependence]]:
    """Split entries into independent ones and ones that depend affinely on them."""
    known = set(variables)
    if any(len(values) <= len(entries) for values in samples.values()):
        return sorted(entries), []
    basis: list[Entry] = []
    columns: list[FloatArray] = []
    dependences: list[AffineDependence] = []
    prover = _Prover(entries, known, name)
    for entry in sorted(entries, key=lambda e: _preferred(e, entries[e], known)):
        centred = samples[entry] - samples[entry].mean()
        size = float(np.linalg.norm(centred))
        floor = _RANK_TOLERANCE * max(float(np.abs(samples[entry]).max(initial=0.0)), 1e-300)
        proved: AffineDependence | None
        if size <= floor * np.sqrt(len(centred)):
            proved = prover.constant(entry)
        else:
            matrix = np.array(columns).T if columns else np.zeros((len(centred), 0))
            scale = np.linalg.norm(matrix, axis=0)
            weights = np.linalg.lstsq(matrix / scale, centred / size, rcond=None)[0]
            proved = None
            if np.linalg.norm(centred / size - matrix / scale @ weights) <= _RANK_TOLERANCE:
                used = np.flatnonzero(np.abs(weights) > _RANK_TOLERANCE)
                guess = {basis[k]: float(weights[k] * size / scale[k]) for k in used}
                proved = prover.combination(entry, guess)
        if proved is None:
            basis.append(entry)
            columns.append(centred if size > 0.0 else np.ones_like(centred))
        else:
            largest = float(np.abs(samples[entry]).max(initial=0.0))
            dependences.append(replace(proved, size=largest))
    return sorted(basis), sorted(dependences, key=lambda d: d.entry)


class _Prover:
    """Turns a proposed dependence into a proved one."""

    def __init__(
        self, entries: Mapping[Entry, sp.Expr], variables: set[sp.Symbol], name: str
    ) -> None:
        self.entries, self.variables, self.name = entries, variables, name
        self.parts = {e: _monomials(expression, variables) for e, expression in entries.items()}

    def constant(self, entry: Entry) -> AffineDependence | None:
        return self._accept(entry, {})

    def combination(self, entry: Entry, guess: Mapping[Entry, float]) -> AffineDependence | None:
        exact = _solve(self.parts[entry], [self.parts[other] for other in guess])
        if exact is not None:
            return self._accept(entry, dict(zip(guess, exact, strict=True)))
        # equal functions in different words: short rational coefficients are worth a try
        limit = _LARGEST_DENOMINATOR
        near = {e: Fraction(value).limit_denominator(limit) for e, value in guess.items()}
        if any(abs(float(f) - guess[e]) > 1e-7 * abs(guess[e]) for e, f in near.items()):
            return None
        return self._accept(
            entry, {e: sp.Rational(f.numerator, f.denominator) for e, f in near.items()}
        )

    def _accept(self, entry: Entry, coefficients: dict[Entry, sp.Expr]) -> AffineDependence | None:
        combined = sum((c * self.entries[e] for e, c in coefficients.items()), sp.Integer(0))
        difference = self.entries[entry] - combined
        rest = sp.expand(difference)
        if rest.free_symbols & self.variables:
            rest = sp.simplify(rest)
            if rest.free_symbols & self.variables:
                return None
        proof = is_zero(difference - rest)
        if not proof:
            return None
        involved = (entry, *coefficients)
        shared = {s for e in involved for s in self.entries[e].free_symbols & self.variables}
        return AffineDependence(
            entry, coefficients, rest, proof, tuple(sorted(map(str, shared))), self.name
        )
