"""Derivatives of expressions with jumps, off the jumps."""

from collections.abc import Sequence

import sympy as sp


def jacobian(rows: sp.Matrix, symbols: Sequence[sp.Symbol]) -> sp.Matrix:
    """Differentiate rows; what jumps is flat beside its jump.

    SymPy leaves the derivative of the sign of something that it does not know to be real undone.
    """
    if not symbols:
        return sp.zeros(len(rows), 0)
    found = sp.Matrix(rows).jacobian(symbols)
    undone = [d for d in found.atoms(sp.Derivative) if isinstance(d.expr, sp.sign | sp.Heaviside)]
    flat = found.xreplace(dict.fromkeys(undone, sp.Integer(0)))
    return flat.replace(sp.DiracDelta, lambda *_: sp.Integer(0))
