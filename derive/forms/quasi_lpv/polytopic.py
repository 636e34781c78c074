"""Polytopic and centred versions of a linear form whose matrices are affine in scalars."""

from dataclasses import dataclass, replace

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike, NDArray

from obsynth.derive.errors import DerivationError, UnboundedError
from obsynth.derive.forms.quasi_lpv.layout import Layout
from obsynth.derive.forms.quasi_lpv.scheduling import AffineSchedule
from obsynth.derive.jacobian.dependence import AffineDependence
from obsynth.derive.jacobian.family import AffineFamily, build_family

Array = NDArray[np.float64]
_UNIT = 2.0**-53


@dataclass(frozen=True, eq=False)
class PolytopicForm:
    """Vertex matrices whose convex hull holds the matrices of a form at every point of the box.

    Attributes
    ----------
    family : AffineFamily
        The stacked matrix [A B D B_f W1 offset; C ...], affine in the scheduling variables.
    layout : Layout
        Where the blocks are.
    affinity : dict of (row, column) to str
        How every varying entry was proved to be affine.

    Notes
    -----
    ``exact`` says whether the polytope is the hull of the matrices that occur, up to the tolerance
    of the ranges, or an outer box of scheduling variables that share signals. The last scheduling
    variable changes fastest, the lower end comes first. The matrices hold up to `radius`, what
    rounding costs.
    """

    family: AffineFamily
    layout: Layout
    affinity: dict[tuple[int, int], str]

    @property
    def exact(self) -> bool:
        """True for the hull itself, False for an outer polytope."""
        return self.family.exact

    @property
    def count(self) -> int:
        """Number of vertices."""
        return self.family.vertex_count

    def block(self, name: str) -> Array:
        """Vertices of a block.

        Parameters
        ----------
        name : str
            ``"A"``, ``"B"``, ``"offset"``, ``"C"``, ...

        Returns
        -------
        ndarray, shape (N, rows, columns)
            One matrix per vertex.
        """
        rows, columns = self.layout.place(name)
        return self.family.vertices()[:, rows, columns]

    def radius(self, name: str) -> Array:
        """Elementwise bound of the rounding of a block, shape (rows, columns)."""
        return self.family.radius[self.layout.place(name)]

    @property
    def A(self) -> Array:
        """Vertices of A, shape (N, n, n)."""
        return self.block("A")

    @property
    def B(self) -> Array:
        """Vertices of B, shape (N, n, n_u)."""
        return self.block("B")

    def __str__(self) -> str:
        kind = "exact" if self.exact else "outer"
        ways = ", ".join(sorted(set(self.affinity.values()))) or "no entry varies"
        scalars = "; ".join(self.family.labels) or "none"
        return f"{self.count} vertices ({kind}) over {scalars}; affine dependence proved ({ways})"

    def _repr_html_(self) -> str:
        from html import escape

        rows = "".join(
            f"<tr><td>{escape(label)}</td><td>{low:.8g}</td><td>{high:.8g}</td></tr>"
            for label, (low, high) in zip(self.family.labels, self.family.ranges, strict=True)
        )
        return (
            f"<p>{escape(str(self))}</p><table><tr><th>variable</th><th>min</th><th>max</th></tr>"
            f"{rows}</table>"
        )


@dataclass(frozen=True, eq=False)
class CentredForm:
    """Nominal matrices plus a remainder: A(rho) = A + Delta, Delta in a polytope and in a box.

    Attributes
    ----------
    A, B : ndarray, shapes (n, n), (n, n_u)
        Nominal matrices.
    A_vertices, B_vertices : ndarray, shapes (N, n, n), (N, n, n_u)
        Vertices of the remainder, in common order.
    A_lower, A_upper, B_lower, B_upper : ndarray
        Elementwise bounds of the remainder, rounded outwards.
    A_radius, B_radius : ndarray
        What rounding may add to the remainder elementwise, beyond the hull of the vertices.
    exact : bool
        Whether the vertices are those of the hull itself.
    """

    A: Array
    B: Array
    A_vertices: Array
    B_vertices: Array
    A_lower: Array
    A_upper: Array
    B_lower: Array
    B_upper: Array
    A_radius: Array
    B_radius: Array
    exact: bool

    def __str__(self) -> str:
        width = self.A_vertices.max(axis=0) - self.A_vertices.min(axis=0)
        return (
            f"A nominal with {int((width > 0.0).sum())} varying entries of width at most "
            f"{float(width.max(initial=0.0)):.6g}, "
            f"{len(self.A_vertices)} vertices ({'exact' if self.exact else 'outer'})"
        )


def make_polytope(schedule: AffineSchedule, layout: Layout) -> PolytopicForm:
    """Turn an affine schedule into vertices."""
    return PolytopicForm(family_of(schedule, layout.shape), layout, dict(schedule.methods))


def family_of(schedule: AffineSchedule, shape: tuple[int, int]) -> AffineFamily:
    """Round an affine schedule to a family of matrices. Shapes: shape (int, int)."""
    for variable in schedule.variables:
        if not (np.isfinite(variable.lower) and np.isfinite(variable.upper)):
            raise UnboundedError(
                f"the scheduling variable {variable.symbol} = {variable.expression} has no finite "
                f"range over the box; give {', '.join(variable.signals)} a range that keeps away "
                "from its singularity, or choose another centre= or another factorisation "
                "with prefer=",
                entries=(str(variable.symbol),),
                operation=str(variable.expression),
                sub_box={},
            )
    # the variables stand in a row of their own below the matrix, as entries that define scalars
    rows, columns = shape
    basis = [(rows, k) for k in range(len(schedule.variables))]
    dependences = [
        AffineDependence(
            place,
            {basis[k]: coefficient for k, coefficient in terms.items()},
            constant,
            schedule.methods.get(place, "constant"),
            (),
        )
        for place, (constant, terms) in schedule.entries.items()
    ]
    ranges = {basis[k]: (v.lower, v.upper) for k, v in enumerate(schedule.variables)}
    supports = {basis[k]: v.signals for k, v in enumerate(schedule.variables)}
    wide = max(columns, len(basis))
    family = build_family((rows + 1, wide), basis, dependences, ranges, supports)
    return replace(
        family,
        constant=family.constant[:rows, :columns],
        directions=family.directions[:, :rows, :columns],
        radius=family.radius[:rows, :columns],
        labels=tuple(_label(v.symbol, v.expression) for v in schedule.variables),
        exact=schedule.exact,
    )


def _label(symbol: sp.Symbol, expression: sp.Expr) -> str:
    return str(symbol) if symbol == expression else f"{symbol} = {sp.sstr(expression)}"


def centre_form(polytope: PolytopicForm, nominal: ArrayLike | None = None) -> CentredForm:
    """Split a polytopic form into nominal matrices and a remainder."""
    family, layout = polytope.family, polytope.layout
    middle = family.midpoint
    place_A, place_B = layout.place("A"), layout.place("B")
    if nominal is not None:
        given = np.asarray(nominal, dtype=float)
        if given.shape != middle[place_A].shape or not np.isfinite(given).all():
            raise DerivationError(
                f"the nominal A needs finite entries and the shape {middle[place_A].shape}; given "
                f"was {given.tolist()}",
                given=given,
            )
        middle[place_A] = given
    half = family.half_ranges
    around = replace(
        family, constant=family.midpoint - middle, ranges=np.stack([-half, half], axis=1)
    )
    vertices = around.vertices()
    weights = np.abs(family.directions)
    largest = np.abs(family.constant) + np.abs(middle)
    largest += np.tensordot(np.abs(family.ranges).max(axis=1, initial=0.0), weights, axes=1)
    varying = (np.tensordot(half, weights, axes=1) > 0.0) | (around.constant != 0.0)
    steps = 4 * (len(family.ranges) + 4)
    slack = family.radius + np.where(varying, steps * _UNIT * largest, 0.0)
    lower = np.where(slack > 0.0, np.nextafter(vertices.min(axis=0) - slack, -np.inf), 0.0)
    upper = np.where(slack > 0.0, np.nextafter(vertices.max(axis=0) + slack, np.inf), 0.0)
    return CentredForm(
        middle[place_A],
        middle[place_B],
        vertices[:, place_A[0], place_A[1]],
        vertices[:, place_B[0], place_B[1]],
        lower[place_A],
        upper[place_A],
        lower[place_B],
        upper[place_B],
        slack[place_A],
        slack[place_B],
        polytope.exact,
    )
