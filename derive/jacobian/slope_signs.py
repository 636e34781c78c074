"""Signs of the slopes of a plant's equations over a box, proved.

Flows like sign(g) sqrt(|g|) have no derivative at g = 0 but are monotone all the same: every
product sign(g) |g|^a with a > 0 counts as one increasing function of g, so that a slope is a sum
of pieces with a sign each.
"""

from collections.abc import Sequence
from contextlib import suppress
from functools import cached_property

import numpy as np
import sympy as sp
from numpy.typing import NDArray

from obsynth.derive.algebra.linear_parts import slope
from obsynth.derive.errors import StructureError, UnboundedError
from obsynth.derive.jacobian.bounds import JacobianBounds, jacobian_bounds
from obsynth.derive.jacobian.entries import matrix_entries
from obsynth.derive.rigour import substitute
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.signals import Role, Signal

Signs = NDArray[np.int64]


class Monotone:
    """Signs of slopes of the equations of a plant over its declared ranges.

    plant: see `with_ranges` for another box
    pieces: signals that stand for increasing functions sign(g) |g|^a in the equations, each with g
    """

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        values = plant.constant_values
        self.rows: list[sp.Expr] = []
        self.pieces: list[tuple[Signal, sp.Expr]] = []
        for row in plant.rhs:
            self.rows.append(self._replace(sp.expand(substitute(row, values))))

    def signs(self, row: int, signals: Sequence[Signal]) -> Signs:
        """Return -1, 0 or 1 for the slope of an equation in each signal."""
        found = np.zeros(len(signals), dtype=np.int64)
        for j, signal in enumerate(signals):
            parts = self._parts(self.rows[row], signal.symbol)
            signs = {sign for sign in map(self._sign, parts) if sign != 0}
            if None in signs and signal.name in self.plant.names("x"):
                signs = {self._typed_sign(row, self.plant.names("x").index(signal.name))}
            if len(signs) > 1 or None in signs:
                state = self.plant.names("x")[row]
                raise StructureError(
                    f"the equation of {state} is not proved to be monotone in {signal.name} over "
                    "the region; narrow the region or the ranges",
                    symbol=signal.name,
                    row=state,
                    condition="monotone equations",
                )
            found[j] = sum(sign for sign in signs if sign is not None)
        return found

    def _typed_sign(self, row: int, column: int) -> int | None:
        """Return the sign of a slope in a state of the equations as typed, not written out."""
        if self._jacobian is None:
            return None
        low, high = self._jacobian.min[row, column], self._jacobian.max[row, column]
        return 1 if low >= 0.0 else -1 if high <= 0.0 else None

    @cached_property
    def _jacobian(self) -> JacobianBounds | None:
        """Bounds of all slopes in states; None of equations that jump or get steep without end."""
        with suppress(StructureError, UnboundedError):
            return jacobian_bounds(self.plant, rtol=1e-2, effort="fast")
        return None

    def _parts(self, row: sp.Expr, symbol: sp.Symbol) -> list[list[sp.Expr]]:
        """Return the slope as a sum of products, each listed by its factors."""
        parts = [[slope(row, symbol)]]
        parts += [
            [slope(row, signal.symbol), slope(inner, symbol)]
            for signal, inner in self.pieces
            if row.has(signal.symbol)
        ]
        return parts

    def _sign(self, factors: list[sp.Expr]) -> int | None:
        sign: int | None = 1
        for factor in factors:
            low, high = self._range(sp.expand(factor))
            one = 0 if low == high == 0.0 else 1 if low >= 0.0 else -1 if high <= 0.0 else None
            if one == 0:
                return 0
            sign = None if one is None or sign is None else sign * one
        return sign

    def _range(self, expression: sp.Expr) -> tuple[float, float]:
        if expression.is_number:
            value = float(sp.sign(expression))
            return value, value
        signals = [signal for signal, _ in self.pieces]
        entries = matrix_entries({(0, 0): expression}, self.plant, signals)
        found = entries.search(1e-2, "fast")
        return float(found.lower[0]), float(found.upper[0])

    def _replace(self, row: sp.Expr) -> sp.Expr:
        def signed(node: sp.Basic) -> bool:
            return isinstance(node, sp.Mul) and _signed_power(node) is not None

        def shortened(node: sp.Basic) -> sp.Expr:
            found = _signed_power(node)
            if found is None:
                return node
            inner, exponent, rest = found
            return rest * self._symbol(inner, exponent)

        return row.replace(signed, shortened)

    def _symbol(self, inner: sp.Expr, exponent: sp.Expr) -> sp.Symbol:
        low, high = self._range(inner)
        ends = [np.sign(end) * abs(end) ** float(exponent) for end in (low, high)]
        # one part in 10^9 is far above the rounding of a power
        wide = 1e-9 * (abs(ends[0]) + abs(ends[1])) + 1e-300
        symbol = sp.Dummy(f"flow{len(self.pieces) + 1}", real=True)
        signal = Signal(
            symbol.name, symbol, Role.SCHEDULING, ends[0] - wide, ends[1] + wide, measured=False
        )
        self.pieces.append((signal, inner))
        return symbol


def with_ranges(
    plant: Plant, box: Sequence[Sequence[float]] | FloatArray, kind: str = "x"
) -> Plant:
    """Return a copy of a plant whose states, or signals of another kind, have other ranges."""
    ranges = zip(plant.names(kind), np.asarray(box, dtype=float).tolist(), strict=True)
    return plant.with_ranges({name: (low, high) for name, (low, high) in ranges})


def _signed_power(node: sp.Mul) -> tuple[sp.Expr, sp.Expr, sp.Expr] | None:
    """Return (g, a, the other factors) of a product with sign(g) |g|^a, a > 0."""
    for factor in node.args:
        if not isinstance(factor, sp.sign):
            continue
        inner = factor.args[0]
        for power in node.args:
            base, exponent = power.as_base_exp()
            if isinstance(base, sp.Abs) and exponent.is_number and exponent > 0:
                same = sp.expand(base.args[0] - inner) == 0
                opposite = sp.expand(base.args[0] + inner) == 0
                if same or opposite:
                    rest = sp.Mul(*[f for f in node.args if f is not factor and f is not power])
                    return inner, exponent, rest
    return None


def exact_slope(row: sp.Expr, symbol: sp.Symbol) -> sp.Expr:
    """Return the derivative of an equation with every double as the rational that it is."""
    return substitute(slope(row, symbol), {})
