"""Elementwise bounds A_lower <= A(rho) <= A_upper as functions of what is measured.

An entry that is monotone in every unknown signal over the box takes its extremes where the unknown
signals are at an end. Where a whole entry is not monotone, its terms are bounded one by one: by
monotonicity, as a known factor times an unknown one, or by a constant range.
"""

from collections.abc import Mapping, Sequence

import casadi as ca
import sympy as sp

from obsynth.derive.algebra.factorise import expand_terms
from obsynth.derive.errors import UnboundedError
from obsynth.derive.forms.measured import Known
from obsynth.derive.jacobian.matrix_entries import matrix_entries
from obsynth.derive.rigour import rational
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.signals import Signal

Entry = tuple[int, int]
Ends = tuple[sp.Expr, sp.Expr]
_RTOL = 1e-2
_EFFORT = "fast"


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
