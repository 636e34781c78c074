"""Quotients N(z)/z**m that are smooth at z = 0, such as sin(z)/z, with all their derivatives.

Interval division by a z that contains zero says nothing, whatever the numerator does. But when N
and its first m - 1 derivatives vanish at zero, Taylor's formula with the integral remainder gives

    d^k/dz^k [N(z)/z^m] = int_0^1 (1 - t)^(m-1) t^k / (m-1)! N^(m+k)(t z) dt,

a mean of the derivative N^(m+k) between 0 and z with the weight k!/(m+k)!. So it lies in N^(m+k)
over that interval, times the weight. Every quotient becomes a symbol of its own here, every
derivative of it another one, and the chain rule is applied to them, since automatic differentiation
of the division would bring the singularity back.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import casadi as ca

from obsynth.derive.intervals.graph import Node
from obsynth.derive.intervals.program import Program


@dataclass(frozen=True, eq=False)
class Quotient:
    """One quotient N(z)/z**m, m the order, at least 1.

    argument: z, in the variables, the constants and the symbols of earlier quotients
    numerator: N, in ``symbol`` for z and the constants; smooth, with its first m derivatives
        (counting itself) zero where ``symbol`` is
    """

    argument: ca.SX
    numerator: ca.SX
    symbol: ca.SX
    order: int

    def closed(self, derivative: int) -> ca.SX:
        """Return a derivative of the quotient as it follows from the rules, in ``symbol``."""
        expression = self.numerator / self.symbol**self.order
        for _ in range(derivative):
            expression = ca.jacobian(expression, self.symbol)
        return expression

    def mean(self, derivative: int) -> tuple[ca.SX, int]:
        """Return N^(m+k) in ``symbol`` and the number (m+k)!/k! by which to divide it."""
        expression = self.numerator
        for _ in range(self.order + derivative):
            expression = ca.jacobian(expression, self.symbol)
        weight = math.factorial(self.order + derivative) // math.factorial(derivative)
        return expression, weight


@dataclass(eq=False)
class Quotients:
    """Quotients in expressions, their symbols, and what the symbols stand for.

    members: in an order in which every argument contains symbols of earlier ones only
    """

    members: list[Quotient] = field(default_factory=list)
    _symbols: dict[tuple[int, int], ca.SX] = field(default_factory=dict)

    def add(self, quotient: Quotient) -> ca.SX:
        """Return the symbol of a new quotient."""
        self.members.append(quotient)
        return self.symbol(len(self.members) - 1, 0)

    def symbol(self, member: int, derivative: int) -> ca.SX:
        """Return the symbol of a derivative of a quotient."""
        key = (member, derivative)
        if key not in self._symbols:
            self._symbols[key] = ca.SX.sym(f"q{member}_{derivative}")
        return self._symbols[key]

    @property
    def column(self) -> ca.SX:
        """All symbols, quotient by quotient."""
        return ca.vertcat(*[self._symbols[key] for key in sorted(self._symbols)])

    def jacobian(self, column: ca.SX, wrt: ca.SX) -> ca.SX:
        """Differentiate expressions, through the quotients too."""
        inner: dict[int, ca.SX] = {}
        for number, quotient in enumerate(self.members):
            inner[number] = self._total(quotient.argument, wrt, inner)
        return self._total(column, wrt, inner)

    def _total(self, column: ca.SX, wrt: ca.SX, inner: dict[int, ca.SX]) -> ca.SX:
        result = ca.jacobian(column, wrt)
        for (number, derivative), symbol in sorted(self._symbols.items()):
            if number in inner and ca.depends_on(column, symbol):
                slope = ca.jacobian(column, symbol) * self.symbol(number, derivative + 1)
                result = result + ca.mtimes(slope, inner[number])
        return ca.sparsify(result)

    def closed(self, column: ca.SX) -> ca.SX:
        """Put quotients in place of their symbols; undefined where a divisor is zero."""
        for number in reversed(range(len(self.members))):
            quotient = self.members[number]
            for key in sorted(self._symbols):
                if key[0] == number and ca.depends_on(column, self._symbols[key]):
                    value = ca.substitute(
                        quotient.closed(key[1]), quotient.symbol, quotient.argument
                    )
                    column = ca.substitute(column, self._symbols[key], value)
        return column

    def insert(
        self,
        program: Program,
        variables: tuple[ca.SX, Sequence[int]],
        extra: tuple[ca.SX, Sequence[int]],
    ) -> list[int]:
        """Put the quotients into an interval program.

        Shapes: variables, extra (casadi.SX, sequence of int).
        """
        nodes: list[int] = []
        keys = sorted(self._symbols)
        for number, derivative in keys:
            quotient = self.members[number]
            known = ca.vertcat(*[self._symbols[key] for key in keys[: len(nodes)]])
            inputs = [variables[0], extra[0], known]
            argument = ca.Function("argument", inputs, [ca.densify(quotient.argument)])
            (z,) = program.insert(argument, [variables[1], extra[1], nodes])
            inputs = [quotient.symbol, extra[0]]
            closed = ca.Function("closed", inputs, [ca.densify(quotient.closed(derivative))])
            expression, weight = quotient.mean(derivative)
            mean = ca.Function("mean", inputs, [ca.densify(expression)])
            (first,) = program.insert(closed, [[z], extra[1]])
            around = program.append(Node("with_zero", (z,)))
            (second,) = program.insert(mean, [[around], extra[1]])
            second = program.plain("divide", [second, program.number(weight, weight)])
            nodes.append(program.append(Node("meet", (first, second))))
        return nodes
