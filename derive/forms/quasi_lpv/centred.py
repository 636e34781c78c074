"""A linear form, affine in scalars, as nominal matrices and a remainder."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive.errors import DerivationError
from obsynth.derive.forms.varying import Vertices
from obsynth.derive.rigour import UNIT_ROUNDOFF
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.shown import Shown


@dataclass(frozen=True, eq=False, repr=False)
class CentredForm(Shown):
    """Nominal matrices plus a remainder: A(rho) = A + Delta, Delta in a polytope and in a box.

    The remainder has vertices (N, n, n), (N, n, n_u), and elementwise bounds, rounded outwards; the
    radius is what rounding may add beyond the hull of the vertices, and exact tells whether that
    hull is the remainder itself.
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


def centre_form(polytope: Vertices, nominal: ArrayLike | None = None) -> CentredForm:
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
