"""Derivatives of expressions with jumps, off the jumps."""

from collections.abc import Sequence

import sympy as sp

from obsynth.derive.rigour.walks import once, replaced

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
