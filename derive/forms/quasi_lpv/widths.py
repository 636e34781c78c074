"""Guaranteed ranges of coefficients, directly or as means of derivatives."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import sympy as sp

from obsynth.derive.forms.quasi_lpv.options import Share
from obsynth.derive.forms.scheduling import Lift
from obsynth.derive.jacobian.matrix_entries import matrix_entries
from obsynth.symbolic.functions import phi1, tanhc
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.signals import Role, Signal

_RTOL = 1e-2
_QUOTIENTS = (sp.sinc, phi1, tanhc)
_LONG = 150
_MANY = 2


class Widths:
    """Guaranteed widths of coefficients over the box, bounded in batches."""

    def __init__(self, model: Plant, back: Mapping[sp.Symbol, sp.Expr], effort: str) -> None:
        self.model, self.back, self.effort = model, back, effort
        kinds = ("x", "u", "p", "rho", "d", "f", "w")
        signals = [s for k in kinds for s in getattr(model, k)]
        self.bounded = {s.symbol: s.bounded for s in signals}
        box = {s.symbol: (s.lower, s.upper) for s in signals}
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

    def singular(self, coefficient: sp.Expr) -> bool:
        """Tell whether a coefficient has no bound although all its signals have."""
        return not np.isfinite(self[coefficient]) and all(
            self.bounded[s] for s in coefficient.free_symbols
        )


def _is_hard(coefficient: sp.Expr) -> bool:
    """Tell whether the slope is likely to have a better bound, found sooner, than the secant.

    So it is for nested functions, and for quotients by sinc and its like in several variables,
    whose natural extension contains zero until the boxes are small.
    """
    if coefficient.count_ops() > _LONG:
        return True
    below = any(
        power.base.func in _QUOTIENTS and power.exp.is_negative
        for power in coefficient.atoms(sp.Pow)
    )
    return below and len(coefficient.free_symbols) > _MANY
