"""Derivatives off the jumps, linear parts, and the proof that the parts of a split add up."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import sympy as sp

from obsynth.derive.algebra.sizes import LARGEST_ROW, simplified, size, text
from obsynth.derive.algebra.sizes import symbols as symbols_of
from obsynth.derive.algebra.zero_test import is_zero, varies
from obsynth.derive.errors import StructureError
from obsynth.derive.rigour import round_number, substitute
from obsynth.derive.rigour.walks import once, replaced
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.plant import Plant

_FLAT = (sp.sign, sp.Heaviside, sp.floor, sp.ceiling)


def slope(row: sp.Expr, symbol: sp.Symbol) -> sp.Expr:
    """Differentiate a row; what jumps is flat beside its jump."""
    return jacobian(sp.Matrix([row]), [symbol])[0]


def jacobian(rows: sp.Matrix, symbols: Sequence[sp.Symbol]) -> sp.Matrix:
    """Differentiate rows; what jumps is flat beside its jump.

    SymPy leaves the derivative of a sign or a floor undone, and later takes hours over what it
    left.
    """
    if not symbols:
        return sp.zeros(len(rows), 0)
    flat: dict[sp.Basic, sp.Basic] = {}
    back: dict[sp.Basic, sp.Basic] = {}
    for node in once(*rows):
        bent = isinstance(node, sp.Abs) and not node.args[0].is_extended_real
        jump = sp.sign(node.args[0]) if bent else node
        if isinstance(jump, _FLAT):
            level = sp.Dummy(real=True)
            back[level] = jump
            flat[node] = level if jump is node else replaced(node.args[0], flat) * level
    found = sp.Matrix([replaced(row, flat) for row in rows]).jacobian(symbols)
    return found.applyfunc(lambda entry: replaced(entry, back))


@dataclass(frozen=True, eq=False)
class LinearPart:
    """A constant matrix, exactly and as doubles, with bounds of |exact - value|."""

    exact: sp.Matrix
    value: FloatArray
    rounding: FloatArray


def rounded(exact: sp.Matrix) -> LinearPart:
    """Round a matrix of exact numbers to doubles, with bounds of the errors."""
    value, error = np.zeros(exact.shape), np.zeros(exact.shape)
    for place in np.ndindex(*exact.shape):
        value[place], error[place] = round_number(exact[place])
    return LinearPart(sp.ImmutableMatrix(exact), value, error)


def constant_columns(
    model: Plant, rows: sp.Matrix, symbols: Sequence[sp.Symbol], what: str, row_names: Sequence[str]
) -> LinearPart:
    """Matrix M of rows = M symbols + (something free of the symbols)."""
    exact = sp.zeros(rows.rows, len(symbols))
    values = model.constant_values
    for i, typed in enumerate(rows):
        present = [symbol for symbol in symbols if symbol in symbols_of(typed)]
        if not present:
            continue
        if size(typed) > LARGEST_ROW:
            raise StructureError(
                f"the row of {row_names[i]} has {size(typed):,} parts, too many to prove that the "
                f"{what} {present[0]} enters it linearly with a constant coefficient; write it "
                "shorter, or discretise with the Euler method",
                symbol=str(present[0]),
                row=row_names[i],
            )
        row = substitute(typed, {})
        for j, symbol in enumerate(symbols):
            if symbol not in present:
                continue
            factor = slope(row, symbol)
            open_symbols = factor.free_symbols - set(values)
            if open_symbols and not varies(factor, open_symbols):
                factor = simplified(factor)
            others = sorted(str(s) for s in factor.free_symbols - set(values))
            if others:
                raise StructureError(
                    f"the {what} {symbol} enters the row of {row_names[i]} with the coefficient "
                    f"{text(factor)}, which depends on {', '.join(others)}; it has to enter "
                    "linearly with a constant coefficient",
                    symbol=str(symbol),
                    row=row_names[i],
                    coefficient=factor,
                )
            exact[i, j] = substitute(factor, values)
        rest = row - sum((exact[i, j] * s for j, s in enumerate(symbols)), sp.Integer(0))
        rest = substitute(rest, values)
        zero = substitute(row.subs(dict.fromkeys(symbols, 0)), values)
        if not is_zero(rest - zero):
            raise StructureError(
                f"the {what} signals do not enter the row of {row_names[i]} linearly",
                symbol=", ".join(str(s) for s in symbols if row.has(s)),
                row=row_names[i],
            )
    return rounded(exact)


@dataclass(frozen=True, eq=False)
class IdentityProof:
    """Proof that the parts of a split add up to the plant: a method for every row, "" without one.

    A and B are the rational numbers that their doubles are, and g takes up the difference;
    rounding: bounds of |exact - double| for D, B_f, W1, C, W2, D_f.
    """

    methods: tuple[str, ...]
    rounding: dict[str, FloatArray]

    @property
    def holds(self) -> bool:
        """True when every row is proved."""
        return all(self.methods)

    def __str__(self) -> str:
        worst = max((float(e.max(initial=0.0)) for e in self.rounding.values()), default=0.0)
        ways = ", ".join(sorted(set(self.methods) - {""}))
        missing = [str(k + 1) for k, method in enumerate(self.methods) if not method]
        rows = f"all {len(self.methods)} rows: {ways}"
        if missing:
            rows = f"rows {', '.join(missing)} not proved"
        return (
            f"the parts add up to the plant exactly ({rows}); "
            f"largest rounding of a matrix entry {worst:.2g}"
        )


def prove_identity(
    model: Plant, A: sp.Matrix, B: sp.Matrix, g: sp.Matrix, parts: dict[str, LinearPart]
) -> IdentityProof:
    """Show that exact parts add up to the plant's own expressions."""
    values = model.constant_values
    symbols = {k: [s.symbol for s in getattr(model, k)] for k in "xudfw"}
    column = {k: sp.Matrix(len(found), 1, found) for k, found in symbols.items()}
    dynamics = (
        A * column["x"]
        + B * column["u"]
        + parts["D"].exact * column["d"]
        + parts["B_f"].exact * column["f"]
        + parts["W1"].exact * column["w"]
        + g
    )
    outputs = (
        parts["C"].exact * column["x"]
        + parts["W2"].exact * column["w"]
        + parts["D_f"].exact * column["f"]
    )
    methods = []
    for whole, summed in ((model.rhs, dynamics), (model.output, outputs)):
        methods += [is_zero(substitute(whole[i], values) - summed[i]) for i in range(whole.rows)]
    return IdentityProof(tuple(methods), {name: part.rounding for name, part in parts.items()})
