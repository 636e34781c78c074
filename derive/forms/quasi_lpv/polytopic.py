"""Polytopic and centred versions of a linear form whose matrices are affine in scalars."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive.errors import DerivationError
from obsynth.derive.forms.varying import Vertices
from obsynth.derive.rigour import UNIT_ROUNDOFF
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.display import html_table


@dataclass(frozen=True, eq=False)
class PolytopicForm(Vertices):
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

    affinity: dict[tuple[int, int], str]

    def __str__(self) -> str:
        kind = "exact" if self.exact else "outer"
        ways = ", ".join(sorted(set(self.affinity.values()))) or "no entry varies"
        scalars = "; ".join(self.family.labels) or "none"
        return f"{self.count} vertices ({kind}) over {scalars}; affine dependence proved ({ways})"

    def _repr_html_(self) -> str:
        ends = ((f"{low:.8g}", f"{high:.8g}") for low, high in self.family.ranges)
        rows = [(label, *pair) for label, pair in zip(self.family.labels, ends, strict=True)]
        return html_table(("variable", "min", "max"), rows, str(self))


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

    A: FloatArray
    B: FloatArray
    A_vertices: FloatArray
    B_vertices: FloatArray
    A_lower: FloatArray
    A_upper: FloatArray
    B_lower: FloatArray
    B_upper: FloatArray
    A_radius: FloatArray
    B_radius: FloatArray
    exact: bool

    def __str__(self) -> str:
        width = self.A_vertices.max(axis=0) - self.A_vertices.min(axis=0)
        return (
            f"A nominal with {int((width > 0.0).sum())} varying entries of width at most "
            f"{float(width.max(initial=0.0)):.6g}, "
            f"{len(self.A_vertices)} vertices ({'exact' if self.exact else 'outer'})"
        )


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
    slack = family.radius + np.where(varying, steps * UNIT_ROUNDOFF * largest, 0.0)
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
