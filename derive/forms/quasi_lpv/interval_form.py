"""The elementwise interval form of a quasi-linear model, ready to be evaluated."""

from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np
import sympy as sp
from numpy.typing import ArrayLike, NDArray

from obsynth.derive.errors import DerivationError
from obsynth.derive.forms.measured import Known
from obsynth.derive.forms.quasi_lpv.elementwise import bound_elements
from obsynth.derive.forms.scheduling import Lift
from obsynth.derive.intervals.program import Program, evaluate
from obsynth.derive.intervals.ranges import bound_ranges
from obsynth.derive.jacobian.matrix_entries import matrix_entries
from obsynth.derive.rigour import enclose_number, rational
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.convert import to_sx
from obsynth.symbolic.plant import Plant

Bounds = tuple[FloatArray, FloatArray]
_BLOCKS = ("A", "B", "offset")


@dataclass(frozen=True, eq=False)
class IntervalForm:
    """A_lower <= A(rho) <= A_upper elementwise, and the same for B and the offset.

    Attributes
    ----------
    known : tuple of Known
        The arguments of the bounds; empty for constant bounds.
    lower, upper : dict of str to sympy.Matrix
        Bounds of the blocks ``"A"``, ``"B"`` and ``"offset"`` as functions of the arguments.
    how : dict of str to object array of str
        For every entry: ``"known"``, ``"monotone"`` (tight at every value of the arguments),
        ``"termwise"`` or ``"range"`` (valid, not tight).
    minimum, maximum : dict of str to ndarray
        Guaranteed least value of the lower and largest value of the upper bound over the domain.
    """

    known: tuple[Known, ...]
    lower: dict[str, sp.Matrix]
    upper: dict[str, sp.Matrix]
    how: dict[str, NDArray[np.object_]]
    minimum: dict[str, FloatArray]
    maximum: dict[str, FloatArray]
    _program: dict[str, Program] = field(default_factory=dict, repr=False)

    @property
    def A_lower(self) -> sp.Matrix:
        """Lower bound of A as a function of the arguments."""
        return self.lower["A"]

    @property
    def A_upper(self) -> sp.Matrix:
        """Upper bound of A as a function of the arguments."""
        return self.upper["A"]

    @property
    def A_min(self) -> FloatArray:
        """Least lower bound of A over the domain, shape (n, n)."""
        return self.minimum["A"]

    @property
    def A_max(self) -> FloatArray:
        """Largest upper bound of A over the domain, shape (n, n)."""
        return self.maximum["A"]

    @property
    def arguments(self) -> tuple[sp.Symbol, ...]:
        """Symbols of the bounds, in order."""
        return tuple(k.argument for k in self.known)

    @property
    def domain(self) -> FloatArray:
        """Where the bounds are guaranteed, shape (number of arguments, 2)."""
        return np.array([(k.lower, k.upper) for k in self.known], dtype=float).reshape(-1, 2)

    def at(self, values: ArrayLike = ()) -> dict[str, Bounds]:
        """Evaluate the bounds with outward rounding.

        Parameters
        ----------
        values : array_like, shape (number of arguments,)
            What is measured.

        Returns
        -------
        dict of str to (ndarray, ndarray)
            Lower and upper bound of every block.

        Raises
        ------
        DerivationError
            A value outside of the domain, where nothing is guaranteed and a bound may be singular;
            the argument is named.

        Examples
        --------
        >>> from obsynth.derive import quasi_lpv
        >>> from obsynth.symbolic.plants import three_tanks
        >>> bounds = quasi_lpv(three_tanks()).interval(measured=["x1", "x2"])
        >>> low, high = bounds.at([0.5, 0.1])["A"]
        >>> np.round(low[0], 8).tolist(), np.round(high[0], 8).tolist()
        ([-0.0230643, 0.0, 0.01692457], [-0.01692457, 0.0, 0.0230643])
        """
        point = np.atleast_1d(np.asarray(values, dtype=float))
        if point.shape != (len(self.known),):
            raise DerivationError(
                f"the bounds need one value for each of {', '.join(map(str, self.arguments))}; "
                f"given was {point.tolist()}",
                given=point,
            )
        for known, value in zip(self.known, point, strict=True):
            if not known.lower <= value <= known.upper:
                raise DerivationError(
                    f"{known.argument} = {value:.8g} is outside of [{known.lower:.8g}, "
                    f"{known.upper:.8g}], where the bounds are guaranteed",
                    symbol=str(known.argument),
                    value=float(value),
                )
        if "bounds" not in self._program:
            self._program["bounds"] = Program.from_casadi(self._columns())
        column = point[:, None]
        low, high = evaluate(self._program["bounds"], column, column)
        result, start = {}, 0
        for block in _BLOCKS:
            shape = self.lower[block].shape
            size = shape[0] * shape[1]
            first, second = slice(start, start + size), slice(start + size, start + 2 * size)
            result[block] = (low[first, 0].reshape(shape), high[second, 0].reshape(shape))
            start += 2 * size
        return result

    def function(self) -> ca.Function:
        """Return the bounds as a CasADi function for run time, without outward rounding.

        Returns
        -------
        casadi.Function
            (y) -> (A_lower, A_upper, B_lower, B_upper, offset_lower, offset_upper, inside), where
            inside is 1 for arguments in the domain and 0 elsewhere.
        """
        columns, symbols = self._arguments()
        inside = ca.SX(1)
        for known, element in zip(self.known, symbols, strict=True):
            if np.isfinite(known.lower):
                inside = ca.logic_and(inside, element >= known.lower)
            if np.isfinite(known.upper):
                inside = ca.logic_and(inside, element <= known.upper)
        matrices = []
        names = []
        table = dict(zip(self.arguments, symbols, strict=True))
        for block in _BLOCKS:
            for side, matrix in (("lower", self.lower[block]), ("upper", self.upper[block])):
                labels = [f"{block}_{side}"] * len(matrix)
                entries = to_sx(list(matrix.T), table, labels)
                matrices.append(ca.reshape(_column(entries), *matrix.shape))
                names.append(f"{block}_{side}")
        return ca.Function(
            "interval_form", [columns], [*matrices, inside], ["y"], [*names, "inside"]
        )

    def _arguments(self) -> tuple[ca.SX, list[ca.SX]]:
        symbols = [ca.SX.sym(str(a)) for a in self.arguments]
        return _column(symbols), symbols

    def _columns(self) -> ca.Function:
        columns, symbols = self._arguments()
        table = dict(zip(self.arguments, symbols, strict=True))
        rows = [e for b in _BLOCKS for side in (self.lower, self.upper) for e in side[b]]
        return ca.Function(
            "bounds", [columns], [_column(to_sx(rows, table, ["a bound"] * len(rows)))]
        )

    def __str__(self) -> str:
        what = ", ".join(map(str, self.arguments))
        lines = [f"elementwise bounds of A as functions of {what}" if what else "bounds of A"]
        n, k = self.A_min.shape
        for i in range(n):
            for j in range(k):
                low, high = self.A_min[i, j], self.A_max[i, j]
                if high > low:
                    kind = self.how["A"][i, j]
                    lines.append(f"  a{i + 1}{j + 1} in [{low:.8g}, {high:.8g}]  {kind}")
        return "\n".join(lines)

    def _repr_latex_(self) -> str:
        lower, upper = (
            sp.latex(m.applyfunc(lambda e: e.evalf(6))) for m in (self.A_lower, self.A_upper)
        )
        return f"$\\displaystyle {lower} \\le A \\le {upper}$"


def _column(items: list[Any]) -> ca.SX:
    return ca.densify(ca.vertcat(*items)) if items else ca.SX(0, 1)


def make_interval_form(
    blocks: dict[str, sp.Matrix],
    model: Plant,
    known: tuple[Known, ...],
    lifts: tuple[Lift, ...],
    rtol: float,
    effort: str,
) -> IntervalForm:
    """Bound the blocks of a form elementwise."""
    if not known:
        return _constant_form(blocks, model, lifts, rtol, effort)
    lower, upper, how = {}, {}, {}
    for name, block in blocks.items():
        places = {(i, j): block[i, j] for i in range(block.rows) for j in range(block.cols)}
        found = bound_elements(places, model, known, [lift.signal for lift in lifts])
        lower[name] = sp.ImmutableMatrix(*block.shape, list(found.lower.values()))
        upper[name] = sp.ImmutableMatrix(*block.shape, list(found.upper.values()))
        how[name] = np.array(list(found.how.values()), dtype=object).reshape(block.shape)
    domain = np.array([(k.lower, k.upper) for k in known], dtype=float).reshape(-1, 2)
    arguments = [k.argument for k in known]
    minimum = {n: _extremes(m, arguments, domain, rtol, effort)[0] for n, m in lower.items()}
    maximum = {n: _extremes(m, arguments, domain, rtol, effort)[1] for n, m in upper.items()}
    return IntervalForm(known, lower, upper, how, minimum, maximum)


def _constant_form(
    blocks: dict[str, sp.Matrix], model: Plant, lifts: tuple[Lift, ...], rtol: float, effort: str
) -> IntervalForm:
    minimum, maximum, how = {}, {}, {}
    for name, block in blocks.items():
        low, high = np.zeros(block.shape), np.zeros(block.shape)
        varying = {}
        for i in range(block.rows):
            for j in range(block.cols):
                if block[i, j].free_symbols:
                    varying[(i, j)] = block[i, j]
                else:
                    low[i, j], high[i, j] = enclose_number(block[i, j])
        entries = matrix_entries(varying, model, [lift.signal for lift in lifts])
        if entries.places:
            found = entries.ranges(rtol, effort, name)
            for k, place in enumerate(entries.places):
                low[place], high[place] = found.lower[k], found.upper[k]
        minimum[name], maximum[name] = low, high
        how[name] = np.full(block.shape, "known", dtype=object)
        for place in varying:
            how[name][place] = "range"
    lower, upper = (
        {
            n: sp.ImmutableMatrix(*m.shape, [rational(float(v)) for v in m.ravel()])
            for n, m in s.items()
        }
        for s in (minimum, maximum)
    )
    return IntervalForm((), lower, upper, how, minimum, maximum)


def _extremes(
    matrix: sp.Matrix, arguments: list[sp.Symbol], domain: FloatArray, rtol: float, effort: str
) -> Bounds:
    symbols = [ca.SX.sym(str(a)) for a in arguments]
    table = dict(zip(arguments, symbols, strict=True))
    rows = to_sx(list(matrix), table, ["a bound"] * len(matrix))
    if not rows:
        return np.zeros(matrix.shape), np.zeros(matrix.shape)
    found = bound_ranges(_column(rows), _column(symbols), domain, rtol=rtol, effort=effort)
    return found.lower.reshape(matrix.shape), found.upper.reshape(matrix.shape)
