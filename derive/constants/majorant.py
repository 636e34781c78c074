"""Diagonal majorants: |g(a) - g(b)|^2 <= (a - b)' M'M (a - b) over the box, with proof.

Their pieces are one row of g, or rows that share states.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import casadi as ca
import numpy as np
import sympy as sp

from obsynth.derive.algebra.connected import connected
from obsynth.derive.constants.eigenvalue_search import Maximum
from obsynth.derive.constants.matrix_maximum import matrix_maximum
from obsynth.derive.errors import DerivationError, UnboundedError
from obsynth.derive.intervals.ranges import Status
from obsynth.derive.jacobian.bounds import refuse_jumps
from obsynth.derive.jacobian.entries import MatrixEntries, exact_jacobian, matrix_entries
from obsynth.derive.rigour import rational, up
from obsynth.derive.split import Split
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.table import Table, Tabled
from obsynth.symbolic.taking import takes

UP = 1.0 + 2.0**-50
"""Covers the rounding of a few operations."""


@dataclass(frozen=True, eq=False)
class RowMajorant:
    """phi^2 <= e' R e for one row of g: phi = g_i(a) - g_i(b), e = a - b, R diagonal.

    entries (n,): guaranteed bounds of |dg_i/dx_j|; largest: sup of sum_j (dg_i/dx_j)^2 / R_jj, at
    most 1
    """

    row: int
    diagonal: FloatArray
    entries: FloatArray
    largest: Maximum


def is_rounding(entry: sp.Expr, coefficient: float) -> bool:
    """Tell whether an entry is only what the rounding of A left over."""
    if entry == 0 or entry.free_symbols or coefficient == 0.0:
        return False
    return bool(abs(sp.N(entry, 30)) <= 2.0**-52 * abs(coefficient))


def connected_groups(sizes: FloatArray) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Collect rows and columns that hang together."""
    groups = sorted(connected(np.flatnonzero(row).tolist() for row in sizes))
    return [
        (tuple(rows), tuple(np.flatnonzero(sizes[rows].any(axis=0)).tolist()))
        for rows in groups
        if sizes[rows].any()
    ]


def largest_value(
    expression: ca.SX, entries: MatrixEntries, rtol: float, effort: str, method: str
) -> Maximum:
    """Bound the largest value of an expression in the entries."""
    found = entries.search(rtol, effort, expression)
    for failure in found.failures:
        rows = tuple(sorted({entries.model.names("x")[i] for i, _ in entries.places}))
        raise UnboundedError(
            f"no finite bound for the {method} of the row of {', '.join(rows)} "
            f"({failure.operation}); scale the states, or keep their ranges smaller",
            entries=rows,
            operation=failure.operation,
            sub_box=failure.box(entries.names),
        )
    return Maximum(
        float(found.upper[0]),
        float(found.attained_upper[0]),
        entries.named(found.points_upper[0]),
        found.status_upper[0],
        method,
        found.boxes,
    )


def row_majorant(
    entries: MatrixEntries,
    sizes: FloatArray,
    row: int,
    fixed: Mapping[int, float],
    names: tuple[str, ...],
    rtol: float,
    effort: str,
) -> RowMajorant:
    """Find R of one row: the smallest multiple of a direction, some elements fixed."""
    chosen = entries.take([k for k, place in enumerate(entries.places) if place[0] == row])
    values = {j: chosen.values[k] for k, (_, j) in enumerate(chosen.places)}
    free = [j for j in values if j not in fixed]
    taken = sum((values[j] ** 2 / d for j, d in fixed.items()), ca.SX(0))
    diagonal = np.zeros(len(sizes))
    for j, d in fixed.items():
        diagonal[j] = d
    if fixed:
        share = largest_value(taken, chosen, rtol, effort, "range of the fixed part")
        if share.upper > 1.0 or (free and share.upper >= 1.0):
            listed = ", ".join(f"{names[j]}: {d:.6g}" for j, d in fixed.items())
            raise DerivationError(
                f"the fixed elements ({listed}) are too small for the row of {names[row]}: "
                f"sum of a_j^2 / d_j reaches {share.attained:.6g}; multiply them by more than "
                "that, or leave one of them free",
                symbols=tuple(names[j] for j in fixed),
                row=names[row],
                factor=share.upper,
            )
        if not free:
            return RowMajorant(row, diagonal, sizes, share)
    # in units of the largest entry, a power of two: squares neither overflow nor vanish
    unit = 2.0 ** (int(np.frexp(sizes[free].max())[1]) - 1)
    parts = np.maximum(sizes / unit, 2.0**-200)
    direction = {j: float(parts[j]) * float(parts[free].sum()) for j in free}
    wanted = sum(((values[j] / unit) ** 2 / direction[j] for j in free), ca.SX(0))
    if fixed:
        wanted = wanted / (1 - taken)
    found = largest_value(wanted, chosen, rtol, effort, "range of sum_j a_j^2 / d_j")
    for j in free:
        diagonal[j] = up(found.upper * direction[j] * UP * unit * unit)
    # with S the free part and B the fixed one, S / (1 - B) = t at the point of the largest value
    # gives S / t + B = 1 for t itself, and at least attained / t for what is attained
    return RowMajorant(row, diagonal, sizes, scaled(found, 1.0 / (found.upper * UP)))


def scaled(found: Maximum, factor: float) -> Maximum:
    """Return a maximum of at most 1 times a factor."""
    upper = min(1.0, found.upper * factor * UP)
    return replace(found, upper=upper, attained=found.attained * factor / UP)


def largest_together(
    entries: MatrixEntries,
    sizes: FloatArray,
    rows: tuple[int, ...],
    diagonal: FloatArray,
    rtol: float,
    effort: str,
) -> Maximum:
    """Bound the largest eigenvalue of D^(-1/2) J'J D^(-1/2), D the diagonal given, rows given."""
    n = len(diagonal)
    scale = {j: float(1.0 / np.sqrt(d)) for j, d in enumerate(diagonal) if d > 0.0}
    scaled = {
        (i, n + j): expression * rational(scale[j])
        for (i, j), expression in entries.exact.items()
        if i in rows
    }
    chosen = matrix_entries(scaled, entries.model)
    ranges = chosen.ranges(min(rtol, 1e-6), effort, "scaled dg/dx")
    norm = matrix_maximum(chosen, ranges, np.zeros((2 * n, 2 * n)), None, rtol, effort)
    return replace(norm, upper=norm.upper**2 * UP, attained=max(norm.attained, 0.0) ** 2 / UP)


@dataclass(frozen=True, eq=False, repr=False)
class Majorant(Tabled):
    """A diagonal M'M with J(x)'J(x) <= M'M at every point of the box, J = dg/dx.

    diagonal (n,): of M'M; zero for states on which g does not depend
    rows: one per row of g that is not zero; the sum of their R is a majorant too, no smaller
    groups: parts of g that share no state, each with sup of the largest eigenvalue of D^(-1/2) J'J
        D^(-1/2), D = M'M: at most 1, attained value and point
    rounding (n, n): |difference between the plant's own linear coefficients and the doubles in A|,
        which g takes up and which is not in ``diagonal``: a design counts it as an uncertainty of A
    split: where g comes from
    """

    diagonal: FloatArray
    rows: tuple[RowMajorant, ...]
    groups: tuple[tuple[tuple[int, ...], tuple[int, ...], Maximum], ...]
    rounding: FloatArray
    split: Split

    @property
    def matrix(self) -> FloatArray:
        """M'M as a matrix, shape (n, n)."""
        return np.diag(self.diagonal)

    @property
    def entry_bounds(self) -> FloatArray:
        """Guaranteed bounds of |dg_i/dx_j|, shape (n, n): one multiplier per entry."""
        bounds = np.zeros((len(self.diagonal), len(self.diagonal)))
        for part in self.rows:
            bounds[part.row] = part.entries
        return bounds

    @property
    def status(self) -> Status:
        """The worst status of all groups."""
        return Status.worst(group[2].status for group in self.groups)

    def table(self) -> Table:
        """Tabulate the diagonal, and how much of every group is attained."""
        names = self.split.model.names("x")
        lines = [("M'M", f"diag({', '.join(f'{v:.8g}' for v in self.diagonal)})")]
        for rows, columns, largest in self.groups:
            what = (
                f"g of {', '.join(names[i] for i in rows)} by "
                f"{', '.join(names[j] for j in columns)}"
            )
            reached = f"{largest.attained:.10g} of 1 attained ({largest.status.word})"
            lines.append((what, f"{reached} at {largest.where}"))
        title = f"Majorant of g of {self.split.model.name}: |g(a) - g(b)|^2 <= (a - b)'M'M(a - b)"
        return Table(title, ("", ""), lines)


@takes(split="Split")
def majorant(
    split: Split,
    fixed: Mapping[str, float] | None = None,
    shape: Literal["diagonal", "scalar"] = "diagonal",
    rtol: float = 1e-9,
    effort: Literal["fast", "normal", "tight"] = "normal",
) -> Majorant:
    """Find a diagonal M'M that bounds how much g can change, row by row and as a whole.

    A row with the entries a_j(x) satisfies (sum_j a_j e_j)^2 <= sum_j d_j e_j^2 for all e exactly
    when sum_j a_j(x)^2 / d_j <= 1, so the smallest d of a given direction is the largest value of
    that sum over the box, which branch and bound encloses from both sides. Rows that share states
    are scaled together: sup of the largest eigenvalue of D^(-1/2) J'J D^(-1/2). Both conditions
    are convex in J, so they hold for the mean of J along a segment as well, hence for differences.

    Equations (5)-(14) of Witczak et al. want M with M_x'M_x <= M'M from entrywise bounds, by (11)
    with an M inside the same bounds. That fails in general, since matrices have no largest one in
    this order. For one row [a b] with a and b in [-1, 1], every M = [m1 m2] within the bounds
    vanishes on e = (m2, -m1), where another row of the box does not: for M = [1 1], M_x = [1 -1]
    and e = (1, -1) the left side is 4 and the right side 0. A diagonal M'M needs no such M. It is
    not unique: every d with sup_x sum_j a_j^2 / d_j <= 1 will do, and ``fixed`` picks one.

    Parameters
    ----------
    split : Split
        Of which g is bounded.
    fixed : mapping of str to float, optional
        Diagonal elements by state; the others are made as small as they can be. By default the
        direction is d_j = r_j sum_k r_k with r_j the bound of |a_j|, which has the smallest trace
        when the a_j take their extremes independently.
    shape : {"diagonal", "scalar"}
        ``"scalar"``: one number for all states, gamma^2 I of equation (14).
    rtol : float
        Wanted gap between guaranteed and attained value.
    effort : {"fast", "normal", "tight"}
        How many boxes may be spent.

    Returns
    -------
    Majorant
        Guaranteed, with attained values.

    Raises
    ------
    DerivationError
        A name that is no state; a fixed element that is too small, with the least it could be.
    StructureError
        The dynamics jump inside the box.
    UnboundedError
        An entry of the Jacobian of g has no finite bound over the box.

    References
    ----------
    M. Witczak, J. Korbicz, R. Jozefowicz, A H-infinity approach to robust fault estimation of
    non-linear discrete-time systems, equations (5)-(14) and (51)-(52).

    Examples
    --------
    >>> import sympy as sp
    >>> from obsynth.derive.split import split
    >>> from obsynth.symbolic import Plant
    >>> plant = Plant("sine")
    >>> (x,) = plant.states("x", range=(-1, 1))
    >>> plant.dynamics([sp.sin(x) / 2], Ts=1)
    >>> plant.outputs([x])
    ('y1',)
    >>> majorant(split(plant, linear="terms")).diagonal.round(9).tolist()
    [0.25]
    """
    model = split.model
    refuse_jumps(model.check())
    names = model.names("x")
    given = _fixed(fixed, names, shape)
    exact = exact_jacobian(split)
    n = exact.rows
    rounding, kept = np.zeros((n, n)), {}
    for place, coefficient in np.ndenumerate(split.A):
        if is_rounding(exact[place], coefficient):
            rounding[place] = abs(float(exact[place])) * UP
        elif exact[place] != 0:
            kept[place] = exact[place]
    entries = matrix_entries(kept, model)
    ranges = entries.ranges(min(rtol, 1e-6), effort, "dg/dx")
    sizes = np.zeros((n, n))
    for k, place in enumerate(entries.places):
        sizes[place] = max(abs(ranges.lower[k]), abs(ranges.upper[k]))
    # an entry that is zero all over the box, as that of a saturated term, weighs nothing
    entries = entries.take([k for k, place in enumerate(entries.places) if sizes[place] > 0.0])
    if shape == "scalar":
        return _scalar(split, entries, sizes, rounding, rtol, effort)
    shared = (sizes > 0.0).sum(axis=0)
    groups_of = connected_groups(sizes)
    # what is given for all states of several rows is held against these together
    whole = {i for m, columns in groups_of if len(m) > 1 and set(columns) <= set(given) for i in m}
    rows = []
    for i in np.flatnonzero(sizes.any(axis=1)).tolist():
        part = {j: d / shared[j] for j, d in given.items() if sizes[i, j] > 0.0 and i not in whole}
        rows.append(row_majorant(entries, sizes[i], i, part, names, rtol, effort))
    diagonal = np.zeros(n)
    groups = []
    for members, columns in groups_of:
        inside = [part for part in rows if part.row in members]
        total = np.sum([part.diagonal for part in inside], axis=0)
        if len(inside) == 1:
            largest = inside[0].largest
        elif whole.issuperset(members):
            total = np.array([given.get(j, 0.0) if j in columns else 0.0 for j in range(n)])
            largest = largest_together(entries, sizes, members, total, rtol, effort)
            if largest.upper > 1.0:
                listed = ", ".join(f"{names[j]}: {given[j]:.6g}" for j in columns)
                raise DerivationError(
                    f"the fixed elements ({listed}) are too small for the rows of "
                    f"{', '.join(names[i] for i in members)}: the largest eigenvalue of "
                    f"D^-1/2 J'J D^-1/2 reaches {largest.attained:.6g}; multiply them by more",
                    symbols=tuple(names[j] for j in columns),
                    factor=largest.upper,
                )
        else:
            largest = largest_together(entries, sizes, members, total, rtol, effort)
            free = [j for j in columns if j not in given]
            # the sum of the rows' own majorants is one: at most 1 but for rounding
            largest = scaled(largest, 1.0)
            if len(free) == len(columns) and largest.upper < 1.0:
                total = total * (largest.upper * UP)
                ratio = 1.0 / (largest.upper * UP)
                largest = scaled(largest, ratio)
        diagonal[list(columns)] = up(total[list(columns)])
        groups.append((members, columns, largest))
    for j, value in given.items():
        diagonal[j] = value
    if not np.isfinite(diagonal).all():
        endless = tuple(n for n, d in zip(names, diagonal, strict=True) if not np.isfinite(d))
        raise UnboundedError(
            f"the majorant has no finite element for {', '.join(endless)}: the square of a slope "
            "is too large for a double; scale the states",
            entries=endless,
        )
    return Majorant(diagonal, tuple(rows), tuple(groups), rounding, split)


def _fixed(
    fixed: Mapping[str, float] | None, names: tuple[str, ...], shape: str
) -> dict[int, float]:
    if shape not in ("diagonal", "scalar"):
        raise DerivationError(
            f"shape={shape!r} is not known; choose 'diagonal' or 'scalar'", shape=shape
        )
    given: dict[int, float] = {}
    for name, value in (fixed or {}).items():
        if str(name) not in names or shape == "scalar":
            scalar = "a scalar majorant has nothing to fix"
            why = scalar if shape == "scalar" else f"the states are {', '.join(names)}"
            raise DerivationError(f"fixed= names {name}, but {why}", symbol=str(name))
        if not 0.0 < float(value) < np.inf:
            raise DerivationError(
                f"the fixed element of {name} has to be positive and finite; given was {value}",
                symbol=str(name),
            )
        given[names.index(str(name))] = float(value)
    return given


def _scalar(
    split: Split,
    entries: MatrixEntries,
    sizes: FloatArray,
    rounding: FloatArray,
    rtol: float,
    effort: str,
) -> Majorant:
    """Bound J'J by one number times the identity."""
    n = len(sizes)
    rows = tuple(np.flatnonzero(sizes.any(axis=1)).tolist())
    if not rows:
        return Majorant(np.zeros(n), (), (), rounding, split)
    found = largest_together(entries, sizes, rows, np.ones(n), rtol, effort)
    value = float(up(found.upper))
    columns = tuple(np.flatnonzero(sizes.any(axis=0)).tolist())
    parts = []
    for i in rows:
        members = np.where(sizes[i] > 0.0, value, 0.0)
        # phi_i^2 <= |grad g_i|^2 |e|^2, and |grad g_i| is no larger than the norm of J
        parts.append(RowMajorant(i, members, sizes[i], scaled(found, 1.0 / value)))
    group = (rows, columns, scaled(found, 1.0 / value))
    return Majorant(np.full(n, value), tuple(parts), (group,), rounding, split)
