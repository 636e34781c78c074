"""Entries of a Jacobian, or of another matrix function, for the interval engine and for proofs.

Every number in an expression becomes a constant of its own with a proven enclosure, so that CasADi
has nothing to fold and no rounding escapes: in x (sqrt(2) - 1.414...) the difference is formed
exactly before it is rounded once.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import sympy as sp

from obsynth.derive.algebra.factorise import cancel_common_factors, expand_terms, products_to_sums
from obsynth.derive.algebra.linear_parts import jacobian, slope
from obsynth.derive.algebra.sizes import LARGEST_ROW, size, symbols, text
from obsynth.derive.errors import UnboundedError
from obsynth.derive.intervals.program import Program, evaluate
from obsynth.derive.intervals.ranges import Ranges, bound_ranges, make_problem
from obsynth.derive.intervals.rewriting.quotients import Quotients
from obsynth.derive.intervals.rewriting.removable import remove_singularities
from obsynth.derive.intervals.search.batch import Problem
from obsynth.derive.rigour import enclose_number, rational, substitute
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
# Expanding a longer entry costs more than the zeros it may show.
_LONG = 1000
COLUMNS = {"states": ("x",), "inputs": ("u",), "joint": ("x", "w")}
"""Kinds of signals that a Jacobian is taken by."""
# Two forms of a row are compared on boxes of this share of the ranges.
_SHARE, _BOXES = 0.25, 24
_GAIN = 0.9


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


def jacobian_entries(split_or_model: Split | Plant, wrt: str) -> MatrixEntries:
    """Collect the entries of a Jacobian that are not structurally zero, `wrt` as for bounds."""
    part = split_or_model if isinstance(split_or_model, Split) else None
    model = split_or_model.model if isinstance(split_or_model, Split) else split_or_model
    kinds = COLUMNS[wrt]
    kind = kinds[0]
    sx = model.sx(constants="symbol")
    columns = ca.vertcat(*(getattr(sx, k) for k in kinds))
    constants = [enclose_number(substitute(v, {})) for v in model.constant_values.values()]
    typed, written = list(model.rhs), ca.vertsplit(sx.rhs)
    if wrt == "joint":
        typed, written = [*typed, *model.output], [*written, *ca.vertsplit(sx.y)]
    rows, rhs = _preferred_rows(model, typed, written, constants)
    if part is not None:
        noise = ca.vertcat(sx.d, sx.f, sx.w)
        rhs = ca.substitute(rhs, noise, ca.SX.zeros(noise.numel()))
    jacobian, quotients = _differentiated(model, rhs, columns, constants)
    linear = None if part is None else (part.A if kind == "x" else part.B)
    wrt_symbols = [s.symbol for k in kinds for s in getattr(model, k)]
    quiet = {s.symbol: 0 for k in ("d", "f", "w") for s in getattr(model, k)}
    values, shifts, shift_symbols = [], [], []
    expressions: dict[Entry, sp.Expr] = {}
    for i, j in np.ndindex(jacobian.shape):
        present = jacobian.sparsity().has_nz(i, j)
        offset = 0.0 if linear is None else float(linear[i, j])
        if not present and offset == 0.0:
            continue
        value = jacobian[i, j] if present else ca.SX(0)
        exact = _exact_entry(rows[i], wrt_symbols[j], f"J{i + 1}_{j + 1}", model)
        if offset != 0.0:
            symbol = ca.SX.sym(f"a{i + 1}{j + 1}")
            shifts.append((offset, offset))
            shift_symbols.append(symbol)
            value, exact = value - symbol, exact - rational(offset)
        if part is not None:
            exact = exact.subs(quiet)
        if size(exact) < _LONG:
            exact = sp.expand(exact)
        if exact == 0:
            continue
        values.append(value)
        expressions[(i, j)] = exact
    column = ca.vertcat(*values) if values else ca.SX(0, 1)
    inner = [] if quotients is None else [q.argument for q in quotients.members]
    needed = {str(s) for s in ca.symvar(ca.vertcat(column, *inner))}
    signals, parts = [], []
    for k in KINDS:
        for signal, element in zip(getattr(model, k), ca.vertsplit(getattr(sx, k)), strict=True):
            if k == "x" or signal.name in needed:
                signals.append(signal)
                parts.append(element)
    return MatrixEntries(
        expressions,
        column,
        ca.vertcat(*parts),
        tuple(s.name for s in signals),
        tuple(s.symbol for s in signals),
        np.array([(s.lower, s.upper) for s in signals], dtype=float).reshape(-1, 2),
        ca.vertcat(sx.c, *shift_symbols),
        [*constants, *shifts],
        model,
        quotients,
    )


def _exact_entry(row: sp.Expr, symbol: sp.Symbol, name: str, model: Plant) -> sp.Expr:
    """Differentiate a row exactly; of one that is too long, say only what it depends on."""
    if size(row) > LARGEST_ROW:
        signals = symbols(row) - set(model.constant_values)
        return sp.Function(name)(*sorted(signals, key=str))
    return substitute(slope(substitute(row, {}), symbol), model.constant_values)


def all_variables(model: Plant) -> tuple[ca.SX, FloatArray]:
    """Return all signals of a plant but its constants, and their ranges."""
    sx = model.sx(constants="symbol")
    variables = ca.vertcat(*[getattr(sx, k) for k in KINDS])
    return variables, np.vstack([model.box(k).reshape(-1, 2) for k in KINDS])


def _differentiated(
    model: Plant, rhs: ca.SX, columns: ca.SX, constants: list[tuple[float, float]]
) -> tuple[ca.SX, Quotients | None]:
    """Jacobian, through quotients with removable singularities where there are some."""
    variables, box = all_variables(model)
    extra = model.sx(constants="symbol").c
    found = remove_singularities(ca.densify(rhs), variables, extra, box, constants)
    if found is None:
        return ca.jacobian(rhs, columns), None
    return found[1].jacobian(found[0], columns), found[1]


def _preferred_rows(
    model: Plant,
    rows: list[sp.Expr],
    rhs: list[ca.SX],
    constants: list[tuple[float, float]],
) -> tuple[list[sp.Expr], ca.SX]:
    """Return every row of the plant as it is or in a form with narrower ranges."""
    sx = model.sx(constants="symbol")
    columns = ca.vertcat(sx.x, sx.u)
    signals = [s for k in KINDS for s in getattr(model, k)] + list(model.constants)
    variables, box = all_variables(model)
    elements = ca.vertsplit(ca.vertcat(variables, sx.c))
    symbols = dict(zip((s.symbol for s in signals), elements, strict=True))

    def may_vanish(part: sp.Expr) -> bool:
        (value,) = to_sx([part], symbols, ["a denominator"])
        function = ca.Function("part", [variables, sx.c], [value])
        program = Program.from_casadi(function, {1: constants})
        lower, upper = evaluate(program, box[:, :1], box[:, 1:])
        return bool(lower[0, 0] <= 0.0 <= upper[0, 0])

    for i, typed in enumerate(rows):
        if size(typed) > LARGEST_ROW:
            continue
        shorter = cancel_common_factors(substitute(typed, {}), may_vanish)
        if shorter is not None:
            rows[i], (rhs[i],) = shorter, to_sx([shorter], symbols, [f"dynamics row {i + 1}"])
        other = products_to_sums(substitute(rows[i], {}))
        if other is None:
            continue
        (written,) = to_sx([other], symbols, [f"dynamics row {i + 1}"])
        forms = [ca.jacobian(form, columns) for form in (rhs[i], written)]
        widths = _mean_widths(forms, variables, sx.c, box, constants)
        if _is_narrower(widths[1], widths[0]):
            rows[i], rhs[i] = other, written
    return rows, ca.vertcat(*rhs)


def _mean_widths(
    forms: list[ca.SX],
    variables: ca.SX,
    extra: ca.SX,
    box: FloatArray,
    constants: list[tuple[float, float]],
) -> list[FloatArray]:
    """Widths of natural enclosures over some small boxes, shape (entries, boxes) for each form."""
    function = ca.Function("forms", [variables, extra], [ca.densify(form.T) for form in forms])
    program = Program.from_casadi(function, {1: constants})
    rng = np.random.default_rng(0)
    finite = np.isfinite(box).all(axis=1, keepdims=True)
    width = np.diff(np.where(finite, box, 0.0), axis=1)
    low = box[:, :1] + rng.random((len(box), _BOXES)) * (1.0 - _SHARE) * width
    high = np.where(finite, low + _SHARE * width, box[:, 1:])
    lower, upper = evaluate(program, low, high)
    with np.errstate(invalid="ignore"):
        return list(np.split(upper - lower, 2))


def _is_narrower(one: FloatArray, other: FloatArray) -> bool:
    """Whether widths are smaller than others, on the geometric mean of what can be compared."""
    with np.errstate(invalid="ignore", divide="ignore"):
        known = np.isfinite(one) & np.isfinite(other) & (np.maximum(one, other) > 0.0)
        floor = 1e-3 * np.maximum(one, other)
        ratio = np.log(np.maximum(one, floor) / np.maximum(other, floor))
    gained = bool((np.isfinite(one) & ~np.isfinite(other)).any())
    lost = bool((np.isfinite(other) & ~np.isfinite(one)).any())
    if gained != lost:
        return gained
    return bool(known.any() and float(ratio[known].mean()) < np.log(_GAIN))
