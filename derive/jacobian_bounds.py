"""Guaranteed bounds of a plant's Jacobian over its box, and the family it belongs to."""

from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np
import sympy as sp
from numpy.typing import NDArray

from obsynth.derive.affine_family import AffineFamily, build_family
from obsynth.derive.continuity import refuse_jumps
from obsynth.derive.dependence import AffineDependence, entry_name, find_dependences
from obsynth.derive.errors import DerivationError, UnboundedError
from obsynth.derive.exact import enclose_number, rational, substitute
from obsynth.derive.intervals import Quotients, Ranges, Status, bound_ranges
from obsynth.derive.intervals.removable import remove_singularities
from obsynth.derive.split import Split
from obsynth.symbolic.plant import Plant

__all__ = ["JacobianBounds", "jacobian_bounds"]

Array = NDArray[np.float64]
_SAMPLES = 96
# Expanding a longer entry costs more than the zeros it may show.
_LONG = 500
_KINDS = ("x", "u", "p", "rho", "d", "f", "w")


@dataclass(frozen=True, eq=False)
class JacobianBounds:
    """Guaranteed bounds of dg/dx (or dg/du) over the box of the plant.

    Attributes
    ----------
    min, max : ndarray, shape (n, k)
        Guaranteed bounds, rounded outwards; 0 where an entry is structurally zero.
    attained_min, attained_max : ndarray, shape (n, k)
        Values that are reached, so that the true extremes lie in [min, attained_min] and
        [attained_max, max].
    gap : ndarray, shape (n, k)
        Width of the bounds minus width of the attained range.
    attained_at : ndarray, shape (n, k, 2, v)
        Where the attained minimum and maximum are reached, in the order of ``variables``;
        nan for structural zeros.
    status : ndarray of Status, shape (n, k)
        How good every bound is.
    variables : tuple of str
        Names of the variables of the box.
    family : AffineFamily
        The set of matrices with its dependences; its vertices are what a design uses.
    dependences : tuple of AffineDependence
        Entries that follow from others, with the proof; ``str`` gives the reason.
    naive_vertex_count : int
        Vertices of the entrywise box, 2 to the number of varying entries.
    """

    min: Array
    max: Array
    attained_min: Array
    attained_max: Array
    gap: Array
    attained_at: Array
    status: NDArray[np.object_]
    variables: tuple[str, ...]
    family: AffineFamily
    dependences: tuple[AffineDependence, ...]
    naive_vertex_count: int

    def vertices(self) -> Array:
        """Vertices of the family, shape (N, n, k); every Jacobian lies in their hull."""
        return self.family.vertices()

    @property
    def vertex_radius(self) -> Array:
        """Elementwise rounding of the vertices, shape (n, k)."""
        return self.family.radius

    def __str__(self) -> str:
        count = self.family.vertex_count
        kind = "exact" if self.family.exact else "outer"
        lines = [
            f"{int((self.max > self.min).sum())} varying entries, {count} vertices ({kind}) "
            f"in place of {self.naive_vertex_count}",
        ]
        for (i, j), status in np.ndenumerate(self.status):
            if self.max[i, j] > self.min[i, j]:
                word = str(status).split(":")[0]
                lines.append(
                    f"  {entry_name((i, j))} in [{self.min[i, j]:.8g}, {self.max[i, j]:.8g}]  "
                    f"gap {self.gap[i, j]:.1e}  {word}"
                )
        lines += [f"  {d}" for d in self.dependences if d.coefficients]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><td>{entry_name((i, j))}</td><td>{self.min[i, j]:.8g}</td>"
            f"<td>{self.max[i, j]:.8g}</td><td>{self.gap[i, j]:.1e}</td>"
            f"<td>{str(s).split(':')[0]}</td></tr>"
            for (i, j), s in np.ndenumerate(self.status)
            if self.max[i, j] > self.min[i, j]
        )
        reasons = "".join(f"<li>{d}</li>" for d in self.dependences if d.coefficients)
        kind = "exact" if self.family.exact else "outer"
        return (
            "<table><tr><th>entry</th><th>min</th><th>max</th><th>gap</th><th>status</th></tr>"
            f"{rows}</table><p>{self.family.vertex_count} vertices ({kind}) in place of "
            f"{self.naive_vertex_count}</p><ul>{reasons}</ul>"
        )


@dataclass(frozen=True, eq=False)
class _Entries:
    """Entries of the Jacobian that are not structurally zero, in CasADi and in SymPy."""

    places: list[tuple[int, int]]
    values: ca.SX
    variables: ca.SX
    names: tuple[str, ...]
    box: Array
    constants: ca.SX
    constant_box: list[tuple[float, float]]
    symbolic: dict[tuple[int, int], sp.Expr]
    symbols: list[sp.Symbol]
    quotients: Quotients | None


def _collect(model: Plant, part: Split | None, wrt: str) -> _Entries:
    kind = {"states": "x", "inputs": "u"}[wrt]
    sx = model.sx(constants="symbol")
    columns = getattr(sx, kind)
    values_of = [enclose_number(substitute(v, {})) for v in model.constant_values.values()]
    rhs = sx.rhs
    if part is not None:
        noise = ca.vertcat(sx.d, sx.f, sx.w)
        rhs = ca.substitute(rhs, noise, ca.SX.zeros(noise.numel()))
    jacobian, quotients = _differentiated(model, rhs, columns, values_of)
    linear = None if part is None else (part.A if kind == "x" else part.B)
    wrt_symbols = [s.symbol for s in getattr(model, kind)]
    symbolic = (
        sp.Matrix(model.rhs).jacobian(wrt_symbols) if wrt_symbols else sp.zeros(len(model.x), 0)
    )
    quiet = {s.symbol: 0 for k in ("d", "f", "w") for s in getattr(model, k)}
    places, values, shifts, shift_symbols = [], [], [], []
    expressions: dict[tuple[int, int], sp.Expr] = {}
    for i in range(jacobian.shape[0]):
        for j in range(jacobian.shape[1]):
            present = jacobian.sparsity().has_nz(i, j)
            offset = 0.0 if linear is None else float(linear[i, j])
            if not present and offset == 0.0:
                continue
            value = jacobian[i, j] if present else ca.SX(0)
            exact = substitute(symbolic[i, j], model.constant_values)
            if offset != 0.0:
                symbol = ca.SX.sym(f"a{i + 1}{j + 1}")
                shifts.append((offset, offset))
                shift_symbols.append(symbol)
                value, exact = value - symbol, exact - rational(offset)
            if part is not None:
                exact = exact.subs(quiet)
            if exact.count_ops() < _LONG:
                exact = sp.expand(exact)
            if exact == 0:
                continue
            places.append((i, j))
            values.append(value)
            expressions[(i, j)] = exact
    column = ca.vertcat(*values) if values else ca.SX(0, 1)
    inner = [] if quotients is None else [q.argument for q in quotients.members]
    needed = {str(s) for s in ca.symvar(ca.vertcat(column, *inner))}
    names: list[str] = []
    symbols: list[sp.Symbol] = []
    parts: list[ca.SX] = []
    boxes: list[tuple[float, float]] = []
    for k in _KINDS:
        for signal, element in zip(getattr(model, k), ca.vertsplit(getattr(sx, k)), strict=True):
            if k == "x" or signal.name in needed:
                names.append(signal.name)
                symbols.append(signal.symbol)
                parts.append(element)
                boxes.append((signal.lower, signal.upper))
    return _Entries(
        places,
        column,
        ca.vertcat(*parts),
        tuple(names),
        np.array(boxes, dtype=float).reshape(-1, 2),
        ca.vertcat(sx.c, *shift_symbols),
        [*values_of, *shifts],
        expressions,
        symbols,
        quotients,
    )


def _differentiated(
    model: Plant, rhs: ca.SX, columns: ca.SX, constants: list[tuple[float, float]]
) -> tuple[ca.SX, Quotients | None]:
    """Jacobian, through quotients with removable singularities where there are some."""
    sx = model.sx(constants="symbol")
    variables = ca.vertcat(*[getattr(sx, k) for k in _KINDS])
    box = np.vstack([model.box(k).reshape(-1, 2) for k in _KINDS])
    found = remove_singularities(ca.densify(rhs), variables, sx.c, box, constants)
    if found is None:
        return ca.jacobian(rhs, columns), None
    return found[1].jacobian(found[0], columns), found[1]


def _sample(entries: _Entries) -> dict[tuple[int, int], Array]:
    """Values of all entries at fixed random points of the box."""
    rng = np.random.default_rng(0)
    lower = np.where(np.isfinite(entries.box[:, 0]), entries.box[:, 0], -1.0)
    upper = np.where(np.isfinite(entries.box[:, 1]), entries.box[:, 1], lower + 2.0)
    points = lower + rng.random((_SAMPLES, len(lower))) * (upper - lower)
    middle = np.array([0.5 * (lo + hi) for lo, hi in entries.constant_box])
    values = entries.values
    if entries.quotients is not None:
        values = entries.quotients.closed(values)
    function = ca.Function("sample", [entries.variables, entries.constants], [values])
    result = np.array(function(points.T, np.tile(middle[:, None], (1, _SAMPLES))))
    # points outside the domain of some entry say nothing about dependences
    usable = np.isfinite(result).all(axis=0)
    return dict(zip(entries.places, result[:, usable], strict=True))


def _refuse(entries: _Entries, ranges: Ranges, what: str) -> None:
    failures = ranges.failures
    if not failures:
        return
    names = tuple(
        f"{what}[{entries.places[f.index][0] + 1},{entries.places[f.index][1] + 1}]"
        for f in failures
    )
    first = failures[0]
    boxes = {}
    lines = []
    for name, failure in zip(names, failures, strict=True):
        expression = entries.symbolic[entries.places[failure.index]]
        relevant = [k for k, s in enumerate(entries.symbols) if expression.has(s)]
        box = {
            entries.names[k]: (float(failure.lower[k]), float(failure.upper[k])) for k in relevant
        }
        boxes[name] = box
        where = ", ".join(f"{s} in [{lo:.9g}, {hi:.9g}]" for s, (lo, hi) in box.items())
        lines.append(f"{name} ({failure.operation} at {where})")
    shrink = sorted({s for box in boxes.values() for s in box})
    raise UnboundedError(
        f"no finite bound over the box for {'; '.join(lines)}. Keep the range of "
        f"{', '.join(shrink)} away from there",
        entries=names,
        operation=first.operation,
        sub_box=boxes[names[0]],
        sub_boxes=boxes,
    )


def jacobian_bounds(
    split_or_model: Split | Plant,
    wrt: Literal["states", "inputs"] = "states",
    rtol: float = 1e-6,
    effort: Literal["fast", "normal", "tight"] = "normal",
) -> JacobianBounds:
    """Bound every entry of a Jacobian over the box of the plant, with proof.

    Parameters
    ----------
    split_or_model : Split or Plant
        A split: the Jacobian of its g. A plant: the Jacobian of its right-hand side.
    wrt : {"states", "inputs"}
        What to differentiate by.
    rtol : float
        Wanted gap between guaranteed and attained range, relative to its width.
    effort : {"fast", "normal", "tight"}
        How many boxes branch and bound may use.

    Returns
    -------
    JacobianBounds
        Entrywise bounds and the affine family with its vertices.

    Raises
    ------
    StructureError
        The dynamics jump inside the box.
    UnboundedError
        An entry has no finite bound over the box; entry, operation and sub-box are named.
    DerivationError
        Options that are not known.

    Examples
    --------
    >>> from obsynth.derive.split import split
    >>> from obsynth.symbolic.plants import quadruple_tank
    >>> parts = split(quadruple_tank().discretise("euler", Ts=1.0))
    >>> found = jacobian_bounds(parts)
    >>> np.round(found.max[2, 2], 6), len(found.vertices()), found.naive_vertex_count
    (np.float64(0.014459), 16, 64)
    """
    if wrt not in ("states", "inputs"):
        raise DerivationError(f"wrt={wrt!r} is not known; choose 'states' or 'inputs'", wrt=wrt)
    part = split_or_model if isinstance(split_or_model, Split) else None
    model = split_or_model.model if isinstance(split_or_model, Split) else split_or_model
    refuse_jumps(model.check())
    entries = _collect(model, part, wrt)
    ranges = bound_ranges(
        entries.values,
        entries.variables,
        entries.box,
        entries.constants,
        entries.constant_box,
        rtol=rtol,
        effort=effort,
        quotients=entries.quotients,
    )
    function = "dg" if part is not None else "df"
    _refuse(entries, ranges, f"{function}/d{'x' if wrt == 'states' else 'u'}")
    shape = (len(model.x), len(model.x) if wrt == "states" else len(model.u))
    return _assemble(entries, ranges, shape)


def _assemble(entries: _Entries, ranges: Ranges, shape: tuple[int, int]) -> JacobianBounds:
    filled = {
        name: np.zeros(shape) for name in ("min", "max", "attained_min", "attained_max", "gap")
    }
    where = np.full((*shape, 2, len(entries.names)), np.nan)
    status = np.full(shape, Status.EXACT, dtype=object)
    bounds: dict[tuple[int, int], tuple[float, float]] = {}
    supports: dict[tuple[int, int], tuple[str, ...]] = {}
    judged = ranges.status
    for k, place in enumerate(entries.places):
        expression = entries.symbolic[place]
        supports[place] = tuple(
            n for n, s in zip(entries.names, entries.symbols, strict=True) if expression.has(s)
        )
        low, high = float(ranges.lower[k]), float(ranges.upper[k])
        reached = float(ranges.attained_lower[k]), float(ranges.attained_upper[k])
        gap = float(ranges.gap[k])
        if not supports[place]:
            # a number, not below its lower bound and not above its upper one: both are passed
            low, high = enclose_number(expression)
            reached, gap = (high, low), 2.0 * (high - low)
        bounds[place] = (low, high)
        filled["min"][place], filled["max"][place] = low, high
        filled["attained_min"][place], filled["attained_max"][place] = reached
        filled["gap"][place] = gap
        where[place][0], where[place][1] = ranges.points_lower[k], ranges.points_upper[k]
        status[place] = judged[k]
    basis, dependences = find_dependences(
        entries.symbolic, _sample(entries) if entries.places else {}, entries.symbols
    )
    family = build_family(shape, basis, dependences, bounds, supports)
    varying = sum(1 for place in entries.places if supports[place])
    return JacobianBounds(
        min=filled["min"],
        max=filled["max"],
        attained_min=filled["attained_min"],
        attained_max=filled["attained_max"],
        gap=filled["gap"],
        attained_at=where,
        status=status,
        variables=entries.names,
        family=family,
        dependences=tuple(dependences),
        naive_vertex_count=2**varying,
    )
