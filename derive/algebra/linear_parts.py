"""Constant matrices with which signals enter a plant, or the reason why they do not."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import sympy as sp

from obsynth.derive.algebra.zero_test import is_zero
from obsynth.derive.errors import StructureError
from obsynth.derive.rigour import round_number, substitute
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.plant import Plant


@dataclass(frozen=True, eq=False)
class LinearPart:
    """A constant matrix, exactly and as doubles.

    exact: exact entries
    value: nearest doubles
    rounding: bounds of |exact - value|; zero where the entry is a double
    """

    exact: sp.Matrix
    value: FloatArray
    rounding: FloatArray


def rounded(exact: sp.Matrix) -> LinearPart:
    """Round a matrix of exact numbers to doubles, with bounds of the errors."""
    value, error = np.zeros(exact.shape), np.zeros(exact.shape)
    for i in range(exact.rows):
        for j in range(exact.cols):
            value[i, j], error[i, j] = round_number(exact[i, j])
    return LinearPart(sp.ImmutableMatrix(exact), value, error)


def constant_columns(
    model: Plant, rows: sp.Matrix, symbols: Sequence[sp.Symbol], what: str, row_names: Sequence[str]
) -> LinearPart:
    """Matrix M of rows = M symbols + (something free of the symbols)."""
    exact = sp.zeros(rows.rows, len(symbols))
    values = model.constant_values
    for i, row in enumerate(rows):
        for j, symbol in enumerate(symbols):
            if not row.has(symbol):
                continue
            slope = sp.diff(row, symbol)
            if slope.free_symbols - set(values):
                slope = sp.simplify(slope)
            others = sorted(str(s) for s in slope.free_symbols - set(values))
            if others:
                raise StructureError(
                    f"the {what} {symbol} enters the row of {row_names[i]} with the coefficient "
                    f"{slope}, which depends on {', '.join(others)}; it has to enter linearly with "
                    "a constant coefficient",
                    symbol=str(symbol),
                    row=row_names[i],
                    coefficient=slope,
                )
            exact[i, j] = substitute(slope, values)
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
