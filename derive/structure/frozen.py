"""A plant frozen at points of its box: exact derivatives in 40 digits, ranks without doubt.

In doubles a column that depends on others by the equations differs from them by rounding; in 40
digits it is zero to 1e-35 or it is not.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp

from obsynth.derive.algebra.linear_parts import jacobian
from obsynth.derive.errors import DerivationError
from obsynth.derive.rigour import rational, substitute
from obsynth.symbolic.plant import Plant

_DIGITS = 40
_BITS = 160
_ZERO = 1e-20
_POINTS = 3


@dataclass(frozen=True, eq=False)
class Frozen:
    """Derivatives of rows and outputs at one point, by states, unknown inputs and faults."""

    A: sp.Matrix
    D: sp.Matrix
    B_f: sp.Matrix
    C: sp.Matrix
    C_d: sp.Matrix
    D_f: sp.Matrix
    point: dict[str, float]


def freeze(model: Plant, count: int = _POINTS) -> list[Frozen]:
    """Evaluate the derivatives of a plant at fixed random points of its box."""
    values = model.constant_values
    rows = [sp.Matrix([substitute(e, values) for e in part]) for part in (model.rhs, model.output)]
    kinds = {kind: [s.symbol for s in getattr(model, kind)] for kind in ("x", "d", "f", "w")}
    parts = [jacobian(part, kinds[kind]) for part in rows for kind in ("x", "d", "f")]
    quiet = dict.fromkeys([*kinds["f"], *kinds["w"]], sp.Integer(0))
    parts = [part.subs(quiet) for part in parts]
    signals = [s for kind in ("x", "u", "p", "rho", "d") for s in getattr(model, kind)]
    rng = np.random.default_rng(7)
    found: list[Frozen] = []
    for _ in range(10 * count):
        point = {}
        for s in signals:
            middle = 0.0 if s.nominal is None else s.nominal
            low, high = (s.lower, s.upper) if s.bounded else (middle - 1.0, middle + 1.0)
            point[s.symbol] = float(low + (high - low) * rng.uniform(0.1, 0.9))
        exact = {symbol: rational(value) for symbol, value in point.items()}
        numeric = [_numbers(part, exact) for part in parts]
        if all(e.is_Float and e.is_finite for part in numeric for e in part):
            A, D, B_f, C, C_d, D_f = numeric
            named = {str(symbol): value for symbol, value in point.items()}
            found.append(Frozen(A, D, B_f, C, C_d, D_f, named))
        if len(found) == count:
            return found
    raise DerivationError(
        f"the derivatives of {model.name!r} are not finite at random points of its box; keep the "
        "ranges inside the domain of the equations"
    )


def _numbers(matrix: sp.Matrix, point: dict[sp.Symbol, sp.Rational]) -> sp.Matrix:
    def number(entry: sp.Expr) -> sp.Expr:
        value = sp.sympify(entry.xreplace(point)).evalf(_DIGITS)
        return sp.Float(value, _DIGITS) if value.is_Rational else value

    return matrix.applyfunc(number)


def balls(matrix: sp.Matrix) -> Any:
    """Return a matrix of 40-digit numbers as balls that hold the exact ones."""
    import flint

    def ball(value: Any) -> Any:
        middle = flint.arb(str(sp.Float(value, _DIGITS)))
        return middle + flint.arb(0, 1e-37) * middle

    rows, columns = matrix.shape
    return flint.arb_mat(
        rows, columns, [ball(matrix[i, j]) for i in range(rows) for j in range(columns)]
    )


@contextmanager
def precision() -> Iterator[None]:
    """Compute with balls of 160 bits inside the block."""
    import flint

    before = flint.ctx.prec
    flint.ctx.prec = _BITS
    try:
        yield
    finally:
        flint.ctx.prec = before


def rank(rows: Sequence[Sequence[Any]]) -> int:
    """Rank of a matrix of balls, by elimination with complete pivoting."""
    import flint

    work = [[flint.arb(value) for value in row] for row in rows]
    if not work or not work[0]:
        return 0
    for j in range(len(work[0])):
        size = max((abs(row[j].mid()) for row in work), key=float)
        if size > 0:
            for row in work:
                row[j] = row[j] / size
    found = 0
    while found < min(len(work), len(work[0])):
        left = [
            (float(abs(work[i][j].mid())), i, j)
            for i in range(found, len(work))
            for j in range(found, len(work[0]))
        ]
        _, i, j = max(left)
        work[found], work[i] = work[i], work[found]
        for row in work:
            row[found], row[j] = row[j], row[found]
        pivot = work[found]
        if pivot[found].contains(0):
            if float(pivot[found].abs_upper()) < _ZERO:
                return found
            raise DerivationError("a rank cannot be decided: the numbers are too badly scaled")
        for row in work[found + 1 :]:
            factor = row[found] / pivot[found]
            for k in range(found, len(row)):
                row[k] = row[k] - factor * pivot[k]
        found += 1
    return found


def transfer(frozen: Frozen, at: float) -> list[list[Any]]:
    """Transfer matrix from unknown inputs and faults to the outputs, at one real number."""
    import flint

    n = frozen.A.rows
    inputs = frozen.D.row_join(frozen.B_f)
    direct = frozen.C_d.row_join(frozen.D_f)
    if not inputs.cols:
        return [[] for _ in range(frozen.C.rows)]
    identity = flint.arb_mat(n, n, [at if i == j else 0 for i in range(n) for j in range(n)])
    solved = (identity - balls(frozen.A)).solve(balls(inputs))
    value = balls(frozen.C) * solved + balls(direct)
    rows: list[list[Any]] = value.tolist()
    return rows
