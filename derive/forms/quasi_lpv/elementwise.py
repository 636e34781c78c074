"""Bounds of a form's matrices: constant, as functions of what is measured, and centred.

An entry that is monotone in every unknown signal over the box takes its extremes where the unknown
signals are at an end. Where a whole entry is not monotone, its terms are bounded one by one: by
monotonicity, as a known factor times an unknown one, or by a constant range.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from obsynth.derive.algebra.factorise import expand_terms
from obsynth.derive.errors import DerivationError, UnboundedError
from obsynth.derive.forms.scheduling import Known, Lift
from obsynth.derive.forms.varying import Vertices
from obsynth.derive.jacobian.entries import matrix_entries
from obsynth.derive.rigour import UNIT_ROUNDOFF, enclose_number, rational
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.shown import Shown
from obsynth.symbolic.signals import Signal

Entry = tuple[int, int]
Ends = tuple[sp.Expr, sp.Expr]
_RTOL = 1e-2
_EFFORT = "fast"


@dataclass(frozen=True, eq=False)
class Ranging:
    """How ranges of entries of a form are found; ``lifts`` are symbols with ranges of slopes."""

    matrix: sp.Matrix
    lifts: tuple[Lift, ...]
    rtol: float
    effort: str


@dataclass(frozen=True, eq=False, repr=False)
class IntervalForm(Shown):
    """A_min <= A(rho) <= A_max elementwise over the box, and the same for B and the offset.

    minimum, maximum: guaranteed bounds of ``"A"`` (n, n), ``"B"`` (n, n_u), ``"offset"`` (n, 1)
    """

    minimum: dict[str, FloatArray]
    maximum: dict[str, FloatArray]

    @property
    def A_min(self) -> FloatArray:
        """Lower bound of A, shape (n, n)."""
        return self.minimum["A"]

    @property
    def A_max(self) -> FloatArray:
        """Upper bound of A, shape (n, n)."""
        return self.maximum["A"]

    def __str__(self) -> str:
        lines = ["bounds of A"]
        for (i, j), low in np.ndenumerate(self.A_min):
            if (high := self.A_max[i, j]) > low:
                lines.append(f"  a{i + 1}{j + 1} in [{low:.8g}, {high:.8g}]")
        return "\n".join(lines)


def make_interval_form(blocks: dict[str, sp.Matrix], model: Plant, way: Ranging) -> IntervalForm:
    """Bound the blocks of a form elementwise."""
    minimum, maximum = {}, {}
    for name, block in blocks.items():
        low, high = np.zeros(block.shape), np.zeros(block.shape)
        varying = {}
        for place in np.ndindex(*block.shape):
            if block[place].free_symbols:
                varying[place] = block[place]
            else:
                low[place], high[place] = enclose_number(block[place])
        entries = matrix_entries(varying, model, [lift.signal for lift in way.lifts])
        if entries.places:
            found = entries.ranges(way.rtol, way.effort, name)
            for k, place in enumerate(entries.places):
                low[place], high[place] = found.lower[k], found.upper[k]
        minimum[name], maximum[name] = low, high
    return IntervalForm(minimum, maximum)


def bound_elements(
    entries: Mapping[Entry, sp.Expr],
    model: Plant,
    known: Sequence[Known],
    more: Sequence[Signal] = (),
) -> dict[Entry, Ends]:
    """Bound entries over the unknown signals, as functions of the ends of the known ones."""
    return _Bounder(model, known, more).bound(entries)


class _Bounder:
    def __init__(self, model: Plant, known: Sequence[Known], more: Sequence[Signal]) -> None:
        self.model, self.more = model, more
        signals = {s.symbol: s for s in (*model.signals, *more)}
        self.exact = {k.signal: k.ends[0] for k in known if k.exact}
        self.ends: dict[sp.Symbol, Ends | None] = {}
        for symbol, signal in signals.items():
            if symbol not in self.exact:
                pair = (rational(signal.lower), rational(signal.upper)) if signal.bounded else None
                self.ends[symbol] = pair
        self.ends.update({k.signal: k.ends for k in known if not k.exact})

    def bound(self, entries: Mapping[Entry, sp.Expr]) -> dict[Entry, Ends]:
        found: dict[Entry, Ends] = dict.fromkeys(entries, (sp.nan, sp.nan))
        whole = self._monotone(list(entries.values()))
        hard: dict[Entry, list[sp.Expr]] = {}
        for (place, entry), signs in zip(entries.items(), whole, strict=True):
            if signs is None:
                hard[place] = expand_terms(entry)
                continue
            found[place] = self._at_ends(entry, signs)
        terms = list(dict.fromkeys(t for listed in hard.values() for t in listed))
        by_term = dict(zip(terms, self._terms(terms), strict=True))
        for place, listed in hard.items():
            parts = [by_term[term] for term in listed]
            found[place] = (
                sp.Add(*[low for low, _ in parts]),
                sp.Add(*[high for _, high in parts]),
            )
        return found

    def _terms(self, terms: list[sp.Expr]) -> list[Ends]:
        """Bounds of terms: by monotonicity, else as a known factor times an unknown one."""
        split = [term.as_independent(*self.ends, as_Add=False) for term in terms]
        signs = self._monotone(terms)
        factor_signs = self._monotone([unknown for _, unknown in split])
        ranged = [
            unknown
            for (_, unknown), term_sign, sign in zip(split, signs, factor_signs, strict=True)
            if term_sign is None and sign is None
        ]
        ranges = dict(zip(ranged, self._ranges(ranged), strict=True))
        result = []
        for term, (factor, unknown), term_sign, sign in zip(
            terms, split, signs, factor_signs, strict=True
        ):
            if term_sign is not None:
                result.append(self._at_ends(term, term_sign))
                continue
            low, high = ranges[unknown] if sign is None else self._at_ends(unknown, sign)
            known = factor.xreplace(self.exact)
            result.append(_times(known, low, high))
        return result

    def _at_ends(self, entry: sp.Expr, signs: Mapping[sp.Symbol, int]) -> Ends:
        """Put the ends of the unknown signals in, as their signs demand."""
        places = []
        for side in (0, 1):
            corner = dict(self.exact)
            for symbol, sign in signs.items():
                ends = self.ends[symbol]
                if ends is None:
                    raise UnboundedError(
                        f"the entry {entry} depends on {symbol}, which has no range; declare it "
                        "with range=",
                        entries=(str(entry),),
                        operation="a signal without a range",
                        sub_box={},
                    )
                corner[symbol] = ends[side if sign > 0 else 1 - side]
            places.append(entry.xreplace(corner))
        return places[0], places[1]

    def _monotone(self, expressions: list[sp.Expr]) -> list[dict[sp.Symbol, int] | None]:
        """Signs of the slopes in the unknown signals; None where one is not of constant sign."""
        varying = {
            (0, k): e
            for k, e in enumerate(expressions)
            if any(e.has(symbol) for symbol in self.ends)
        }
        result: list[dict[sp.Symbol, int] | None] = [{} for _ in expressions]
        if not varying:
            return result
        entries = matrix_entries(varying, self.model, self.more)
        jacobian = ca.jacobian(entries.values, entries.variables)
        rows, columns = jacobian.sparsity().get_triplet()
        wanted = [
            (n, r, c)
            for n, (r, c) in enumerate(zip(rows, columns, strict=True))
            if entries.symbols[c] in self.ends
        ]
        if not wanted:
            return result
        slopes = ca.vertcat(*[jacobian.nz[n] for n, _, _ in wanted])
        found = entries.search(_RTOL, _EFFORT, slopes)
        for position, (_, r, c) in enumerate(wanted):
            k = entries.places[r][1]
            signs = result[k]
            if signs is None:
                continue
            if found.lower[position] >= 0.0:
                signs[entries.symbols[c]] = 1
            elif found.upper[position] <= 0.0:
                signs[entries.symbols[c]] = -1
            else:
                result[k] = None
        return result

    def _ranges(self, expressions: list[sp.Expr]) -> list[Ends]:
        """Constant ranges over the whole box, as exact numbers."""
        if not expressions:
            return []
        places = {(0, k): e for k, e in enumerate(expressions)}
        entries = matrix_entries(places, self.model, self.more)
        found = entries.ranges(1e-6, "normal")
        return [
            (rational(float(low)), rational(float(high)))
            for low, high in zip(found.lower, found.upper, strict=True)
        ]


def _times(factor: sp.Expr, low: sp.Expr, high: sp.Expr) -> Ends:
    """Bounds of a known factor times something between low and high."""
    if factor.is_number:
        return (factor * low, factor * high) if factor >= 0 else (factor * high, factor * low)
    return sp.Min(factor * low, factor * high), sp.Max(factor * low, factor * high)


@dataclass(frozen=True, eq=False, repr=False)
class CentredForm(Shown):
    """Nominal matrices plus a remainder: A(rho) = A + Delta, Delta in a polytope and in a box.

    The remainder has vertices (N, n, n), (N, n, n_u), and elementwise bounds, rounded outwards; the
    radius is what rounding may add beyond the hull of the vertices, and exact tells whether that
    hull is the remainder itself.
    """

    A: FloatArray
    B: FloatArray
    A_vertices: FloatArray
    B_vertices: FloatArray
    A_lower: FloatArray
    A_upper: FloatArray
    B_lower: FloatArray
    B_upper: FloatArray
    A_radius: FloatArray
    B_radius: FloatArray
    exact: bool

    def __str__(self) -> str:
        width = self.A_vertices.max(axis=0) - self.A_vertices.min(axis=0)
        return (
            f"A nominal with {int((width > 0.0).sum())} varying entries of width at most "
            f"{float(width.max(initial=0.0)):.6g}, "
            f"{len(self.A_vertices)} vertices ({'exact' if self.exact else 'outer'})"
        )


def centre_form(polytope: Vertices, nominal: ArrayLike | None = None) -> CentredForm:
    """Split a polytopic form into nominal matrices and a remainder."""
    family, layout = polytope.family, polytope.layout
    middle = family.midpoint
    place_A, place_B = layout.place("A"), layout.place("B")
    if nominal is not None:
        given = np.asarray(nominal, dtype=float)
        if given.shape != middle[place_A].shape or not np.isfinite(given).all():
            raise DerivationError(
                f"the nominal A needs finite entries and the shape {middle[place_A].shape}; given "
                f"was {given.tolist()}",
                given=given,
            )
        middle[place_A] = given
    half = family.half_ranges
    around = replace(
        family, constant=family.midpoint - middle, ranges=np.stack([-half, half], axis=1)
    )
    vertices = around.vertices()
    weights = np.abs(family.directions)
    largest = np.abs(family.constant) + np.abs(middle)
    largest += np.tensordot(np.abs(family.ranges).max(axis=1, initial=0.0), weights, axes=1)
    varying = (np.tensordot(half, weights, axes=1) > 0.0) | (around.constant != 0.0)
    steps = 4 * (len(family.ranges) + 4)
    slack = family.radius + np.where(varying, steps * UNIT_ROUNDOFF * largest, 0.0)
    lower = np.where(slack > 0.0, np.nextafter(vertices.min(axis=0) - slack, -np.inf), 0.0)
    upper = np.where(slack > 0.0, np.nextafter(vertices.max(axis=0) + slack, np.inf), 0.0)
    return CentredForm(
        middle[place_A],
        middle[place_B],
        vertices[:, place_A[0], place_A[1]],
        vertices[:, place_B[0], place_B[1]],
        lower[place_A],
        upper[place_A],
        lower[place_B],
        upper[place_B],
        slack[place_A],
        slack[place_B],
        polytope.exact,
    )
