"""Recognition of removable singularities: divisions by what may be zero that do no harm.

sin(x)/x, (exp(x - y) - 1)/(x - y), log(x)/(x - 1), cos(x)/x - sin(x)/x**2: where all that is
singular is a function of one quantity, the orders of the zeros of numerator and denominator are
compared exactly, and the quotient becomes a member of `Quotients`. So do the Taylor patches of
sinc, phi1 and tanhc. The bounds are those of the continuous function, whatever floating point makes
of 0/0.
"""

from collections.abc import Iterator, Mapping, Sequence

import casadi as ca
import sympy as sp

from obsynth.derive.intervals.graph import reached
from obsynth.derive.intervals.program import Program, evaluate
from obsynth.derive.intervals.rewriting.quotients import Quotient, Quotients
from obsynth.derive.intervals.search.reduction import SxGraph
from obsynth.derive.rigour import substitute
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.convert import to_sx
from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.from_casadi import from_tape
from obsynth.symbolic.functions import BY_NAME

# Inside this distance of zero the named functions switch to their Taylor polynomials.
_PATCH = 1.0 / 8.0
_HIGHEST_ORDER = 4
_LARGEST = 200
_DEEP = 100
_PATCHED = {"sinc": ca.sin, "phi1": ca.expm1, "tanhc": ca.tanh}
_KINKS = (sp.Abs, sp.sign, sp.Piecewise, sp.Max, sp.Min, sp.floor, sp.ceiling, sp.Heaviside)


def remove_singularities(
    column: ca.SX,
    variables: ca.SX,
    extra: ca.SX,
    box: FloatArray,
    constant_box: Sequence[tuple[float, float]],
) -> tuple[ca.SX, Quotients] | None:
    """Replace quotients with removable singularities in the box by symbols."""
    graph = SxGraph(column, variables, extra)
    if not any(graph.nodes[k][0] in _SUSPECTS for k in range(len(graph.nodes))):
        return None
    search = _Search(graph, variables, extra, box, constant_box)
    given = search.run()
    if not search.quotients.members:
        return None
    done = [graph.expression(graph.roots[k], given) for k in range(column.numel())]
    return ca.vertcat(*done), search.quotients


_SUSPECTS = frozenset({ca.OP_DIV, ca.OP_INV, ca.OP_IF_ELSE_ZERO})
_SUMS = frozenset({ca.OP_ADD, ca.OP_SUB})


class _Search:
    """One pass over a graph, from the leaves to the expressions."""

    def __init__(
        self,
        graph: SxGraph,
        variables: ca.SX,
        extra: ca.SX,
        box: FloatArray,
        constant_box: Sequence[tuple[float, float]],
    ) -> None:
        self.graph, self.extra = graph, extra
        self.quotients = Quotients()
        self.given: dict[int, ca.SX] = {}
        self.open: dict[int, frozenset[int]] = {}
        self.symbol = sp.Symbol("s", real=True)
        self.parameters = [sp.Symbol(f"c{k}", real=True) for k in range(extra.numel())]
        self.products: dict[int, tuple[float, dict[int, int]]] = {}
        self.patches = {
            k: found for k in range(len(graph.nodes)) if (found := _patch(graph, k)) is not None
        }
        self.known: dict[tuple[int, str, str, int], ca.SX] = {}
        suspects = [k for k, node in enumerate(graph.nodes) if node[0] in _SUSPECTS]
        watched = sorted(
            {d for k in suspects for d in self._divisors(k)} | {z for _, z in self.patches.values()}
        )
        self.near_zero: set[int] = set()
        self.has_zero: set[int] = set()
        if not watched:
            return
        values = ca.vertcat(*[graph.expression(k) for k in watched])
        function = ca.Function("watched", [variables, extra], [ca.densify(values)])
        program = Program.from_casadi(function, {1: list(constant_box)})
        low, high = evaluate(program, box[:, :1], box[:, 1:])
        for k, first, last in zip(watched, low[:, 0], high[:, 0], strict=True):
            if first < _PATCH and last > -_PATCH:
                self.near_zero.add(k)
            if first <= 0.0 <= last:
                self.has_zero.add(k)

    def run(self) -> dict[int, ca.SX]:
        graph = self.graph
        self.products.clear()
        for k, (code, args, _) in enumerate(graph.nodes):
            left = frozenset().union(*(self.open.get(a, frozenset()) for a in args))
            if k in self.patches and self.patches[k][1] in self.near_zero:
                self._replace_patch(k, *self.patches[k])
                left = frozenset()
            elif code in (ca.OP_DIV, ca.OP_INV):
                if any(d in self.has_zero for d in self._divisors(k)):
                    left = self._divide(k, left)
            elif code in _SUMS and left:
                left = self._add(k, left)
            if left:
                self.open[k] = left
            if k in self.given:
                self.products.pop(k, None)
        return self.given

    # -- what a node is made of ------------------------------------------------------

    def _factors(self, k: int) -> dict[int, int]:
        """Exponents of the factors of a node, without numbers."""
        return self._product(k)[1]

    def _product(self, k: int) -> tuple[float, dict[int, int]]:
        """Sign and power of two of a node, and exponents of its other factors."""
        if k in self.products:
            return self.products[k]
        code, args, _ = self.graph.nodes[k]
        number, result = 1.0, dict[int, int]()
        parts: list[tuple[int, int]] = []
        if k in self.given:
            parts = []
        elif code == ca.OP_MUL:
            parts = [(args[0], 1), (args[1], 1)]
        elif code == ca.OP_SQ:
            parts = [(args[0], 2)]
        elif code == ca.OP_DIV:
            parts = [(args[0], 1), (args[1], -1)]
        elif code == ca.OP_INV:
            parts = [(args[0], -1)]
        elif code in (ca.OP_NEG, ca.OP_TWICE):
            number, parts = (-1.0 if code == ca.OP_NEG else 2.0), [(args[0], 1)]
        elif code in (ca.OP_CONSTPOW, ca.OP_POW):
            exponent = self._integer(args[1])
            parts = [] if exponent is None else [(args[0], exponent)]
        for node, times in parts:
            inner, factors = self._product(node)
            number *= inner**times
            for factor, exponent in factors.items():
                result[factor] = result.get(factor, 0) + times * exponent
        if not parts:
            result = {k: 1}
        self.products[k] = number, {f: exponent for f, exponent in result.items() if exponent}
        return self.products[k]

    def _integer(self, k: int) -> int | None:
        code, _, value = self.graph.nodes[k]
        whole = code == ca.OP_CONST and isinstance(value, float) and value.is_integer()
        return int(value) if whole and abs(value) <= _HIGHEST_ORDER else None  # type: ignore[arg-type]

    def _divisors(self, k: int) -> list[int]:
        return [d for d, exponent in self._factors(k).items() if exponent < 0]

    def _depends_only_on(self, k: int, base: int) -> bool:
        """Whether a node sees the variables through another node only."""
        nodes, seen = self.graph.nodes, self.graph.supports
        met = reached([k], lambda n: () if n == base or not seen[n] else nodes[n][1])
        return not any(nodes[n][0] == ca.OP_INPUT and seen[n] and n != base for n in met)

    def _bases(self, k: int) -> list[int]:
        """Nodes through which alone a node sees its variables, itself first."""
        graph, support = self.graph, self.graph.supports[k]
        cone = reached(
            [k], lambda n: [a for a in graph.nodes[n][1] if graph.supports[a] == support]
        )
        return [b for b in sorted(cone, reverse=True) if self._depends_only_on(k, b)]

    # -- replacements ----------------------------------------------------------------

    def _replace_patch(self, k: int, name: str, z: int) -> None:
        s = ca.SX.sym("s")
        argument = self.graph.expression(z, self.given)
        self.given[k] = self.quotients.add(Quotient(argument, _PATCHED[name](s), s, 1))

    def _divide(self, k: int, left: frozenset[int]) -> frozenset[int]:
        """Take removable singularities out of a product of factors; return what stays."""
        coefficient, factors = self._product(k)[0], dict(self._factors(k))
        product, changed = ca.SX(coefficient), False
        for divisor in [d for d, exponent in factors.items() if exponent < 0]:
            if divisor not in self.has_zero or divisor not in factors:
                continue
            found = self._cancel(divisor, factors)
            if found is not None:
                product, changed = product * found, True
        stays = [d for d, exponent in factors.items() if exponent < 0 and d in self.has_zero]
        if changed:
            for factor, exponent in factors.items():
                value = self.graph.expression(factor, self.given)
                product = product * value**exponent if exponent > 0 else product / value**-exponent
            self.given[k] = product
            left = frozenset().union(*(self.open.get(f, frozenset()) for f in factors))
        return left | frozenset(stays)

    def _cancel(self, divisor: int, factors: dict[int, int]) -> ca.SX | None:
        """Find factors that cancel a divisor; take them out of the factors on success."""
        for base in self._bases(divisor):
            group = [f for f in factors if self._depends_only_on(f, base)]
            group = [f for f in group if self.graph.supports[f]]
            found = self._smooth(base, {f: factors[f] for f in group})
            if found is not None:
                for f in group:
                    del factors[f]
                return found
        for factor in [f for f, exponent in factors.items() if exponent > 0]:
            for base in self._bases(factor):
                number, parts = self._product(base)
                if base == divisor or parts.get(divisor) != 1 or factors[divisor] != -1:
                    continue
                found = self._smooth(base, {factor: factors[factor], base: -1})
                if found is not None:
                    del factors[factor], factors[divisor]
                    for part, exponent in parts.items():
                        if part != divisor:
                            factors[part] = factors.get(part, 0) + exponent
                    return found * number
        return None

    def _add(self, k: int, left: frozenset[int]) -> frozenset[int]:
        """Look at a sum whose terms are singular one by one."""
        for divisor in sorted(left):
            for base in self._bases(divisor):
                if self._depends_only_on(k, base):
                    found = self._smooth(base, {k: 1})
                    if found is not None:
                        self.given[k] = found
                        return frozenset()
        return left

    # -- the quotients themselves ------------------------------------------------------

    def _smooth(self, base: int, factors: Mapping[int, int]) -> ca.SX | None:
        """Turn a product of functions of one node into quotients, if it is smooth at zero."""
        s = ca.SX.sym("s")
        product = ca.SX(1)
        for factor, exponent in factors.items():
            product = product * self.graph.expression(factor, {base: s}) ** exponent
        function = ca.Function("product", [s, self.extra], [product])
        try:
            (whole,) = from_tape(function, [[self.symbol], self.parameters], ["a quotient"])
        except PlantError:
            return None
        if whole.has(*_KINKS) or whole.count_ops() > _LARGEST:
            return None
        whole = substitute(whole, {})
        argument = self.graph.expression(base, self.given)
        for numerator, denominator, shift in self._centred(whole):
            order, rise = _order(denominator, self.symbol), _order(numerator, self.symbol)
            if order is None or rise is None or not 1 <= order <= rise:
                continue
            at = argument - float(shift) if shift else argument
            top = self._part(base, at, numerator, order)
            bottom = self._part(base, at, denominator, order)
            return top / bottom
        return None

    def _centred(self, whole: sp.Expr) -> Iterator[tuple[sp.Expr, sp.Expr, sp.Expr]]:
        """Numerator and denominator around zero and around the zero of a linear denominator."""
        numerator, denominator = sp.fraction(sp.together(whole))
        yield numerator, denominator, sp.Integer(0)
        for factor in sp.Mul.make_args(sp.factor_terms(denominator)):
            slope = sp.diff(factor, self.symbol)
            if slope.is_Rational and slope != 0 and factor.free_symbols == {self.symbol}:
                zero = -factor.subs(self.symbol, 0) / slope
                if zero != 0 and sp.Rational(float(zero)) == zero:
                    moved = {self.symbol: self.symbol + zero}
                    yield numerator.subs(moved), sp.expand(denominator.subs(moved)), zero

    def _part(self, base: int, argument: ca.SX, function: sp.Expr, order: int) -> ca.SX:
        """Write function/s**order as an expression of the argument."""
        s = self.symbol
        if function.is_polynomial(s):
            return self._sx(sp.cancel(function / s**order), argument)
        key = (base, str(argument), sp.srepr(function), order)
        if key not in self.known:
            inner = ca.SX.sym("s")
            quotient = Quotient(argument, self._sx(function, inner), inner, order)
            self.known[key] = self.quotients.add(quotient)
        return self.known[key]

    def _sx(self, function: sp.Expr, argument: ca.SX) -> ca.SX:
        symbols = dict(zip(self.parameters, ca.vertsplit(self.extra), strict=True))
        (result,) = to_sx([function], {self.symbol: argument, **symbols}, ["a quotient"])
        return result


def _order(function: sp.Expr, symbol: sp.Symbol) -> int | None:
    """Order of the zero at zero, exactly; None if too high or not known."""
    for order in range(_HIGHEST_ORDER + 1):
        value = function.subs(symbol, 0)
        if not value.is_finite:
            return None
        if sp.expand(value) != 0:
            return order
        function = sp.diff(function, symbol)
    return None


def _patch(graph: SxGraph, k: int) -> tuple[str, int] | None:
    """Name and argument of a node that is one of the patched functions, letter by letter."""
    code, args, _ = graph.nodes[k]
    if code != ca.OP_ADD or any(graph.nodes[a][0] != ca.OP_IF_ELSE_ZERO for a in args):
        return None
    tests = [graph.nodes[graph.nodes[a][1][0]] for a in args]
    sizes = [graph.nodes[operands[0]] for code, operands, _ in tests if code == ca.OP_LT]
    for z in [operands[0] for code, operands, _ in sizes if code == ca.OP_FABS]:
        whole, argument = graph.expression(k), graph.expression(z)
        for name in _PATCHED:
            if ca.is_equal(whole, BY_NAME[name].casadi(argument), _DEEP):
                return name, z
    return None
