"""Families of matrices that are affine in independent scalars, and what makes entries depend.

Dependences are proposed by the rank of centred, scaled samples and proved exactly, from the
expressions, monomial by monomial.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import product

import numpy as np
import sympy as sp

from obsynth.derive.algebra.factorise import expand_terms
from obsynth.derive.algebra.sizes import expanded, simplified
from obsynth.derive.algebra.zero_test import is_zero, varies
from obsynth.derive.errors import DerivationError
from obsynth.derive.rigour import UNIT_ROUNDOFF, round_number, up
from obsynth.symbolic.arrays import FloatArray

Entry = tuple[int, int]
_MOST_SCALARS = 16


@dataclass(frozen=True, eq=False)
class AffineFamily:
    """Matrices constant + sum_k s_k directions_k, s_k in ranges_k, up to an elementwise radius.

    The family holds the Jacobian at every point of the box and is convex, so that it holds the
    matrix M of g(a) - g(b) = M (a - b) as well, with its dependences between rows.

    constant (n, k): part that does not vary
    directions (K, n, k): one matrix per independent scalar; 1 at the entry that is the scalar
    ranges (K, 2): guaranteed ranges of the scalars
    radius (n, k): what the rounding of the coefficients and of the vertices may cost, elementwise
    labels: what every scalar is
    exact: true when no matrix of the family is superfluous: the scalars depend on disjoint sets of
        variables, so that they take their values independently of each other. False: an outer box
    """

    constant: FloatArray
    directions: FloatArray
    ranges: FloatArray
    radius: FloatArray
    labels: tuple[str, ...]
    exact: bool

    @property
    def midpoint(self) -> FloatArray:
        """Matrix at the middle of all ranges, shape (n, k)."""
        return self.constant + np.tensordot(self.ranges.mean(axis=1), self.directions, axes=1)

    @property
    def half_ranges(self) -> FloatArray:
        """Half widths of the ranges, shape (K,)."""
        return 0.5 * (self.ranges[:, 1] - self.ranges[:, 0])

    @property
    def vertex_count(self) -> int:
        """Number of vertices, without making them."""
        return 1 << int((self.ranges[:, 1] > self.ranges[:, 0]).sum())

    def at(self, scalars: Sequence[float] | FloatArray) -> FloatArray:
        """Matrix (n, k) for given scalars, (K,), to within the radius."""
        matrix = self.constant.copy()
        for value, direction in zip(scalars, self.directions, strict=True):
            matrix = matrix + value * direction
        return matrix

    def vertices(self) -> FloatArray:
        """Matrices at the corners of the ranges, (N, n, k); DerivationError beyond 2^16 of them.

        N = 2^K for K scalars with a range of positive width, the last fastest, lower ends first.
        """
        if self.vertex_count > 2**_MOST_SCALARS:
            raise DerivationError(
                f"the family has {self.vertex_count} vertices, more than a polytopic design can "
                f"use; fix or drop some of the {len(self.ranges)} scalars, or use the entrywise "
                "bounds",
                vertices=self.vertex_count,
            )
        ends = [sorted(set(pair)) for pair in self.ranges.tolist()]
        corners = [self.at(corner) for corner in product(*ends)]
        return np.array(corners).reshape(-1, *self.constant.shape)

    def room(self, other: AffineFamily) -> float:
        """By how much the ranges of another family leave these, negative; -inf for other counts."""
        mine, its = self.ranges, other.ranges
        if mine.shape != its.shape:
            return -np.inf
        return float(np.minimum(its[:, 0] - mine[:, 0], mine[:, 1] - its[:, 1]).min(initial=0.0))

    def covers(self, other: AffineFamily) -> bool:
        """Whether a family holds another one, of the same constant and directions."""
        return bool(
            self.directions.shape == other.directions.shape
            and np.array_equal(self.directions, other.directions)
            and np.array_equal(self.constant, other.constant)
            and np.all(self.radius >= other.radius)
            and np.all(self.ranges[:, 0] <= other.ranges[:, 0])
            and np.all(self.ranges[:, 1] >= other.ranges[:, 1])
        )


def build_family(
    shape: tuple[int, int],
    basis: Sequence[Entry],
    dependences: Sequence[AffineDependence],
    ranges: Mapping[Entry, tuple[float, float]],
    supports: Mapping[Entry, tuple[str, ...]],
) -> AffineFamily:
    """Assemble the family from independent entries and proved dependences.

    Shapes: shape (int, int).
    """
    constant, radius = np.zeros(shape), np.zeros(shape)
    directions = np.zeros((len(basis), *shape))
    position = {entry: k for k, entry in enumerate(basis)}
    for entry, k in position.items():
        directions[k][entry] = 1.0
    for dependence in dependences:
        entry = dependence.entry
        constant[entry], error = round_number(dependence.constant)
        magnitude = abs(constant[entry])
        for other, coefficient in dependence.coefficients.items():
            value, distance = round_number(coefficient)
            directions[position[other]][entry] = value
            largest = max(abs(ranges[other][0]), abs(ranges[other][1]))
            error += distance * largest
            magnitude += abs(value) * largest
        operations = 2 * len(dependence.coefficients)
        exact_sum = len(dependence.coefficients) == 0 or (
            len(dependence.coefficients) == 1
            and constant[entry] == 0.0
            and abs(float(next(iter(dependence.coefficients.values())))) == 1.0
        )
        if not exact_sum:
            error += operations * UNIT_ROUNDOFF * magnitude
        if error > 0.0:
            radius[entry] = up(error * (1.0 + 16 * UNIT_ROUNDOFF))
    names = [name for entry in basis for name in set(supports[entry])]
    disjoint = len(names) == len(set(names))
    labels = tuple(f"{entry_name(entry)}({', '.join(supports[entry])})" for entry in basis)
    return AffineFamily(
        constant,
        directions,
        np.array([ranges[entry] for entry in basis]).reshape(len(basis), 2),
        radius,
        labels,
        disjoint,
    )


_RANK_TOLERANCE = 1e-8
_LARGEST_DENOMINATOR = 1000
_ROUNDING = 1e-14


def entry_name(entry: Entry) -> str:
    """Return what an entry is called in texts, counted from 1. Shapes: entry (int, int)."""
    i, j = entry[0] + 1, entry[1] + 1
    return f"m{i}{j}" if max(i, j) < 10 else f"m{i},{j}"


@dataclass(frozen=True, eq=False)
class AffineDependence:
    """An entry that is an affine function of others, with the proof that the difference is zero.

    shared: names of the variables on which the entries depend
    size: largest magnitude at the samples; the text drops constants that only rounding has left
    """

    entry: Entry
    coefficients: dict[Entry, sp.Expr]
    constant: sp.Expr
    proof: str
    shared: tuple[str, ...]
    size: float = 0.0

    def __str__(self) -> str:
        terms = []
        for other, coefficient in self.coefficients.items():
            number = float(coefficient.evalf(17))
            factor = {1.0: "", -1.0: "-"}.get(number, f"{number:.6g} ")
            terms.append(f"{factor}{entry_name(other)}")
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
        left = entry_name(self.entry)
        return f"{left} = {text}: {reason}; difference proved zero ({self.proof})"


def monomials(entry: sp.Expr, variables: set[sp.Symbol]) -> dict[sp.Expr, sp.Expr]:
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
) -> tuple[list[Entry], list[AffineDependence]]:
    """Split entries into independent ones and ones that depend affinely on them."""
    known = set(variables)
    if any(len(values) <= len(entries) for values in samples.values()):
        return sorted(entries), []
    basis: list[Entry] = []
    columns: list[FloatArray] = []
    units: list[float] = []
    dependences: list[AffineDependence] = []
    prover = _Prover(entries, known)
    for entry in sorted(entries, key=lambda e: _preferred(e, entries[e], known)):
        # in units of the largest value: the square of exp(400) is no double, nor that of exp(-400)
        largest = float(np.abs(samples[entry]).max(initial=0.0))
        unit = max(largest, 1e-300)
        centred = samples[entry] / unit
        centred -= centred.mean()
        size = float(np.linalg.norm(centred))
        guess: dict[Entry, float] | None = {}
        if size > _RANK_TOLERANCE * np.sqrt(len(centred)):
            matrix = np.array(columns).T if columns else np.zeros((len(centred), 0))
            scale = np.linalg.norm(matrix, axis=0)
            weights = np.linalg.lstsq(matrix / scale, centred / size, rcond=None)[0]
            near = np.linalg.norm(centred / size - matrix / scale @ weights) <= _RANK_TOLERANCE
            used = np.flatnonzero(np.abs(weights) > _RANK_TOLERANCE)
            share = weights * size / scale
            guess = {basis[k]: float(share[k]) * (unit / units[k]) for k in used} if near else None
        proved = None if guess is None else prover.prove(entry, guess)
        if proved is None:
            basis.append(entry)
            columns.append(centred if size > 0.0 else np.ones_like(centred))
            units.append(unit)
        else:
            dependences.append(replace(proved, size=largest))
    return sorted(basis), sorted(dependences, key=lambda d: d.entry)


class _Prover:
    """Turns a proposed dependence into a proved one."""

    def __init__(self, entries: Mapping[Entry, sp.Expr], variables: set[sp.Symbol]) -> None:
        self.entries, self.variables = entries, variables
        self.parts = {e: monomials(expression, variables) for e, expression in entries.items()}

    def prove(self, entry: Entry, guess: Mapping[Entry, float]) -> AffineDependence | None:
        exact = _solve(self.parts[entry], [self.parts[other] for other in guess]) if guess else []
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
        rest = expanded(difference)
        if rest.free_symbols & self.variables:
            if varies(rest, self.variables):
                return None
            rest = simplified(rest)
            if rest.free_symbols & self.variables:
                return None
        proof = is_zero(difference - rest)
        if not proof:
            return None
        involved = (entry, *coefficients)
        shared = {s for e in involved for s in self.entries[e].free_symbols & self.variables}
        return AffineDependence(entry, coefficients, rest, proof, tuple(sorted(map(str, shared))))
