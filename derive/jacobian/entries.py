"""Entries of a plant's Jacobian, in CasADi for the interval engine and in SymPy for proofs."""

import casadi as ca
import numpy as np
import sympy as sp

from obsynth.derive.algebra.factorise import cancel_common_factors, products_to_sums
from obsynth.derive.algebra.sizes import LARGEST_ROW, size, symbols
from obsynth.derive.algebra.slopes import slope
from obsynth.derive.intervals.program import Program, evaluate
from obsynth.derive.intervals.rewriting.quotients import Quotients
from obsynth.derive.intervals.rewriting.removable import remove_singularities
from obsynth.derive.jacobian.matrix_entries import KINDS, Entry, MatrixEntries
from obsynth.derive.rigour import enclose_number, rational, substitute
from obsynth.derive.split import Split
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.convert import to_sx
from obsynth.symbolic.plant import Plant

# Expanding a longer entry costs more than the zeros it may show.
_LONG = 1000
COLUMNS = {"states": ("x",), "inputs": ("u",), "joint": ("x", "w")}
"""Kinds of signals that a Jacobian is taken by."""
# Two forms of a row are compared on boxes of this share of the ranges.
_SHARE, _BOXES = 0.25, 24
_GAIN = 0.9


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
