"""Choosing between the ways to write the terms, by the guaranteed ranges of their coefficients.

The measure is the velocity inflation: how much a design that treats the entries as independent
intervals overestimates the range of a row, mean over the box of sum_j width(A_ij) |x_j - c_j|
divided by range(f_i). Entries that need an unmeasured signal count once more.
"""

import heapq
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import sympy as sp

from obsynth.derive.forms.quasi_lpv.options import Option, Share, kept
from obsynth.derive.forms.quasi_lpv.terms import Centre, Term, deviations, row_names
from obsynth.derive.forms.scheduling import Lift, known_signals
from obsynth.derive.jacobian.entries import matrix_entries
from obsynth.symbolic.display import short
from obsynth.symbolic.functions import phi1, tanhc
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.signals import Role, Signal

_RTOL = 1e-2
_QUOTIENTS = (sp.sinc, phi1, tanhc)
_LONG = 150
# Longer ones end the search with several times the width of their slopes: they are not tried.
_SHORT = 100
_MANY = 2


class Widths:
    """Guaranteed widths of coefficients over the box, bounded in batches."""

    def __init__(self, model: Plant, back: Mapping[sp.Symbol, sp.Expr], effort: str) -> None:
        self.model, self.back, self.effort = model, back, effort
        self.bounded = {s.symbol: s.bounded for s in model.signals}
        box = {s.symbol: (s.lower, s.upper) for s in model.signals}
        centre = {s: float((s - back[s]) if s in back else 0) for s in box}
        self.inside = {s for s, (low, high) in box.items() if low <= centre[s] <= high}
        self.known: dict[sp.Expr, float] = {}
        self.lifts: list[Lift] = []

    def ranges(self, expressions: Sequence[sp.Expr]) -> list[tuple[float, float]]:
        """Bound expressions in deviations from the centre."""
        places = {(0, k): c.xreplace(self.back) for k, c in enumerate(expressions)}
        entries = matrix_entries(places, self.model, [lift.signal for lift in self.lifts])
        found = entries.search(_RTOL, self.effort)
        result = [(0.0, 0.0)] * len(expressions)
        for k, (_, column) in enumerate(entries.places):
            result[column] = (float(found.lower[k]), float(found.upper[k]))
        return result

    def prepare(self, coefficients: Sequence[sp.Expr]) -> None:
        """Bound all coefficients that are not known yet in one sweep."""
        new = list(dict.fromkeys(c for c in coefficients if c not in self.known))
        varying = [c for c in new if c.free_symbols]
        self.known.update({c: 0.0 for c in new if not c.free_symbols})
        if varying:
            widths = [high - low for low, high in self.ranges(varying)]
            self.known.update(zip(varying, widths, strict=True))

    def lift(self, shares: Sequence[Share]) -> dict[Share, Share]:
        """Replace coefficients that are hard to bound by symbols with the range of their slopes."""
        able = [s for s in shares if s.slope is not None and self.inside.issuperset(s.moving)]
        lifted = self._lift([s for s in able if _is_hard(s.coefficient)])
        self.prepare([s.coefficient for s in shares if s not in lifted])
        rest = [s for s in able if s not in lifted and self.singular(s.coefficient)]
        return lifted | self._lift(rest)

    def _lift(self, shares: Sequence[Share]) -> dict[Share, Share]:
        if not shares:
            return {}
        slopes = list(dict.fromkeys(s.slope for s in shares))
        ranges = dict(zip(slopes, self.ranges(slopes), strict=True))
        lifted: dict[Share, Share] = {}
        symbols: dict[sp.Expr, sp.Symbol] = {}
        for share in shares:
            low, high = ranges[share.slope]
            if not (np.isfinite(low) and np.isfinite(high)):
                continue
            if share.coefficient not in symbols:
                symbol = sp.Dummy(f"secant{len(self.lifts) + 1}", real=True)
                symbols[share.coefficient] = symbol
                signal = Signal(symbol.name, symbol, Role.SCHEDULING, low, high, measured=False)
                meaning = share.coefficient.xreplace(self.back)
                self.lifts.append(Lift(signal, meaning))
                self.bounded[symbol] = True
                self.known[symbol] = high - low
            lifted[share] = replace(share, proxy=symbols[share.coefficient])
        return lifted

    def __getitem__(self, coefficient: sp.Expr) -> float:
        return self.known[coefficient]

    def unlifted(self, shares: Sequence[Share]) -> dict[Share, Share]:
        """Take lifted coefficients as they are where that can be tried, and has a bound."""
        short = [s for s in shares if s.proxy is not None and s.coefficient.count_ops() <= _SHORT]
        self.prepare([s.coefficient for s in short])
        return {s: replace(s, proxy=None) for s in short if not self.singular(s.coefficient)}

    def singular(self, coefficient: sp.Expr) -> bool:
        """Tell whether a coefficient has no bound although all its signals have."""
        return not np.isfinite(self[coefficient]) and all(
            self.bounded[s] for s in coefficient.free_symbols
        )


def _is_hard(coefficient: sp.Expr) -> bool:
    """Tell whether the slope is likely to have a better bound, found sooner, than the secant.

    The natural extension of a quotient by sinc in several variables holds zero until boxes are
    small.
    """
    if coefficient.count_ops() > _LONG:
        return True
    below = any(
        power.base.func in _QUOTIENTS and power.exp.is_negative
        for power in coefficient.atoms(sp.Pow)
    )
    return below and len(coefficient.free_symbols) > _MANY


Combination = tuple[int, ...]
_TIE = 0.02


@dataclass(frozen=True, eq=False)
class Alternative:
    """One way to write a row, with its velocity inflation, infinite where a range is missing.

    unmeasured: signals in the coefficients whose values are not known on line, for which the score
    has a penalty
    """

    choices: tuple[tuple[str, str], ...]
    inflation: float
    unmeasured: tuple[str, ...]
    score: float

    @property
    def ways(self) -> str:
        """The choices as text."""
        return "; ".join(f"{term} by {divisor}" for term, divisor in self.choices)

    def __str__(self) -> str:
        ways = self.ways or "no choice"
        needs = f", needs {', '.join(self.unmeasured)}" if self.unmeasured else ""
        return f"{ways}: inflation {self.inflation:.3g}{needs}"


@dataclass(frozen=True, eq=False)
class RowRanking:
    """The ways to write a row, the chosen one first, then the others in order of their scores.

    Of many ways (``total``) not all are listed.
    """

    row: str
    alternatives: tuple[Alternative, ...]
    total: int

    @property
    def score(self) -> float:
        """The score of the chosen way."""
        return self.alternatives[0].score

    def __str__(self) -> str:
        lines = [f"{self.row}: {self.total} ways"]
        lines += [f"  {k + 1}. {a}" for k, a in enumerate(self.alternatives)]
        return "\n".join(lines)


class _Chooser:
    """The search: what it needs to know about the plant, computed once."""

    def __init__(
        self, model: Plant, centre: Centre, rows: Sequence[sp.Expr], penalty: float, effort: str
    ) -> None:
        self.widths = Widths(model, deviations(model, centre), effort)
        self.penalty = penalty
        self.names = row_names(model)
        signals = [s for kind in "xudfw" for s in getattr(model, kind)]
        noise = [s.symbol for kind in "dfw" for s in getattr(model, kind)]
        values = [float(v) for v in (*centre.x, *centre.u)] + [0.0] * len(noise)
        self.reach = [
            _mean_distance(s.lower, s.upper, c) for s, c in zip(signals, values, strict=True)
        ]
        known = known_signals(model)
        kinds = ("x", "d", "f", "w", "rho")
        self.unknown = {s.symbol for k in kinds for s in getattr(model, k) if s.name not in known}
        quiet = dict.fromkeys(noise, sp.Integer(0))
        ranges = Widths(model, {}, effort)
        still = [row.xreplace(quiet) for row in rows]
        ranges.prepare(still)
        sizes = [ranges[row] for row in still]
        self.sizes = [size if np.isfinite(size) and size > 0.0 else 1.0 for size in sizes]

    def admissible(self, terms: list[Term]) -> list[Term]:
        """Drop options with a coefficient that has no bound over the box."""
        lifted = self.widths.lift(_all_shares(terms))
        hidden = {lift.signal.symbol: lift.meaning for lift in self.widths.lifts}
        self.unknown |= {s for s, e in hidden.items() if e.free_symbols & self.unknown}
        result = []
        for term in terms:
            ways = _with_shares(term, lifted).options
            good = tuple(o for o in ways if self._singular(o) is None)
            if good:
                result.append(replace(term, options=good))
                continue
            worst = self._singular(ways[0])
            reason = f"{worst} has no finite bound over the box"
            result.append(replace(term, options=(kept(term.expression),), reason=reason))
        return result

    def unlifted(self, terms: list[Term]) -> list[Term]:
        """Return the terms with the secants themselves in place of what was lifted."""
        plain = self.widths.unlifted(_all_shares(terms))
        return [_with_shares(term, plain) for term in terms]

    def _singular(self, option: Option) -> sp.Expr | None:
        for share in option.shares:
            if self.widths.singular(share.bounded):
                return share.coefficient.xreplace(self.widths.back)
        return None

    def inflation(self, row: int, sums: Mapping[int, sp.Expr]) -> tuple[float, float]:
        """Velocity inflation of a row, and the score with its penalty."""
        plain = score = 0.0
        for j, coefficient in sums.items():
            part = self.widths[coefficient] * self.reach[j] / self.sizes[row]
            plain += part
            penalised = coefficient.free_symbols & self.unknown
            score += part * (1.0 + (self.penalty if penalised else 0.0))
        return plain, score

    def estimate(self, row: int, option: Option) -> float:
        """Upper bound of what an option adds to the score."""
        return self.inflation(row, {s.position: s.bounded for s in option.shares})[1]

    def rank(self, row: int, terms: list[Term], most: int) -> tuple[RowRanking, list[Option]]:
        """Order the combinations of a row."""
        costs = [[self.estimate(row, o) for o in t.options] for t in terms]
        combinations = _best_sums(costs, most)
        sums = [_sums(terms, combination) for combination in combinations]
        self.widths.prepare([c for columns in sums for c in columns.values()])
        ranked = []
        for combination, columns in zip(combinations, sums, strict=True):
            plain, score = self.inflation(row, columns)
            options = [t.options[k] for t, k in zip(terms, combination, strict=True)]
            used = {s for o in options for _, c in o.columns for s in c.free_symbols}
            choices = tuple(
                (sp.sstr(short(t.expression)), o.text)
                for t, o in zip(terms, options, strict=True)
                if len(t.options) > 1
            )
            needs = tuple(sorted(str(s) for s in used & self.unknown))
            alternative = Alternative(choices, plain, needs, score)
            ranked.append((score, sum(combination), combination, alternative))
        ranked.sort(key=lambda item: item[:3])
        # the widths are no better than their tolerance, so what is as good is settled by structure
        near = [item for item in ranked if item[0] <= (1.0 + _TIE) * ranked[0][0]]
        first = min(near, key=lambda item: item[1:3])
        ranked.sort(key=lambda item: item is not first)
        best = first[2]
        chosen = [t.options[k] for t, k in zip(terms, best, strict=True)]
        total = int(np.prod([len(t.options) for t in terms], dtype=object)) if terms else 1
        return RowRanking(self.names[row], tuple(r[3] for r in ranked), total), chosen


def choose(
    model: Plant,
    rows: Sequence[sp.Expr],
    terms: list[Term],
    centre: Centre,
    alternatives: int,
    penalty: float,
    effort: str,
) -> tuple[list[Term], list[Option], tuple[RowRanking, ...], tuple[Lift, ...]]:
    """Choose one option for every term."""
    chooser = _Chooser(model, centre, rows, penalty, effort)
    lifted = chooser.admissible(terms)
    plain = chooser.unlifted(lifted)
    ordered: list[Term] = []
    chosen: list[Option] = []
    rankings = []
    for i in range(len(rows)):
        own, other = ([t for t in way if t.row == i] for way in (lifted, plain))
        ranking, best = chooser.rank(i, own, alternatives)
        if other != own:
            tried = chooser.rank(i, other, alternatives)
            # a secant as it is shares its variables with others, so it wins where none is narrower
            if tried[0].score <= (1.0 + _TIE) * ranking.score:
                own, (ranking, best) = other, tried
        ordered += own
        chosen += best
        rankings.append(ranking)
    used = {s.proxy for o in chosen for s in o.shares if s.proxy is not None}
    lifts = tuple(lift for lift in chooser.widths.lifts if lift.signal.symbol in used)
    return ordered, chosen, tuple(rankings), lifts


def _all_shares(terms: list[Term]) -> list[Share]:
    return [share for term in terms for option in term.options for share in option.shares]


def _with_shares(term: Term, others: Mapping[Share, Share]) -> Term:
    """Replace shares of all options; the term itself where there are none of them."""
    if not any(share in others for share in _all_shares([term])):
        return term
    ways = [replace(o, shares=tuple(others.get(s, s) for s in o.shares)) for o in term.options]
    return replace(term, options=tuple(ways))


def _mean_distance(lower: float, upper: float, centre: float) -> float:
    """Mean of |x - c| for x uniform in [lower, upper]; 1 for an unbounded signal."""
    if not (np.isfinite(lower) and np.isfinite(upper)):
        return 1.0
    if lower == upper or not lower < centre < upper:
        return abs(0.5 * (lower + upper) - centre)
    return ((centre - lower) ** 2 + (upper - centre) ** 2) / (2.0 * (upper - lower))


def _sums(terms: list[Term], combination: Combination) -> dict[int, sp.Expr]:
    total: dict[int, sp.Expr] = {}
    for term, k in zip(terms, combination, strict=True):
        for share in term.options[k].shares:
            j = share.position
            total[j] = total.get(j, sp.Integer(0)) + share.bounded
    return total


def _best_sums(costs: list[list[float]], most: int) -> list[Combination]:
    """List the combinations with the smallest sums of costs, without making all of them."""
    finite = [[min(c, 1e300) for c in row] for row in costs]
    orders = [sorted(range(len(row)), key=row.__getitem__) for row in finite]
    steps = [[row[k] for k in order] for row, order in zip(finite, orders, strict=True)]
    start = (0,) * len(costs)
    queue = [(sum(row[0] for row in steps), start)]
    seen = {start}
    found: list[Combination] = []
    while queue and len(found) < most:
        total, ranks = heapq.heappop(queue)
        found.append(tuple(order[k] for order, k in zip(orders, ranks, strict=True)))
        for t, k in enumerate(ranks):
            if k + 1 == len(steps[t]):
                continue
            after = (*ranks[:t], k + 1, *ranks[t + 1 :])
            if after not in seen:
                seen.add(after)
                heapq.heappush(queue, (total - steps[t][k] + steps[t][k + 1], after))
    return found
