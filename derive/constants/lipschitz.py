"""Lipschitz, one-sided Lipschitz and quadratic inner-boundedness constants, guaranteed."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import sympy as sp

from obsynth.derive.constants.eigenvalue_search import Maximum
from obsynth.derive.constants.matrix_maximum import Hull, matrix_maximum
from obsynth.derive.constants.symmetric_field import augment
from obsynth.derive.errors import DerivationError
from obsynth.derive.intervals.ranges import Ends
from obsynth.derive.jacobian.bounds import JacobianBounds, jacobian_bounds
from obsynth.derive.jacobian.entries import MatrixEntries, exact_jacobian, matrix_entries
from obsynth.derive.rigour import UNIT_ROUNDOFF
from obsynth.derive.split import Split
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.table import Table, Tabled
from obsynth.symbolic.taking import takes

_MOST_VERTICES = 4096


@dataclass(frozen=True, eq=False)
class InnerBound:
    """|g(a) - g(b)|^2 <= beta |a - b|^2 + gamma (a - b)'(g(a) - g(b)).

    beta: guaranteed for this gamma, with the attained value
    gamma: chosen or given
    radius: sqrt(beta + gamma^2 / 4): g(a) - g(b) lies in a ball of this radius times |a - b| around
        (gamma / 2) (a - b). With gamma = 0 it is the Lipschitz constant
    """

    beta: Maximum
    gamma: float
    radius: float


@dataclass(frozen=True, eq=False, repr=False)
class LipschitzConstants(Tabled):
    """How fast a nonlinearity can change over the box, in the 2-norm of the plant's units.

    norm: Lipschitz constant: largest norm of the Jacobian
    one_sided: one-sided Lipschitz constant: largest eigenvalue of the symmetric part of the
        Jacobian, so that (a - b)'(g(a) - g(b)) <= one_sided |a - b|^2. May be negative
    inner: constants of quadratic inner-boundedness
    what: which function they belong to
    """

    norm: Maximum
    one_sided: Maximum
    inner: InnerBound
    what: str

    def table(self) -> Table:
        """Tabulate the constants: what is guaranteed, attained, and where."""
        inner = f"inner-bounded: beta for gamma = {self.inner.gamma:.6g}"
        maxima = [
            ("Lipschitz: norm of the Jacobian", self.norm),
            ("one-sided: largest eigenvalue of the symmetric part", self.one_sided),
            (inner, self.inner.beta),
        ]
        heads = ("", "guaranteed", "attained", "status", "by", "at")
        rows = [
            (name, f"{m.upper:.8g}", f"{m.attained:.8g}", m.status.word, m.method, m.where)
            for name, m in maxima
        ]
        return Table(f"Constants of {self.what}, over the box", heads, rows)


@takes(split_or_model="Plant Split")
def lipschitz(
    split_or_model: Split | Plant,
    gamma: float | None = None,
    rtol: float = 1e-6,
    effort: Literal["fast", "normal", "tight"] = "normal",
) -> LipschitzConstants:
    """Bound how fast the nonlinearity of a plant changes over its box.

    The three constants are largest eigenvalues of symmetric matrices that are affine in the
    Jacobian J: of [0 J; J' 0], of (J + J')/2, and of the first with J - (gamma/2) I in place of J.
    All are convex in J, so what holds for the Jacobians at points holds for their mean along a
    segment, which is what a difference of values multiplies. The symmetric part is formed by
    SymPy, entry by entry, before anything is bounded: what cancels there (x - x in the Lorenz
    system) is gone, while interval bounds of J would keep it.

    Every constant is the smallest of three guaranteed bounds: the sign matrices of Hertz over the
    entrywise bounds, the vertices of the affine family of the Jacobian, and branch and bound over
    the box.

    Parameters
    ----------
    split_or_model : Split or Plant
        A split: constants of its g. A plant: of its right-hand side.
    gamma : float, optional
        For quadratic inner-boundedness; by default the one with the smallest ball, see
        `InnerBound`.
    rtol : float
        Wanted gap between guaranteed and attained value, relative to its size.
    effort : {"fast", "normal", "tight"}
        How many boxes branch and bound may use.

    Returns
    -------
    LipschitzConstants
        Guaranteed from above, attained from below, with the points.

    Raises
    ------
    StructureError
        The dynamics jump inside the box.
    UnboundedError
        An entry of the Jacobian has no finite bound over the box.
    DerivationError
        Options that are not known.

    References
    ----------
    M. Abbaszadeh, H. J. Marquez, Nonlinear observer design for one-sided Lipschitz systems,
    American Control Conference 2010 (one-sided Lipschitz and quadratic inner-boundedness).

    Examples
    --------
    >>> from obsynth.derive.split import split
    >>> from obsynth.symbolic.plants import quadruple_tank
    >>> parts = split(quadruple_tank().discretise("euler", Ts=1.0))
    >>> found = lipschitz(parts)
    >>> round(found.norm.upper, 6), round(found.one_sided.upper, 6)
    (0.020981, 0.018729)
    """
    if gamma is not None and not np.isfinite(gamma):
        raise DerivationError(f"gamma has to be a finite number; given was {gamma}", gamma=gamma)
    is_split = isinstance(split_or_model, Split)
    model = split_or_model.model if isinstance(split_or_model, Split) else split_or_model
    bounds = jacobian_bounds(split_or_model, rtol=rtol, effort=effort)
    exact = exact_jacobian(split_or_model)
    n = exact.rows
    whole = {(i, n + j): exact[i, j] for i in range(n) for j in range(n)}
    half = {(i, j): (exact[i, j] + exact[j, i]) / 2 for i in range(n) for j in range(i, n)}
    hull = _hull(bounds)
    pairs, symmetric = matrix_entries(whole, model), matrix_entries(half, model)
    known = _known(bounds, pairs, n)

    def of_shifted(shift: float) -> Maximum:
        moved = hull.moved(-shift * np.eye(n))
        fixed = augment(-shift * np.eye(n))
        return matrix_maximum(pairs, known, fixed, moved.augmented(), rtol, effort)

    halves = _halves(bounds, symmetric, exact, rtol, effort)
    one_sided = matrix_maximum(symmetric, halves, np.zeros((n, n)), hull.symmetric(), rtol, effort)
    shift = 0.5 * (_smallest_ball(bounds, hull, pairs) if gamma is None else gamma)
    norm = of_shifted(0.0)
    ball = norm if shift == 0.0 else of_shifted(shift)
    what = f"g of {model.name}" if is_split else f"the right-hand side of {model.name}"
    return LipschitzConstants(norm, one_sided, _inner(ball, shift), what)


def _inner(ball: Maximum, shift: float) -> InnerBound:
    margin = 4.0 * UNIT_ROUNDOFF * (ball.upper**2 + shift**2)
    upper = ball.upper**2 - shift**2 + margin
    attained = max(ball.attained, 0.0) ** 2 - shift**2 - margin
    beta = replace(ball, upper=upper, attained=attained)
    return InnerBound(beta, 2.0 * shift, ball.upper)


def _known(bounds: JacobianBounds, entries: MatrixEntries, shift: int) -> Ends:
    """Take the ranges of J over from its bounds; columns of the entries are moved by a shift."""
    index = [bounds.variables.index(name) for name in entries.names]
    at = [(i, j - shift) for i, j in entries.places]
    points = np.array([bounds.attained_at[place][:, index] for place in at])
    points = np.nan_to_num(points).reshape(-1, 2, len(index))
    low = np.array([bounds.min[place] for place in at])
    high = np.array([bounds.max[place] for place in at])
    return Ends(low, high, points[:, 0], points[:, 1])


def _halves(
    bounds: JacobianBounds, entries: MatrixEntries, exact: sp.Matrix, rtol: float, effort: str
) -> Ends:
    """Ranges of the symmetric part; bounded anew only where two entries of J meet."""
    at = bounds.attained_at
    half = replace(
        bounds,
        min=0.5 * (bounds.min + bounds.min.T),
        max=0.5 * (bounds.max + bounds.max.T),
        attained_at=np.where(np.isnan(at), at.swapaxes(0, 1), at),
    )
    found = _known(half, entries, 0)
    pairs = [(i != j and exact[i, j] != 0 and exact[j, i] != 0) for i, j in entries.places]
    meeting = np.flatnonzero(pairs).tolist()
    if meeting:
        anew = entries.take(meeting)
        ranges = anew.ranges(rtol, effort, "(J + J')/2")
        columns = [entries.names.index(name) for name in anew.names]
        for row, k in enumerate(meeting):
            found.lower[k], found.upper[k] = ranges.lower[row], ranges.upper[row]
            found.points_lower[k, columns] = ranges.points_lower[row]
            found.points_upper[k, columns] = ranges.points_upper[row]
    return found


def _hull(bounds: JacobianBounds) -> Hull:
    """Vertices of the Jacobian family and their rounding; none where there are too many."""
    family = bounds.family
    if family.vertex_count > _MOST_VERTICES:
        return Hull(np.zeros((0, *bounds.min.shape)), np.zeros(bounds.min.shape))
    return Hull(bounds.vertices(), bounds.vertex_radius)


def _smallest_ball(bounds: JacobianBounds, hull: Hull, pairs: MatrixEntries) -> float:
    """Pick gamma = 2 c with c the multiple of I from which the Jacobians are least far away."""
    from scipy.optimize import minimize_scalar

    vertices, n = hull.vertices, len(bounds.min)
    if not len(vertices) or not bounds.family.exact:
        sampled = pairs.sample()
        count = len(next(iter(sampled.values()))) if sampled else 0
        vertices = np.zeros((count, n, n))
        for (i, j), values in sampled.items():
            vertices[:, i, j - n] = values
    if not vertices.any():
        return 0.0
    identity = np.eye(n)
    limit = float(np.linalg.norm(vertices, 2, axis=(1, 2)).max())
    found = minimize_scalar(
        lambda c: float(np.linalg.norm(vertices - c * identity, 2, axis=(1, 2)).max()),
        bounds=(-limit, limit),
        method="bounded",
        options={"xatol": 1e-6 * limit},
    )
    # a gamma with few digits is as good and can be written down
    return float(f"{2.0 * found.x:.6g}") if abs(found.x) > 1e-5 * limit else 0.0
