"""Reading equations: matching symbols by name, checking every node, one canonical form."""

import difflib
import math
from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np
import sympy as sp
from sympy.core.relational import Relational
from sympy.functions.elementary.piecewise import ExprCondPair
from sympy.logic.boolalg import And, BooleanFalse, BooleanFunction, BooleanTrue, Not, Or

from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.functions import BY_CLASS, BY_NAME

__all__ = ["canonical", "read_rows"]

_STRUCTURE = (
    sp.Add,
    sp.Mul,
    sp.Pow,
    sp.Piecewise,
    ExprCondPair,
    Relational,
    And,
    Or,
    Not,
    BooleanTrue,
    BooleanFalse,
)


def read_rows(rows: Any, symbols: Mapping[str, sp.Symbol], what: str) -> tuple[sp.Expr, ...]:
    """Read the rows of a system of equations.

    Parameters
    ----------
    rows : sequence of expressions, or a column matrix
        SymPy expressions, numbers or text in the language of ``symbolic/text.py``.
    symbols : mapping of str to sympy.Symbol
        What is declared. A symbol of the user's own without assumptions is matched by name.
    what : str
        ``"dynamics"`` or ``"outputs"``, for messages.

    Returns
    -------
    tuple of sympy.Expr
        One canonical expression per row.

    Raises
    ------
    PlantError
        An undeclared symbol (with the declared names and the closest match), an unsupported
        function, a relation in place of an expression, a number that is not finite.

    Examples
    --------
    >>> x = sp.Symbol("x", real=True)
    >>> read_rows([sp.Symbol("x") ** 2], {"x": x}, "dynamics") == (x**2,)
    True
    """
    if isinstance(rows, sp.MatrixBase):
        if rows.shape[1] != 1:
            raise PlantError(f"{what}: a column matrix is needed, not one of shape {rows.shape}")
        rows = list(rows)
    if isinstance(rows, np.ndarray):
        rows = rows.tolist()
    if isinstance(rows, ca.SX | ca.MX):
        raise PlantError(f"{what}: these are CasADi expressions; use Plant.from_casadi")
    if not isinstance(rows, Sequence) or isinstance(rows, str):
        raise PlantError(f"{what}: a list of expressions is needed, not {rows!r}")
    return tuple(_read(row, symbols, f"{what} row {k}") for k, row in enumerate(rows, start=1))


def canonical(expression: sp.Expr) -> sp.Expr:
    """Rebuild an expression from its parts until it no longer changes.

    What SymPy was told not to evaluate is evaluated, and every float becomes the double
    it prints as, so that equal text means equal expressions.

    Parameters
    ----------
    expression : sympy.Expr

    Returns
    -------
    sympy.Expr

    Examples
    --------
    >>> x = sp.Symbol("x", real=True)
    >>> canonical(sp.Mul(2, x + 1, evaluate=False))
    2*x + 2
    """
    for _ in range(8):
        rebuilt = _rebuild(expression, {})
        if rebuilt == expression:
            return rebuilt
        expression = rebuilt
    return expression


def _rebuild(node: sp.Basic, done: dict[sp.Basic, sp.Basic]) -> sp.Basic:
    if node not in done:
        if isinstance(node, sp.Float):
            done[node] = sp.Float(float(node))
        elif node.args:
            arguments = [_rebuild(argument, done) for argument in node.args]
            done[node] = node.func(*arguments)
        else:
            done[node] = node
    return done[node]


def _read(row: Any, symbols: Mapping[str, sp.Symbol], where: str) -> sp.Expr:
    if isinstance(row, ca.SX | ca.MX | ca.DM):
        raise PlantError(f"{where}: this is a CasADi expression; use Plant.from_casadi")
    if isinstance(row, np.generic):
        row = row.item()
    if isinstance(row, bool) or not isinstance(row, int | float | sp.Basic):
        raise PlantError(f"{where}: {row!r} is not an expression", where=where)
    expression = sp.sympify(row)
    # SymPy's Symbol is itself a Boolean, so only relations and connectives are asked for.
    if isinstance(expression, Relational | BooleanFunction | BooleanTrue | BooleanFalse):
        raise PlantError(
            f"{where}: {expression} is a condition; give the right-hand side alone", where=where
        )
    if not isinstance(expression, sp.Expr):
        raise PlantError(f"{where}: {expression} is not a scalar expression", where=where)
    replace = {}
    for symbol in sorted(expression.free_symbols, key=str):
        replace[symbol] = _match(symbol, symbols, where)
    expression = canonical(expression.xreplace(replace))
    _check_nodes(expression, where)
    return expression


def _match(symbol: sp.Basic, symbols: Mapping[str, sp.Symbol], where: str) -> sp.Symbol:
    """Return the declared symbol a free symbol stands for."""
    name = str(symbol)
    declared = symbols.get(name)
    if declared is None:
        close = difflib.get_close_matches(name, symbols, n=1)
        hint = f"; did you mean {close[0]}?" if close else ""
        known = ", ".join(symbols) if symbols else "none yet"
        raise PlantError(
            f"{where}: the symbol {name} is not declared (declared: {known}){hint}",
            symbol=name,
            declared=tuple(symbols),
            closest=close[0] if close else None,
            where=where,
        )
    if symbol == declared or (type(symbol) is sp.Symbol and symbol == sp.Symbol(name)):
        return declared
    raise PlantError(
        f"{where}: the symbol {name} carries assumptions of its own; use the symbol the "
        f"declaration returned, or a plain Symbol({name!r})",
        symbol=name,
        where=where,
    )


def _check_nodes(expression: sp.Expr, where: str) -> None:
    """Refuse whatever has no meaning as a real function of the plant's signals."""
    for node in sp.preorder_traversal(expression):
        if isinstance(node, sp.Symbol | sp.Integer | sp.Rational) and node.is_finite is not False:
            continue
        if isinstance(node, sp.Float) and math.isfinite(float(node)):
            continue
        if node in (sp.pi, sp.E) or isinstance(node, _STRUCTURE) or node.func in BY_CLASS:
            continue
        if isinstance(node, sp.Number) or node in (sp.I, sp.zoo, sp.nan):
            raise PlantError(f"{where}: {node} in {expression} is not a finite real number")
        name = node.func.__name__
        raise PlantError(
            f"{where}: the function {name} in {expression} is not supported; supported are "
            f"{', '.join(sorted(BY_NAME))}, Piecewise",
            function=name,
            where=where,
        )
