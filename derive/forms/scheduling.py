"""Scheduling variables: the functions through which forms vary, and which are known on line."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import sympy as sp

from obsynth.derive.algebra.connected import connected
from obsynth.derive.algebra.zero_test import prove_zero
from obsynth.derive.errors import DerivationError, UnboundedError
from obsynth.derive.intervals.program import evaluate
from obsynth.derive.intervals.ranges import Status
from obsynth.derive.jacobian.entries import MatrixEntries, matrix_entries
from obsynth.derive.jacobian.family import (
    AffineDependence,
    AffineFamily,
    build_family,
    find_dependences,
    monomials,
)
from obsynth.derive.rigour import substitute
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.signals import Signal

Entry = tuple[int, int]
Affine = tuple[sp.Expr, dict[int, sp.Expr]]
_SAMPLES = 96
_PREFIXES = ("rho", "sigma", "zeta", "varrho")


@dataclass(frozen=True, eq=False)
class Reading:
    """An output that shows one state: y = scale * state + noise, the scale exact and not zero."""

    output: str
    state: sp.Symbol
    scale: sp.Expr
    noise: tuple[tuple[sp.Symbol, sp.Expr], ...]


def readings(model: Plant) -> tuple[Reading, ...]:
    """List the outputs that show one state each, free of faults."""
    states = {s.symbol for s in model.x}
    disturbances = {s.symbol for s in model.w}
    found: list[Reading] = []
    for name, row in zip(model.output_names, model.output, strict=True):
        row = sp.expand(substitute(row, model.constant_values))
        shown = row.free_symbols & states
        if len(shown) != 1 or row.free_symbols - shown - disturbances:
            continue
        (state,) = shown
        symbols = sorted(row.free_symbols, key=str)
        slopes = {s: sp.diff(row, s) for s in symbols}
        linear = sum((slope * s for s, slope in slopes.items()), sp.Integer(0))
        if any(slope.free_symbols for slope in slopes.values()) or sp.expand(row - linear) != 0:
            continue
        if any(reading.state == state for reading in found):
            continue
        noise = tuple((s, slope) for s, slope in slopes.items() if s != state)
        found.append(Reading(name, state, slopes[state], noise))
    return tuple(found)


def known_signals(model: Plant) -> frozenset[str]:
    """Names of the signals whose values are known on line."""
    names = {str(reading.state) for reading in readings(model)}
    names |= set(model.names("u"))
    names |= {s.name for s in model.rho if s.measured}
    return frozenset(names)


@dataclass(frozen=True, eq=False)
class Known:
    """A signal of the plant that lies between two functions of what is known at run time."""

    signal: sp.Symbol
    ends: tuple[sp.Expr, sp.Expr]

    @property
    def exact(self) -> bool:
        """True when both ends are the same."""
        return bool(self.ends[0] == self.ends[1])


@dataclass(frozen=True, eq=False)
class Lift:
    """A secant with a symbol that has the range of the derivative whose mean it is."""

    signal: Signal
    meaning: sp.Expr


@dataclass(frozen=True, eq=False)
class SchedulingVariable:
    """A function of the signals on which matrices depend affinely, with its range.

    A signal that schedules by itself keeps its name; the range is rounded outwards, its attained
    ends are reached, and unmeasured signals are those not known on line.
    """

    symbol: sp.Symbol
    expression: sp.Expr
    lower: float
    upper: float
    attained_lower: float
    attained_upper: float
    status: Status
    signals: tuple[str, ...]
    unmeasured: tuple[str, ...]

    @property
    def measured(self) -> bool:
        """True when its value is known on line, up to the noise of the outputs."""
        return not self.unmeasured

    @property
    def label(self) -> str:
        """The symbol, and what it stands for."""
        own = "" if self.symbol == self.expression else f" = {sp.sstr(self.expression)}"
        return f"{self.symbol}{own}"

    def __str__(self) -> str:
        known = "" if self.measured else f", unmeasured: {', '.join(self.unmeasured)}"
        return f"{self.label} in [{_tidy(self.lower)}, {_tidy(self.upper)}]{known}"


def _tidy(value: float) -> str:
    """Write a bound; one rounded away from zero by a subnormal number reads as zero."""
    return "0" if abs(value) < 1e-300 else f"{value:.8g}"


@dataclass(frozen=True, eq=False)
class AffineSchedule:
    """A matrix as constant + sum of variables times directions, exactly, by proved ``methods``.

    exact: true when the variables depend on disjoint sets of signals
    """

    variables: tuple[SchedulingVariable, ...]
    entries: dict[Entry, Affine]
    methods: dict[Entry, str]
    exact: bool

    def matrix(self, shape: tuple[int, int]) -> sp.Matrix:
        """Write the matrix in the symbols of the scheduling variables."""
        result = sp.zeros(*shape)
        for place, (constant, coefficients) in self.entries.items():
            result[place] = constant + sum(
                (c * self.variables[k].symbol for k, c in coefficients.items()), sp.Integer(0)
            )
        return result

    def family(self, shape: tuple[int, int]) -> AffineFamily:
        """Round the matrix to a family."""
        for variable in self.variables:
            if not (np.isfinite(variable.lower) and np.isfinite(variable.upper)):
                raise UnboundedError(
                    f"the scheduling variable {variable.symbol} = {variable.expression} has no "
                    f"finite range over the box; give {', '.join(variable.signals)} a range that "
                    "keeps away from its singularity, or choose another centre= or another "
                    "factorisation with prefer=",
                    entries=(str(variable.symbol),),
                    operation=str(variable.expression),
                    sub_box={},
                )
        # the variables stand in a row of their own below the matrix, as entries that define scalars
        rows, columns = shape
        basis = [(rows, k) for k in range(len(self.variables))]
        dependences = [
            AffineDependence(
                place,
                {basis[k]: coefficient for k, coefficient in terms.items()},
                constant,
                self.methods.get(place, "constant"),
                (),
            )
            for place, (constant, terms) in self.entries.items()
        ]
        ranges = {basis[k]: (v.lower, v.upper) for k, v in enumerate(self.variables)}
        supports = {basis[k]: v.signals for k, v in enumerate(self.variables)}
        wide = max(columns, len(basis))
        rounded = build_family((rows + 1, wide), basis, dependences, ranges, supports)
        return replace(
            rounded,
            constant=rounded.constant[:rows, :columns],
            directions=rounded.directions[:, :rows, :columns],
            radius=rounded.radius[:rows, :columns],
            labels=tuple(v.label for v in self.variables),
            exact=self.exact,
        )


def make_schedule(
    stacked: Mapping[Entry, sp.Expr],
    model: Plant,
    rtol: float,
    effort: str,
    lifts: Sequence[Lift] = (),
) -> AffineSchedule:
    """Find few scheduling variables on which all entries depend affinely.

    Entries that share functions are treated together. Where they have as many independent entries
    as functions, the functions are the variables; where they have fewer, the entries are.
    """
    more = [lift.signal for lift in lifts]
    varying = {place: e for place, e in stacked.items() if e.free_symbols}
    fixed: dict[Entry, Affine] = {p: (e, {}) for p, e in stacked.items() if p not in varying}
    entries = matrix_entries(varying, model, more)
    signals = [s.symbol for s in model.signals]
    scalars, affine = _scalars(entries, signals)
    symbols = _names(model, scalars)
    variables = _ranges(model, scalars, symbols, rtol, effort, lifts)
    methods = _prove(entries, scalars, affine, model)
    supports = [set(v.signals) for v in variables]
    union: set[str] = set().union(*supports)
    exact = not lifts and sum(map(len, supports)) == len(union)
    order = sorted([*fixed, *affine])
    return AffineSchedule(
        variables,
        {p: fixed[p] if p in fixed else affine[p] for p in order},
        methods,
        exact,
    )


def _scalars(
    entries: MatrixEntries, signals: Sequence[sp.Symbol]
) -> tuple[list[sp.Expr], dict[Entry, Affine]]:
    """Scheduling functions, and every entry through them."""
    known = set(entries.symbols)
    parts = {place: _monomials(e, known) for place, e in entries.exact.items()}
    basis, dependences = find_dependences(entries.exact, entries.sample(), entries.symbols)
    through = {d.entry: d for d in dependences}
    scalars: list[sp.Expr] = []
    position: dict[sp.Expr, int] = {}
    by_entry: dict[Entry, int] = {}

    def add(expression: sp.Expr) -> int:
        if expression not in position:
            position[expression] = len(scalars)
            scalars.append(expression)
        return position[expression]

    direct: set[Entry] = set()
    places = list(parts)
    for together in connected(functions for _, functions in parts.values()):
        group = sorted(places[k] for k in together)
        functions = list(dict.fromkeys(m for place in group for m in parts[place][1]))
        independent = [place for place in group if place in basis]
        if len(functions) <= len(independent):
            direct.update(group)
            for monomial in functions:
                add(monomial)
        else:
            for place in independent:
                by_entry[place] = add(entries.exact[place] - parts[place][0])
    affine: dict[Entry, Affine] = {}
    for place in entries.exact:
        if place in direct:
            constant, terms = parts[place]
            affine[place] = (constant, {position[m]: c for m, c in terms.items()})
        elif place in by_entry:
            affine[place] = (parts[place][0], {by_entry[place]: sp.Integer(1)})
    for place, dependence in through.items():
        if place not in affine:
            affine[place] = _compose(dependence, affine)
    own = [s for s in entries.symbols if s in signals]
    return _declared_first(scalars, own, affine)


def _declared_first(
    scalars: list[sp.Expr], own: Sequence[sp.Symbol], affine: dict[Entry, Affine]
) -> tuple[list[sp.Expr], dict[Entry, Affine]]:
    """Put signals that schedule by themselves first, in the order of the plant."""
    plain = {s: k for k, s in enumerate(reversed(own))}

    def key(k: int) -> tuple[int, int]:
        return (0, -plain[scalars[k]]) if scalars[k] in plain else (1, k)

    order = sorted(range(len(scalars)), key=key)
    new = {old: k for k, old in enumerate(order)}
    moved = {
        place: (constant, {new[k]: c for k, c in sorted(terms.items(), key=lambda i: new[i[0]])})
        for place, (constant, terms) in affine.items()
    }
    return [scalars[k] for k in order], moved


def _monomials(entry: sp.Expr, known: set[sp.Symbol]) -> tuple[sp.Expr, dict[sp.Expr, sp.Expr]]:
    """Constant part, and the coefficients of the products of varying factors."""
    found = monomials(entry, known)
    constant = found.pop(sp.Integer(1), sp.Integer(0))
    return constant, {m: c for m, c in found.items() if c != 0}


def _compose(dependence: AffineDependence, affine: Mapping[Entry, Affine]) -> Affine:
    constant: sp.Expr = dependence.constant
    total: dict[int, sp.Expr] = {}
    for other, coefficient in dependence.coefficients.items():
        start, terms = affine[other]
        constant += coefficient * start
        for k, c in terms.items():
            total[k] = total.get(k, sp.Integer(0)) + coefficient * c
    return constant, {k: c for k, c in total.items() if c != 0}


def _names(model: Plant, scalars: Sequence[sp.Expr]) -> list[sp.Symbol]:
    taken = {s.name for s in model.signals}
    signals = {s.symbol for s in model.signals}
    count = sum(1 for s in scalars if s not in signals)
    free = [
        p for p in _PREFIXES if not any(f"{p}{k}" in taken or p in taken for k in range(count + 1))
    ]
    prefix = free[0] if free else "scheduling_"
    names, k = [], 0
    for scalar in scalars:
        if scalar in signals:
            names.append(scalar)
            continue
        k += 1
        names.append(sp.Symbol(f"{prefix}{k}", real=True))
    return names


def _ranges(
    model: Plant,
    scalars: Sequence[sp.Expr],
    symbols: Sequence[sp.Symbol],
    rtol: float,
    effort: str,
    lifts: Sequence[Lift],
) -> tuple[SchedulingVariable, ...]:
    known = known_signals(model)
    hidden = {lift.signal.symbol: lift.meaning for lift in lifts}
    more = [lift.signal for lift in lifts]
    entries = matrix_entries({(0, k): e for k, e in enumerate(scalars)}, model, more)
    found = entries.search(rtol, effort)
    meanings = [scalar.xreplace(hidden) for scalar in scalars]
    through = matrix_entries({(0, k): e for k, e in enumerate(meanings)}, model)
    attained = _attained(through) if hidden else {}
    variables = []
    for k, (place, symbol) in enumerate(zip(entries.places, symbols, strict=True)):
        signals = through.support(place)
        lifted = bool(scalars[k].free_symbols & hidden.keys())
        reached = (float(found.attained_lower[k]), float(found.attained_upper[k]))
        variables.append(
            SchedulingVariable(
                symbol,
                meanings[k],
                float(found.lower[k]),
                float(found.upper[k]),
                *(attained[place] if lifted else reached),
                # the range is that of a derivative, so nothing says that it is attained
                Status.BUDGET if lifted else found.status[k],
                signals,
                tuple(s for s in signals if s not in known),
            )
        )
    return tuple(variables)


def _attained(entries: MatrixEntries) -> dict[Entry, tuple[float, float]]:
    """Values that are certainly passed, from enclosures at random points."""
    problem = entries.problem()
    rng = np.random.default_rng(0)
    span = problem.upper - problem.lower
    points = problem.lower[:, None] + span[:, None] * rng.random((len(span), _SAMPLES))
    count = len(entries.places)
    low, high = evaluate(problem.program, points, points, range(count))
    return {
        place: (float(np.min(high[k])), float(np.max(low[k])))
        for k, place in enumerate(entries.places)
    }


def _prove(
    entries: MatrixEntries,
    scalars: Sequence[sp.Expr],
    affine: Mapping[Entry, Affine],
    model: Plant,
) -> dict[Entry, str]:
    """Show that every varying entry is the affine function that it is said to be."""
    box = {s.symbol: (s.lower, s.upper) for s in model.signals}
    methods = {}
    for place, expression in entries.exact.items():
        constant, terms = affine[place]
        combined = sum((c * scalars[k] for k, c in terms.items()), constant)
        method = prove_zero(expression - combined, box)
        if not method:
            raise DerivationError(
                f"the entry {expression} is not the affine function {combined} of the scheduling "
                "variables",
                entry=place,
                expression=expression,
            )
        methods[place] = method
    return methods
