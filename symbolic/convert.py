"""SymPy expressions as CasADi SX expressions.

A tree walk of our own: SymPy's code printers have no form for ``Abs``, ``sign``,
``Piecewise``, ``Max``, ``Min``, ``Heaviside`` and ``sinc`` in CasADi. Equal
sub-expressions become one node of the SX graph, and every constant of the graph is
the double nearest to an exact constant of the equation, rounded once.
"""

import math
from collections.abc import Mapping, Sequence

import casadi as ca
import sympy as sp
from sympy.core.relational import Relational
from sympy.logic.boolalg import And, BooleanFalse, BooleanTrue, Not, Or

from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.functions import BY_CLASS, BY_NAME

_RELATIONS = {
    sp.StrictLessThan: lambda a, b: a < b,
    sp.LessThan: lambda a, b: a <= b,
    sp.StrictGreaterThan: lambda a, b: a > b,
    sp.GreaterThan: lambda a, b: a >= b,
    sp.Equality: lambda a, b: a == b,
    sp.Unequality: lambda a, b: a != b,
}


def nearest_double(number: sp.Expr) -> float:
    """Return the double nearest to an exact real number, rounded from 40 digits if irrational.

    PlantError where it is not real, not finite or beyond the range of doubles.
    """
    try:
        if isinstance(number, sp.Rational):
            return int(number.p) / int(number.q)
        value = float(number if isinstance(number, sp.Float) else number.evalf(40))
    except (ArithmeticError, TypeError) as error:
        raise PlantError(f"the constant {number} is not a real double", number=number) from error
    if not math.isfinite(value):
        raise PlantError(f"the constant {number} is not finite", number=number)
    return value


def to_sx(
    expressions: Sequence[sp.Expr], symbols: Mapping[sp.Symbol, ca.SX], labels: Sequence[str]
) -> list[ca.SX]:
    """Convert SymPy expressions to SX scalars; labels are what the rows are called in messages.

    PlantError names a symbol without an SX counterpart, or a function without a CasADi form.
    """
    walker = _Walker(symbols)
    rows = []
    for label, expression in zip(labels, expressions, strict=True):
        walker.where = label
        rows.append(walker.visit(expression))
    return rows


def column(items: Sequence[ca.SX]) -> ca.SX:
    """Stack scalars densely; of none, a column without entries."""
    return ca.densify(ca.vertcat(*items)) if items else ca.SX(0, 1)


def sx_function(
    name: str, inputs: Mapping[str, Sequence[sp.Symbol]], outputs: Mapping[str, sp.Matrix]
) -> ca.Function:
    """Make a CasADi function of named columns of symbols with named matrices as outputs."""
    given = {kind: [ca.SX.sym(str(s)) for s in symbols] for kind, symbols in inputs.items()}
    table = {s: e for kind in inputs for s, e in zip(inputs[kind], given[kind], strict=True)}
    values = []
    for label, matrix in outputs.items():
        entries = to_sx(list(matrix.T), table, [label] * len(matrix))
        values.append(ca.reshape(column(entries), *matrix.shape))
    return ca.Function(name, list(map(column, given.values())), values, list(inputs), list(outputs))


class _Walker:
    """The tree walk with its memory of sub-expressions already converted."""

    def __init__(self, symbols: Mapping[sp.Symbol, ca.SX]) -> None:
        self.symbols = symbols
        self.done: dict[sp.Basic, ca.SX] = {}
        self.where = ""

    def visit(self, node: sp.Basic) -> ca.SX:
        if node not in self.done:
            self.done[node] = self._build(node)
        return self.done[node]

    def _build(self, node: sp.Basic) -> ca.SX:
        if isinstance(node, sp.Symbol):
            if node not in self.symbols:
                raise PlantError(
                    f"{self.where}: the symbol {node} is not one of the plant's", symbol=str(node)
                )
            return self.symbols[node]
        if isinstance(node, sp.Expr) and node.is_number:
            return ca.SX(self._double(node))
        if isinstance(node, sp.Add):
            return self._add(node)
        if isinstance(node, sp.Mul):
            return self._mul(node)
        if isinstance(node, sp.Pow):
            return self._pow(node.base, node.exp)
        if isinstance(node, sp.Piecewise):
            return self._piecewise(node)
        if isinstance(node, Relational | And | Or | Not | BooleanTrue | BooleanFalse):
            return self._condition(node)
        function = BY_CLASS.get(node.func)
        if function is None:
            raise PlantError(
                f"{self.where}: the function {node.func.__name__} in {node} is not supported; "
                f"supported are {', '.join(sorted(BY_NAME))}, Piecewise",
                function=node.func.__name__,
                where=self.where,
            )
        result: ca.SX = function.casadi(*(self.visit(argument) for argument in node.args))
        return result

    def _double(self, number: sp.Expr) -> float:
        try:
            return nearest_double(number)
        except PlantError as error:
            raise PlantError(f"{self.where}: {error}", where=self.where, number=number) from None

    def _add(self, node: sp.Add) -> ca.SX:
        constants = [term for term in node.args if term.is_number]
        total = ca.SX(0)
        for term in node.as_ordered_terms():
            if term.is_number:
                continue
            # A difference in place of the sum with a negated term, as one would write it.
            if isinstance(term, sp.Mul) and term.could_extract_minus_sign():
                total = total - self.visit(-term)
            else:
                total = total + self.visit(term)
        if constants:
            constant = self._double(sp.Add(*constants))
            total = total - (-constant) if constant < 0 else total + constant
        return total

    def _mul(self, node: sp.Mul) -> ca.SX:
        numbers, top, bottom = [], [], []
        for factor in node.args:
            base, exponent = factor.as_base_exp()
            if factor.is_number:
                numbers.append(factor)
            elif isinstance(factor, sp.Pow) and exponent.is_number and exponent.is_negative:
                bottom.append(self._pow(base, -exponent))
            else:
                top.append(self.visit(factor))
        constant = self._double(sp.Mul(*numbers)) if numbers else 1.0
        if constant not in (1.0, -1.0):
            top.insert(0, ca.SX(abs(constant)))
        product = _product(top)
        if bottom:
            product = product / _product(bottom)
        return -product if constant < 0 else product

    def _pow(self, base: sp.Expr, exponent: sp.Expr) -> ca.SX:
        if exponent.is_number and exponent.is_negative:
            return 1 / self._pow(base, -exponent)
        value = self.visit(base)
        if exponent == 1:
            return value
        if exponent == sp.Rational(1, 2):
            return ca.sqrt(value)
        if isinstance(exponent, sp.Integer):
            return value ** int(exponent)
        doubled = 2 * exponent
        if isinstance(doubled, sp.Integer):
            return value ** int((doubled - 1) / 2) * ca.sqrt(value)
        return value ** self.visit(exponent)

    def _piecewise(self, node: sp.Piecewise) -> ca.SX:
        *cases, (otherwise, condition) = node.args
        if condition != sp.true:
            raise PlantError(
                f"{self.where}: {node} leaves cases open; end it with (expression, True)",
                where=self.where,
            )
        tests = [one for _, test in cases for one in sp.ordered(test.atoms(Relational))]
        tested = [side for test in tests for side in test.args if side.args and not side.is_number]
        result = self._piece(otherwise, tested)
        for value, condition in reversed(cases):
            result = ca.if_else(self.visit(condition), self._piece(value, tested), result)
        return result

    def _piece(self, value: sp.Expr, tested: Sequence[sp.Expr]) -> ca.SX:
        """Write a piece that is affine in what is tested by that very node.

        Where a test goes wrong by rounding, both pieces are then seen to be nearly the same.
        """
        offset, rest = value.as_coeff_Add()
        for side in tested:
            factor = rest / side
            if factor.is_number and factor != 0:
                return self._double(factor) * self.visit(side) + self._double(offset)
        return self.visit(value)

    def _condition(self, node: sp.Basic) -> ca.SX:
        if isinstance(node, BooleanTrue | BooleanFalse):
            return ca.SX(1.0 if node == sp.true else 0.0)
        arguments = [self.visit(argument) for argument in node.args]
        if isinstance(node, Not):
            return ca.logic_not(arguments[0])
        if isinstance(node, And | Or):
            join = ca.logic_and if isinstance(node, And) else ca.logic_or
            result = arguments[0]
            for argument in arguments[1:]:
                result = join(result, argument)
            return result
        compared: ca.SX = _RELATIONS[node.func](*arguments)
        return compared


def _product(factors: list[ca.SX]) -> ca.SX:
    if not factors:
        return ca.SX(1.0)
    result = factors[0]
    for factor in factors[1:]:
        result = result * factor
    return result
