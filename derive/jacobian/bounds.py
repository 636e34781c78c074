"""Guaranteed bounds of a plant's Jacobian over its box; jumps are refused.

CasADi differentiates past the jump of a sign, a step or a piecewise definition as if it were not
there. A kink is harmless (both slopes enter the bounds), a jump is not.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np
import sympy as sp
from numpy.typing import NDArray
from sympy.core.relational import Relational

from obsynth.derive.algebra.zero_test import is_zero, prove_zero
from obsynth.derive.errors import DerivationError, StructureError
from obsynth.derive.intervals.program import Program, evaluate
from obsynth.derive.intervals.ranges import Ranges, Status, bound_ranges
from obsynth.derive.jacobian.entries import COLUMNS, MatrixEntries, all_variables, jacobian_entries
from obsynth.derive.jacobian.family import (
    AffineDependence,
    AffineFamily,
    build_family,
    entry_name,
    find_dependences,
)
from obsynth.derive.rigour import enclose_number, rational, substitute
from obsynth.derive.split import Split
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.convert import to_sx
from obsynth.symbolic.discretise import runge_kutta
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.shown import Shown, card
from obsynth.symbolic.table import Table
from obsynth.symbolic.taking import takes

Box = Mapping[sp.Symbol, tuple[float, float]]
_STEPS = (sp.floor, sp.ceiling, sp.Mod)
_SWITCHES = (sp.sign, sp.Heaviside, Relational)
_CORNERS = (*_SWITCHES, *_STEPS, sp.Piecewise, sp.Abs, sp.Max, sp.Min)


def refuse_jumps(model: Plant, outputs: bool = False) -> None:
    """Check that the right-hand side of a plant, or its outputs too, is continuous over its box.

    Off its switching surfaces a row is smooth or has kinks, and two surfaces meet in no more than
    edges: it is enough that the limits from both sides and the value agree, provably, on every
    surface by itself, with all switches that it moves together.
    """
    box = {s.symbol: (s.lower, s.upper) for s in model.signals}
    shown = [*zip(model.output_names, model.output, strict=True)] if outputs else []
    if model.continuous is not None:
        model, step = model.continuous, model
        if step.discretisation != "euler" and model.rhs.has(*_CORNERS, sp.atan2):
            box |= _stages(model, step)
    held = {symbol: rational(low) for symbol, (low, high) in box.items() if low == high}
    for name, row in [*zip(model.names("x"), model.rhs, strict=True), *shown]:
        surface = _jump(substitute(row, model.constant_values).xreplace(held), box)
        if surface is not None:
            raise StructureError(
                f"the row of {name} may jump where {surface} = 0, which lies inside the "
                "box; the bounds of its Jacobian would say nothing about the jump. Make both "
                "sides agree there (a quotient is continued by sinc, phi1 or tanhc), or restrict "
                "the ranges to one side",
                row=name,
                surface=surface,
                condition="continuity",
            )


def _stages(model: Plant, step: Plant) -> Box:
    """Enclose the states at which a Runge-Kutta step evaluates the derivatives."""
    sx = model.sx(constants="symbol")
    points: list[ca.SX] = []

    def rates(x: ca.SX) -> ca.SX:
        points.append(x)
        return ca.substitute(sx.rhs, sx.x, x)

    runge_kutta(rates, sx.x, step.Ts)
    variables, box = all_variables(model)
    function = ca.Function("stages", [variables, sx.c], [ca.densify(ca.horzcat(*points))])
    constants = [enclose_number(substitute(v, {})) for v in model.constant_values.values()]
    ends = evaluate(Program.from_casadi(function, {1: constants}), box[:, :1], box[:, 1:])
    lower, upper = (end.reshape(len(points), -1) for end in ends)
    sides = zip(lower.min(axis=0), upper.max(axis=0), strict=True)
    return dict(zip((s.symbol for s in model.x), sides, strict=True))


def _jump(row: sp.Expr, box: Box) -> sp.Expr | None:
    """Return a surface on which a row is not proved to be continuous; None where it is."""
    for atom in sorted(row.atoms(sp.atan2, *_STEPS), key=str):
        if isinstance(atom, sp.atan2):
            if _meets(atom.args[0], box) and _range(atom.args[1], box)[0] <= 0.0:
                return atom.args[0]
            continue
        # jumps wherever the argument passes an integer, none between two of them
        argument = atom.args[0] / atom.args[1] if isinstance(atom, sp.Mod) else atom.args[0]
        if _meets(sp.sin(sp.pi * argument), box):
            return sp.sin(sp.pi * argument)
    surfaces = {f: None for s in _arguments(row) for f in _factors(s) if _meets(f, box)}
    return next((s for s in surfaces if not _agrees(row, s, box)), None)


def _argument(switch: sp.Basic) -> sp.Expr:
    """Return what changes its sign where a switch does, without denominators."""
    given = switch.lhs - switch.rhs if isinstance(switch, Relational) else switch.args[0]
    top, bottom = sp.fraction(sp.together(given))
    return top * bottom


def _arguments(row: sp.Expr) -> list[sp.Expr]:
    return sorted({_argument(a) for a in row.atoms(*_SWITCHES)}, key=str)


def _factors(argument: sp.Expr) -> list[sp.Expr]:
    try:
        return [factor for factor, _ in sp.factor_list(argument)[1]]
    except sp.PolynomialError:
        return [argument]


def _agrees(row: sp.Expr, surface: sp.Expr, box: Box) -> bool:
    """Prove that a row has the same limits on both sides of a surface, and its value on it."""
    solution = _solved(surface, box)
    if solution is None:
        return False
    sides = [_moved(row, surface, solution, box, sign).subs(*solution) for sign in (1, 0, -1)]
    return all(is_zero(sides[0] - other) for other in sides[1:])


def _moved(
    node: sp.Basic, surface: sp.Expr, solution: tuple[sp.Symbol, sp.Expr], box: Box, sign: int
) -> sp.Basic:
    """Move all switches to one side of a surface, or onto it (0)."""
    if not node.has(*_SWITCHES):
        return node
    node = node.func(*(_moved(a, surface, solution, box, sign) for a in node.args))
    if not isinstance(node, _SWITCHES):
        return node
    others = (0,) if isinstance(node, Relational) else node.args[1:]
    rest, order = _argument(node), 0
    while _vanishes(rest, solution, box):
        rest, order = _cancelled(rest / surface), order + 1
    there = rest.subs(*solution)
    if there.has(sp.nan, sp.zoo) or (there.has(*_CORNERS) and _meets(there, box)):
        # it may be zero on a part of the surface: what is proved is to hold whatever it says
        return node.func(sp.Symbol(str(node), real=True), *others)
    return node.func(sp.Integer(sign) ** order * rest, *others) if order else node


def _vanishes(expression: sp.Expr, solution: tuple[sp.Symbol, sp.Expr], box: Box) -> bool:
    """Tell whether an expression is zero on a whole surface; true rather than wrong."""
    there = expression.subs(*solution)
    return bool(is_zero(there) if there.has(*_CORNERS) else prove_zero(there, box))


def _cancelled(quotient: sp.Expr) -> sp.Expr:
    try:
        return sp.cancel(quotient)
    except sp.PolynomialError:
        return quotient


def _solved(surface: sp.Expr, box: Box) -> tuple[sp.Symbol, sp.Expr] | None:
    """Solve surface = 0 for a symbol that enters linearly, with a slope that does not vanish."""
    for symbol in sorted(surface.free_symbols, key=str):
        slope = sp.diff(surface, symbol)
        if not slope.has(symbol) and not _meets(slope, box):
            return symbol, sp.expand(symbol - surface / slope)
    return None


def _range(expression: sp.Expr, box: Box) -> tuple[float, float]:
    symbols = sorted(expression.free_symbols, key=str)
    if not symbols:
        return enclose_number(expression)
    columns = {s: ca.SX.sym(str(s)) for s in symbols}
    (converted,) = to_sx([expression], columns, ["a switching surface"])
    limits: NDArray[np.float64] = np.array([box[s] for s in symbols], dtype=float)
    found = bound_ranges(converted, ca.vertcat(*columns.values()), limits, rtol=1e-3, effort="fast")
    return float(found.lower[0]), float(found.upper[0])


def _meets(surface: sp.Expr, box: Box) -> bool:
    """Tell whether a surface may have a point inside the box."""
    low, high = _range(surface, box)
    return low <= 0.0 <= high


@dataclass(frozen=True, eq=False, repr=False)
class JacobianBounds(Shown):
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

    min: FloatArray
    max: FloatArray
    attained_min: FloatArray
    attained_max: FloatArray
    gap: FloatArray
    attained_at: FloatArray
    status: NDArray[np.object_]
    variables: tuple[str, ...]
    family: AffineFamily
    dependences: tuple[AffineDependence, ...]
    naive_vertex_count: int

    def vertices(self) -> FloatArray:
        """Vertices of the family, shape (N, n, k); every Jacobian lies in their hull."""
        return self.family.vertices()

    @property
    def varying(self) -> NDArray[np.bool_]:
        """Entries that take more than one value, shape (n, k).

        A number between two doubles has bounds that differ, but it does not vary.
        """
        return np.asarray(self.attained_max > self.attained_min)

    @property
    def vertex_radius(self) -> FloatArray:
        """Elementwise rounding of the vertices, shape (n, k)."""
        return self.family.radius

    @property
    def counted(self) -> str:
        """How many vertices there are, as text."""
        kind = "exact" if self.family.exact else "outer"
        count = f"{self.family.vertex_count} vertices ({kind})"
        return f"{count} in place of {self.naive_vertex_count}"

    @property
    def _title(self) -> str:
        return f"{int(self.varying.sum())} varying entries, {self.counted}"

    def _rows(self) -> list[tuple[str, ...]]:
        """Name, bounds, gap and status of the entries that vary."""
        return [
            (
                entry_name(p),
                *(f"{end[p]:.8g}" for end in (self.min, self.max)),
                f"{gap:.1e}",
                s.word,
            )
            for (p, s), gap in zip(np.ndenumerate(self.status), self.gap.flat, strict=True)
            if self.varying[p]
        ]

    def __str__(self) -> str:
        lines = [self._title]
        lines += [f"  {p} in [{a}, {b}]  gap {gap}  {s}" for p, a, b, gap, s in self._rows()]
        lines += [f"  {d}" for d in self.dependences if d.coefficients]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        reasons = [d for d in self.dependences if d.coefficients]
        table = Table("", ("entry", "min", "max", "gap", "status"), self._rows())
        return card(self._title, table, reasons)


@takes(split_or_model="Plant Split")
def jacobian_bounds(
    split_or_model: Split | Plant,
    wrt: Literal["states", "inputs", "joint"] = "states",
    rtol: float = 1e-6,
    effort: Literal["fast", "normal", "tight"] = "normal",
) -> JacobianBounds:
    """Bound every entry of a Jacobian over the box of the plant, with proof.

    Parameters
    ----------
    split_or_model : Split or Plant
        A split: the Jacobian of its g. A plant: the Jacobian of its right-hand side.
    wrt : {"states", "inputs", "joint"}
        What to differentiate by. "joint", of a plant: the right-hand side and below it the outputs,
        by the states and beside them the disturbances.
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
    if wrt not in COLUMNS:
        raise DerivationError(
            f"wrt={wrt!r} is not known; choose one of {', '.join(map(repr, COLUMNS))}", wrt=wrt
        )
    joint, is_split = wrt == "joint", isinstance(split_or_model, Split)
    if joint and is_split:
        raise DerivationError("wrt='joint' is of a plant: a split has linear outputs", wrt=wrt)
    model = split_or_model.model if isinstance(split_or_model, Split) else split_or_model
    refuse_jumps(model.check(), outputs=joint)
    entries = jacobian_entries(split_or_model, wrt)
    function = "d[f; h]" if joint else "dg" if is_split else "df"
    kinds = COLUMNS[wrt]
    ranges = entries.ranges(rtol, effort, f"{function}/d{''.join(kinds)}")
    rows = len(model.x) + (len(model.output_names) if joint else 0)
    shape = rows, sum(len(getattr(model, kind)) for kind in kinds)
    return _assemble(entries, ranges, shape)


def _assemble(entries: MatrixEntries, ranges: Ranges, shape: tuple[int, int]) -> JacobianBounds:
    names = ("min", "max", "attained_min", "attained_max", "gap")
    filled = {name: np.zeros(shape) for name in names}
    where = np.full((*shape, 2, len(entries.names)), np.nan)
    # NumPy would fill with plain text
    status = np.array([Status.EXACT] * (shape[0] * shape[1]), dtype=object).reshape(shape)
    bounds: dict[tuple[int, int], tuple[float, float]] = {}
    supports: dict[tuple[int, int], tuple[str, ...]] = {}
    judged = ranges.status
    for k, place in enumerate(entries.places):
        supports[place] = entries.support(place)
        low, high = float(ranges.lower[k]), float(ranges.upper[k])
        reached = float(ranges.attained_lower[k]), float(ranges.attained_upper[k])
        gap = float(ranges.gap[k])
        if not supports[place]:
            # a number, not below its lower bound and not above its upper one: both are passed
            low, high = enclose_number(entries.exact[place])
            reached, gap = (high, low), 2.0 * (high - low)
        bounds[place] = (low, high)
        for name, value in zip(names, (low, high, *reached, gap), strict=True):
            filled[name][place] = value
        where[place][0], where[place][1] = ranges.points_lower[k], ranges.points_upper[k]
        status[place] = judged[k]
    basis, dependences = find_dependences(
        entries.exact, entries.sample(corners=False), entries.symbols
    )
    family = build_family(shape, basis, dependences, bounds, supports)
    varying = sum(1 for place in entries.places if supports[place])
    return JacobianBounds(
        **filled,
        attained_at=where,
        status=status,
        variables=entries.names,
        family=family,
        dependences=tuple(dependences),
        naive_vertex_count=2**varying,
    )
