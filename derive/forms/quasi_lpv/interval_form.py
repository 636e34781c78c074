"""The elementwise interval form of a quasi-linear model, ready to be evaluated."""

from dataclasses import dataclass
from functools import cached_property

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
from obsynth.symbolic.convert import column, sx_function, to_sx
from obsynth.symbolic.plant import Plant

Bounds = tuple[FloatArray, FloatArray]
_BLOCKS = ("A", "B", "offset")


@dataclass(frozen=True, eq=False)
class Ranging:
    """How ranges of the entries of a form are found.

    matrix: the stacked matrix with symbols in place of the lifted secants
    lifts: these symbols, with the ranges of the derivatives whose means they are
    rtol: wanted gap
    effort: of the interval engine
    """

    matrix: sp.Matrix
    lifts: tuple[Lift, ...]
    rtol: float
    effort: str


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
        low, high = evaluate(self._program, point[:, None], point[:, None])
        shapes = [self.lower[block].shape for block in _BLOCKS]
        sizes = np.cumsum([n * k for n, k in shapes for _ in "lu"])
        lower, upper = np.split(low[:, 0], sizes)[:-1:2], np.split(high[:, 0], sizes)[1::2]
        return {
            block: (a.reshape(shape, order="F"), b.reshape(shape, order="F"))
            for block, shape, a, b in zip(_BLOCKS, shapes, lower, upper, strict=True)
        }

    def function(self) -> ca.Function:
        """Return the bounds as a CasADi function for run time, without outward rounding.

        Returns
        -------
        casadi.Function
            (y) -> (A_lower, A_upper, B_lower, B_upper, offset_lower, offset_upper, inside), where
            inside is 1 for arguments in the domain and 0 elsewhere.
        """
        ends = [sp.And(k.lower <= k.argument, k.argument <= k.upper) for k in self.known]
        inside = sp.Piecewise((1, sp.And(*ends)), (0, True))
        outputs = self._outputs() | {"inside": sp.Matrix([inside])}
        return sx_function("interval_form", {"y": self.arguments}, outputs)

    def _outputs(self) -> dict[str, sp.Matrix]:
        sides = {"lower": self.lower, "upper": self.upper}
        return {f"{block}_{side}": sides[side][block] for block in _BLOCKS for side in sides}

    @cached_property
    def _program(self) -> Program:
        return Program.from_casadi(sx_function("bounds", {"y": self.arguments}, self._outputs()))

    def __str__(self) -> str:
        what = ", ".join(map(str, self.arguments))
        lines = [f"elementwise bounds of A as functions of {what}" if what else "bounds of A"]
        for (i, j), kind in np.ndenumerate(self.how["A"]):
            low, high = self.A_min[i, j], self.A_max[i, j]
            if high > low:
                lines.append(f"  a{i + 1}{j + 1} in [{low:.8g}, {high:.8g}]  {kind}")
        return "\n".join(lines)

    def _repr_latex_(self) -> str:
        lower, upper = (
            sp.latex(m.applyfunc(lambda e: e.evalf(6))) for m in (self.A_lower, self.A_upper)
        )
        return f"$\\displaystyle {lower} \\le A \\le {upper}$"


def make_interval_form(
    blocks: dict[str, sp.Matrix], model: Plant, known: tuple[Known, ...], way: Ranging
) -> IntervalForm:
    """Bound the blocks of a form elementwise."""
    if not known:
        return _constant_form(blocks, model, way)
    lower, upper, how = {}, {}, {}
    for name, block in blocks.items():
        places = {place: block[place] for place in np.ndindex(*block.shape)}
        found = bound_elements(places, model, known, [lift.signal for lift in way.lifts])
        lower[name] = sp.ImmutableMatrix(*block.shape, list(found.lower.values()))
        upper[name] = sp.ImmutableMatrix(*block.shape, list(found.upper.values()))
        how[name] = np.array(list(found.how.values()), dtype=object).reshape(block.shape)
    minimum = {n: _extremes(m, known, way)[0] for n, m in lower.items()}
    maximum = {n: _extremes(m, known, way)[1] for n, m in upper.items()}
    return IntervalForm(known, lower, upper, how, minimum, maximum)


def _constant_form(blocks: dict[str, sp.Matrix], model: Plant, way: Ranging) -> IntervalForm:
    minimum, maximum, how = {}, {}, {}
    for name, block in blocks.items():
        low, high = np.zeros(block.shape), np.zeros(block.shape)
        varying = {}
        for place in np.ndindex(*block.shape):
            if block[place].free_symbols:
                varying[place] = block[place]
            else:
                low[place], high[place] = enclose_number(block[place])
        entries = matrix_entries(varying, model, [lift.signal for lift in way.lifts])
        if entries.places:
            found = entries.ranges(way.rtol, way.effort, name)
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


def _extremes(matrix: sp.Matrix, known: tuple[Known, ...], way: Ranging) -> Bounds:
    table = {k.argument: ca.SX.sym(str(k.argument)) for k in known}
    domain: FloatArray = np.array([(k.lower, k.upper) for k in known], dtype=float)
    rows = to_sx(list(matrix), table, ["a bound"] * len(matrix))
    if not rows:
        return np.zeros(matrix.shape), np.zeros(matrix.shape)
    symbols = column(list(table.values()))
    found = bound_ranges(column(rows), symbols, domain, rtol=way.rtol, effort=way.effort)
    return found.lower.reshape(matrix.shape), found.upper.reshape(matrix.shape)
