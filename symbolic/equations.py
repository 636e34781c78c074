"""Reading equations: matching symbols by name, checking every node, one canonical form."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np
import sympy as sp
from sympy.core.relational import Relational
from sympy.functions.elementary.piecewise import ExprCondPair
from sympy.logic.boolalg import ITE, And, BooleanFalse, BooleanFunction, BooleanTrue, Not, Or

from obsynth.symbolic.convert import nearest_double
from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.functions import BY_CLASS, BY_NAME, phi1, tanhc
from obsynth.symbolic.signals import (
    LONGEST_UNIT,
    Role,
    Signal,
    expand_names,
    one_line,
    output_ranges,
    per_symbol,
)
from obsynth.symbolic.taking import Symbols, SymbolTuple, Together
from obsynth.symbolic.text import TextError, read_text, undeclared

_PLAIN = (
    sp.Symbol,
    sp.Add,
    sp.Mul,
    sp.Pow,
    sp.Piecewise,
    Relational,
    BooleanTrue,
    BooleanFalse,
)


def read_rows(rows: Any, symbols: Mapping[str, sp.Symbol], what: str) -> tuple[sp.Expr, ...]:
    """Read the rows of a system of equations."""
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


def read_dynamics(
    rows: Any, symbols: Mapping[str, sp.Symbol], states: Sequence[str]
) -> tuple[sp.Expr, ...]:
    """Read one row for each state, in their order or by their names."""
    if not states:
        raise PlantError("a plant needs at least one state; declare states first")
    if isinstance(rows, Mapping):
        named = {str(state): row for state, row in rows.items()}
        if set(named) != set(states):
            raise PlantError(
                f"dynamics has rows of {', '.join(named) or 'nothing'}; one each is needed of the "
                f"states {', '.join(states)}",
                states=tuple(states),
            )
        rows = [named[state] for state in states]
    found = read_rows(rows, symbols, "dynamics")
    if len(found) != len(states):
        raise PlantError(
            f"dynamics has {len(found)} rows for {len(states)} states ({', '.join(states)}): give "
            "one for each, in this order",
            rows=len(found),
            states=tuple(states),
        )
    return found


def read_outputs(
    rows: Any, symbols: Mapping[str, sp.Symbol], names: Any, unit: Any, limits: Any
) -> tuple[dict[str, sp.Expr], tuple[str, ...], tuple[tuple[float, float], ...]]:
    """Read outputs with their names, units and the ranges of their sensors."""
    if isinstance(rows, Mapping) and names is None:
        names, rows = [*map(str, rows)], list(rows.values())
    found = read_rows(rows, symbols, "outputs")
    if not found:
        raise PlantError("outputs is empty: an observer needs at least one measurement")
    default = [f"y{k}" for k in range(1, len(found) + 1)]
    named = expand_names(default if names is None else names, "output")
    if len(named) != len(found):
        raise PlantError(
            f"outputs has {len(found)} rows and {len(named)} names ({', '.join(named)})",
            rows=len(found),
            names=named,
        )
    taken = next((name for name in named if name in symbols), None)
    if taken is not None:
        raise PlantError(
            f"output {taken}: the name is taken by a signal; give other names=", symbol=taken
        )
    units = per_symbol(unit, named, "unit")
    units = [one_line(item, "outputs: unit=", LONGEST_UNIT, unit=item) for item in units]
    return dict(zip(named, found, strict=True)), tuple(units), output_ranges(limits, named)


def canonical(expression: sp.Expr) -> sp.Expr:
    """Rebuild an expression from its parts until it no longer changes.

    What SymPy was told not to evaluate is evaluated, and every float becomes the double
    it prints as, so that equal text means equal expressions.
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
            done[node] = _plain(node.func(*arguments))
        else:
            done[node] = node
    return done[node]


def _plain(node: sp.Basic) -> sp.Basic:
    """Let an exhaustive Piecewise end with True; write an if-then-else by and, or, not."""
    if isinstance(node, ITE):
        condition, yes, no = node.args
        return Or(And(condition, yes), And(Not(condition), no))
    if isinstance(node, sp.Piecewise) and (continued := _continued(node)) is not None:
        return continued
    if isinstance(node, sp.Piecewise) and node.args[-1][1] != sp.true:
        *cases, (last, condition) = node.args
        if Or(*(c for _, c in cases), condition) == sp.true:
            return sp.Piecewise(*cases, (last, True))
    return node


def _continued(node: sp.Piecewise) -> sp.Expr | None:
    """Return sinc, phi1 or tanhc for a quotient that is given its limit where z = 0."""
    (first, condition), (second, *_) = node.args[0], node.args[-1]
    if len(node.args) != 2 or not isinstance(condition, sp.Ne | sp.Eq):
        return None
    quotient, limit = (first, second) if isinstance(condition, sp.Ne) else (second, first)
    for function, named in ((sp.sin, sp.sinc), (sp.exp, phi1), (sp.tanh, tanhc)):
        for atom in sorted(quotient.atoms(function), key=str):
            (z,), top = atom.args, atom - 1 if function is sp.exp else atom
            share = sp.cancel(z / (condition.lhs - condition.rhs))
            same = sp.expand(quotient * z - limit * top) == 0
            if share.is_number and share.is_nonzero and same:
                return limit * named(z)
    return None


def _read(row: Any, symbols: Mapping[str, sp.Symbol], where: str) -> sp.Expr:
    if isinstance(row, ca.SX | ca.MX | ca.DM):
        raise PlantError(f"{where}: this is a CasADi expression; use Plant.from_casadi")
    if isinstance(row, np.generic):
        row = row.item()
    if isinstance(row, str):
        try:
            row = read_text(row, symbols)
        except TextError as error:
            raise TextError(f"{where}: {error}", **error.facts | {"where": where}) from None
    if isinstance(row, bool) or not isinstance(row, int | float | sp.Basic | Symbols):
        raise PlantError(
            f"{where}: {row!r} is not an expression of the plant's symbols: give text or SymPy's, "
            "one scalar to a row",
            where=where,
        )
    expression = sp.sympify(row)
    # SymPy's Symbol is itself a Boolean, so only relations and connectives are asked for.
    if isinstance(expression, Relational | BooleanFunction | BooleanTrue | BooleanFalse):
        raise PlantError(
            f"{where}: {expression} is a condition; give the right-hand side alone", where=where
        )
    for together in expression.atoms(SymbolTuple):
        raise Together(together, where)
    if not isinstance(expression, sp.Expr):
        raise PlantError(f"{where}: {expression} is not a scalar expression", where=where)
    replace = {}
    for symbol in sorted(expression.free_symbols, key=str):
        replace[symbol] = _match(symbol, symbols, where)
    try:
        expression = canonical(expression.xreplace(replace))
    except (TypeError, ValueError, ArithmeticError) as error:
        raise PlantError(
            f"{where}: {expression} is not a real function ({error})", where=where
        ) from error
    _check_nodes(expression, where)
    return expression


def _match(symbol: sp.Basic, symbols: Mapping[str, sp.Symbol], where: str) -> sp.Symbol:
    """Return the declared symbol a free symbol stands for."""
    name = str(symbol)
    declared = symbols.get(name)
    if declared is None:
        raise PlantError(
            f"{where}: {undeclared(name, symbols)}",
            symbol=name,
            declared=tuple(symbols),
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
        if isinstance(node, sp.Number) or node in (sp.I, sp.zoo):
            if not (isinstance(node, sp.Rational | sp.Float) and math.isfinite(_float(node))):
                raise PlantError(
                    f"{where}: {node} in {expression} is not a finite real number", where=where
                )
        elif isinstance(node, sp.Expr) and node.is_number:
            try:
                nearest_double(node)
            except PlantError as error:
                raise PlantError(f"{where}: {error}", where=where, number=node) from None
        elif isinstance(node, And | Or | Not | ExprCondPair):
            conditions = node.args[1:] if isinstance(node, ExprCondPair) else node.args
            if any(isinstance(condition, sp.Symbol) for condition in conditions):
                raise PlantError(f"{where}: a symbol is used as a condition in {node}", where=where)
        elif isinstance(node, sp.Piecewise) and node.args[-1][1] != sp.true:
            raise PlantError(
                f"{where}: {node} leaves cases open; end it with (expression, True)", where=where
            )
        elif not (isinstance(node, _PLAIN) or node in (sp.pi, sp.E) or node.func in BY_CLASS):
            name = node.func.__name__
            raise PlantError(
                f"{where}: the function {name} in {expression} is not supported; supported are "
                f"{', '.join(sorted(BY_NAME))}, Piecewise",
                function=name,
                where=where,
            )


def _float(number: sp.Number) -> float:
    try:
        return float(number)
    except OverflowError:
        return math.inf


def insert_faults(
    rows: Sequence[sp.Expr], outputs: Mapping[str, sp.Expr], signals: Sequence[Signal]
) -> tuple[sp.Matrix, sp.Matrix]:
    """Put additive faults into the equations.

    Every input v with an actuator fault f becomes v + f, in the outputs too, since it is
    what the actuator does; every output with a sensor fault becomes y + f.
    """
    inputs = {s.name: s.symbol for s in signals if s.role is Role.INPUT}
    shift: dict[sp.Symbol, sp.Expr] = {}
    sensor: dict[str, sp.Symbol] = {}
    for signal in signals:
        if signal.role is Role.ACTUATOR_FAULT:
            shift[inputs[str(signal.of)]] = inputs[str(signal.of)] + signal.symbol
        elif signal.role is Role.SENSOR_FAULT:
            sensor[str(signal.of)] = signal.symbol
    rhs = [row.xreplace(shift) for row in rows]
    y = [row.xreplace(shift) + sensor.get(name, 0) for name, row in outputs.items()]
    return sp.ImmutableMatrix(len(rhs), 1, rhs), sp.ImmutableMatrix(len(y), 1, y)
