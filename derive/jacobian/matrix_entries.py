"""Entries of a matrix function, from exact SymPy to what the interval engine takes.

Every number in an expression becomes a constant of its own with a proven enclosure, so that CasADi
has nothing to fold and no rounding escapes: in x (sqrt(2) - 1.414...) the difference is formed
exactly before it is rounded once.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import sympy as sp

from obsynth.derive.algebra.factorise import expand_terms
from obsynth.derive.algebra.sizes import size, text
from obsynth.derive.algebra.slopes import jacobian
from obsynth.derive.errors import UnboundedError
from obsynth.derive.intervals.ranges import Ranges, bound_ranges, make_problem
from obsynth.derive.intervals.rewriting.quotients import Quotients
from obsynth.derive.intervals.search.batch import Problem
from obsynth.derive.rigour import enclose_number, substitute
from obsynth.derive.split import Split
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.convert import column, to_sx
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.signals import Signal

Entry = tuple[int, int]
KINDS = ("x", "u", "p", "rho", "d", "f", "w")
"""The order of variables."""
_EXACT_BITS = 24
_SAMPLES = 96
# Parts of an expression that is written out in a refusal.
_SHORT = 60


@dataclass(frozen=True, eq=False)
class MatrixEntries:
    """Entries that are not identically zero, as functions of the signals they depend on.

    ``values`` are the ``exact`` ones, numbers as symbols in ``constants``, further symbols for
    ``quotients``; ``variables`` is the first state where no signal occurs.
    """

    exact: dict[Entry, sp.Expr]
    values: ca.SX
    variables: ca.SX
    names: tuple[str, ...]
    symbols: tuple[sp.Symbol, ...]
    box: FloatArray
    constants: ca.SX
    constant_box: list[tuple[float, float]]
    model: Plant
    quotients: Quotients | None = None

    @property
    def places(self) -> list[Entry]:
        """Row and column of every entry."""
        return list(self.exact)

    def take(self, which: Sequence[int]) -> "MatrixEntries":
        """Return some of the entries, with the signals that they need."""
        places = self.places
        exact = {places[k]: self.exact[places[k]] for k in which}
        present = {s for expression in exact.values() for s in expression.free_symbols}
        # arguments of quotients may hold signals that none of the entries has
        every = self.quotients is not None
        kept = [k for k, s in enumerate(self.symbols) if every or s in present] or [0]
        return replace(
            self,
            exact=exact,
            values=column([self.values[int(k)] for k in which]),
            variables=column([self.variables[k] for k in kept]),
            names=tuple(self.names[k] for k in kept),
            symbols=tuple(self.symbols[k] for k in kept),
            box=self.box[kept],
        )

    def problem(self) -> Problem:
        """Return the entries with their gradients as an interval program."""
        return make_problem(
            self.values, self.variables, self.box, self.constants, self.constant_box
        )

    def search(self, rtol: float, effort: str, values: ca.SX | None = None) -> Ranges:
        """Bound every entry, or other functions of the same signals; some may stay unbounded."""
        return bound_ranges(
            self.values if values is None else values,
            self.variables,
            self.box,
            self.constants,
            self.constant_box,
            rtol=rtol,
            effort=effort,
            quotients=self.quotients,
        )

    def ranges(self, rtol: float, effort: str, what: str = "entry") -> Ranges:
        """Bound every entry over the box, or refuse."""
        found = self.search(rtol, effort)
        if not found.failures:
            return found
        boxes, lines = {}, []
        for failure in found.failures:
            place = self.places[failure.index]
            whole = failure.box(self.names)
            box = {name: whole[name] for name in self.support(place)}
            name = f"{what}[{place[0] + 1},{place[1] + 1}]"
            where = ", ".join(f"{s} in [{lo:.9g}, {hi:.9g}]" for s, (lo, hi) in box.items())
            shown = f" = {text(self.exact[place])}" if size(self.exact[place]) <= _SHORT else ""
            lines.append(f"{name}{shown} ({failure.operation} at {where})")
            boxes[name] = box
        raise UnboundedError(
            f"no finite bound over the box for {'; '.join(lines)}. Keep the range of "
            f"{', '.join(sorted({s for box in boxes.values() for s in box}))} away from there",
            entries=tuple(boxes),
            operation=found.failures[0].operation,
            sub_box=next(iter(boxes.values())),
            sub_boxes=boxes,
        )

    def support(self, place: Entry) -> tuple[str, ...]:
        """Names of the signals on which an entry depends."""
        expression = self.exact[place]
        return tuple(n for n, s in zip(self.names, self.symbols, strict=True) if expression.has(s))

    def named(self, point: FloatArray) -> dict[str, float]:
        """Return the values at a point by name, without signals on which nothing depends."""
        present = {s for expression in self.exact.values() for s in expression.free_symbols}
        return {
            name: float(value)
            for name, symbol, value in zip(self.names, self.symbols, point, strict=True)
            if symbol in present
        }

    def sample(self, corners: bool = True) -> dict[Entry, FloatArray]:
        """Evaluate the entries at fixed random points, some of them corners, of their domain."""
        if not self.exact:
            return {}
        rng = np.random.default_rng(0)
        # fewer samples than entries could not tell which depend on each other
        count = max(_SAMPLES, len(self.exact) + _SAMPLES // 2)
        lower = np.where(np.isfinite(self.box[:, 0]), self.box[:, 0], -1.0)
        upper = np.where(np.isfinite(self.box[:, 1]), self.box[:, 1], lower + 2.0)
        share = rng.random((count, len(lower)))
        if corners:
            share[: count // 3] = np.round(share[: count // 3])
        result = self.at(lower + share * (upper - lower))
        return dict(zip(self.places, result, strict=True))

    def at(self, points: FloatArray) -> FloatArray:
        """Evaluate the entries in doubles, shape (entries, points of (N, v) in their domain)."""
        middle = np.array([0.5 * lo + 0.5 * hi for lo, hi in self.constant_box])
        values = self.values if self.quotients is None else self.quotients.closed(self.values)
        function = ca.Function("at", [self.variables, self.constants], [values])
        result = np.array(function(points.T, np.tile(middle[:, None], (1, len(points)))))
        return result[:, np.isfinite(result).all(axis=0)]


def exact_jacobian(split_or_model: Split | Plant) -> sp.Matrix:
    """Differentiate g of a split, or the right-hand side of a plant, by the states."""
    if isinstance(split_or_model, Split):
        rows, model = split_or_model.g, split_or_model.model
    else:
        model = split_or_model
        rows = model.rhs.applyfunc(lambda e: substitute(e, model.constant_values))
    return jacobian(rows, [s.symbol for s in model.x])


def matrix_entries(
    entries: Mapping[Entry, sp.Expr], model: Plant, more: Sequence[Signal] = ()
) -> MatrixEntries:
    """Prepare exact expressions of a plant's signals for the interval engine."""
    values = model.constant_values
    # denominators stay whole: written out, 1/(1 + (a - b)^2) has no bound over a box
    exact = {
        place: expression
        for place in sorted(entries)
        if (expression := sp.Add(*expand_terms(substitute(entries[place], values)))) != 0
    }
    present = {s for expression in exact.values() for s in expression.free_symbols}
    available = [*(s for kind in KINDS for s in getattr(model, kind)), *more]
    # the interval engine wants a box, for constants as well
    signals = [s for s in available if s.symbol in present] or [model.x[0]]
    numbers: dict[sp.Expr, sp.Dummy] = {}
    rows = [_hoist(expression, numbers) for expression in exact.values()]
    columns = {s.symbol: ca.SX.sym(s.name) for s in signals}
    held = {dummy: ca.SX.sym(f"number{k}") for k, dummy in enumerate(numbers.values())}
    labels = [f"entry ({i + 1}, {j + 1})" for i, j in exact]
    return MatrixEntries(
        exact,
        column(to_sx(rows, columns | held, labels)),
        column(list(columns.values())),
        tuple(s.name for s in signals),
        tuple(columns),
        np.array([(s.lower, s.upper) for s in signals], dtype=float).reshape(-1, 2),
        column(list(held.values())),
        [enclose_number(number) for number in numbers],
        model,
    )


def _hoist(expression: sp.Basic, numbers: dict[sp.Expr, sp.Dummy]) -> sp.Basic:
    """Replace numbers that are no short binary fractions by symbols."""
    if isinstance(expression, sp.Expr) and expression.is_number:
        if expression.is_Rational and _is_short(expression):
            return expression
        return numbers.setdefault(expression, sp.Dummy(f"n{len(numbers)}", real=True))
    if not expression.args:
        return expression
    if expression.is_Pow:
        # a rational exponent stays: whether it is an integer decides about the domain
        power = expression.exp
        power = power if power.is_Rational else _hoist(power, numbers)
        return sp.Pow(_hoist(expression.base, numbers), power)
    if expression.is_Add or expression.is_Mul:
        numeric = [a for a in expression.args if a.is_number]
        if len(numeric) > 1:
            rest = [a for a in expression.args if not a.is_number]
            parts = [
                _hoist(expression.func(*numeric), numbers),
                *(_hoist(a, numbers) for a in rest),
            ]
            return expression.func(*parts)
    return expression.func(*(_hoist(a, numbers) for a in expression.args))


def _is_short(number: sp.Rational) -> bool:
    power_of_two = int(number.q) & (int(number.q) - 1) == 0
    return power_of_two and abs(int(number.p)) < 2**_EXACT_BITS and int(number.q) <= 2**60
