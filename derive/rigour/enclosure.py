"""Matrices enclosed by middle and radius, and the proof that a family of them is definite.

Products are those of S. M. Rump, "Fast and parallel interval arithmetic", BIT 39 (1999), with the
rounding mode left to nearest. Definiteness is proved after S. M. Rump, "Verification of positive
definiteness", BIT 46 (2006): if Cholesky's factorisation of fl(B - c I) runs to its end, B is
positive definite for a c computed from the diagonal. It is written out here, because its error
bound (Higham, Accuracy and Stability, theorem 10.3) holds for the plain algorithm in any order of
summation, but not for whatever a tuned library may do.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive.rigour.interval import UNIT_ROUNDOFF, down, gamma_bound, raised, smallest_above
from obsynth.derive.rigour.rationals import ExactMatrix
from obsynth.symbolic.arrays import BoolArray, FloatArray, IntArray
from obsynth.symbolic.errors import ObsynthError


@dataclass(frozen=True, eq=False)
class Enclosure:
    """Every real matrix within ``rad`` of ``mid``, entry by entry.

    Numbers and arrays that meet an enclosure count as exact doubles. A leading axis holds one
    matrix per vertex. Entries that overflow become NaN or infinite and prove nothing.

    mid: midpoints
    rad: radii, not negative; one radius for all vertices may be a broadcast view
    """

    mid: FloatArray
    rad: FloatArray

    __array_ufunc__ = None

    @classmethod
    def of(cls, value: Any, radius: ArrayLike = 0.0) -> Enclosure:
        """Exact doubles, or doubles with a radius; exact matrices are rounded, enclosures pass."""
        if isinstance(value, Enclosure):
            return value
        if isinstance(value, ExactMatrix):
            return _rounded(value)
        mid = np.asarray(value, dtype=float)
        if mid.ndim == 0:
            mid = mid.reshape(1, 1)
        if mid.ndim not in (2, 3):
            raise ObsynthError(
                f"an enclosure of shape {mid.shape}: matrices (r, c) or families (N, r, c)",
                shape=mid.shape,
            )
        rad = np.broadcast_to(np.asarray(radius, dtype=float), mid.shape)
        if not np.all(rad >= 0):
            raise ObsynthError("the radius of an enclosure has a negative or NaN entry")
        return cls(mid, rad)

    @classmethod
    def combine(cls, centre: Enclosure, directions: Enclosure, weights: ArrayLike) -> Enclosure:
        """Enclose ``centre + sum_k weights[i, k] directions[k]`` for every vertex i."""
        table = np.asarray(weights, dtype=float)
        count, rows, columns = table.shape[1], *centre.shape
        steps = directions.mid.reshape(count, rows * columns)
        spread = directions.rad.reshape(count, rows * columns)
        mid = centre.mid + (table @ steps).reshape(-1, rows, columns)
        # The largest weight of every parameter bounds the rounding at all vertices at once.
        largest = np.abs(table).max(axis=0, initial=0.0)
        size = np.abs(centre.mid) + (largest @ np.abs(steps)).reshape(rows, columns)
        rad = centre.rad + (largest @ spread).reshape(rows, columns)
        bound = raised(rad + gamma_bound(count + 1) * size, count + 8)
        return cls(mid, np.broadcast_to(bound, mid.shape))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of one member."""
        return self.mid.shape[-2], self.mid.shape[-1]

    @property
    def T(self) -> Enclosure:
        """Transpose of every member."""
        return Enclosure(np.swapaxes(self.mid, -1, -2), np.swapaxes(self.rad, -1, -2))

    def contains(self, value: ArrayLike) -> bool:
        """Whether the doubles given lie inside, certainly."""
        distance = np.abs(np.asarray(value, dtype=float) - self.mid)
        return bool(np.all(distance * (1.0 + 4 * UNIT_ROUNDOFF) <= self.rad))

    def member(self, index: Any) -> Enclosure:
        """Select vertices of a family."""
        return self if self.mid.ndim == 2 else Enclosure(self.mid[index], self.rad[index])

    def __getitem__(self, key: Any) -> Enclosure:
        rows, columns = key if isinstance(key, tuple) else (key, slice(None))
        rows, columns = (
            slice(k, k + 1 or None) if isinstance(k, (int, np.integer)) else k
            for k in (rows, columns)
        )
        return Enclosure(
            self.mid[..., rows, :][..., :, columns], self.rad[..., rows, :][..., :, columns]
        )

    def __neg__(self) -> Enclosure:
        return Enclosure(-self.mid, self.rad)

    def __add__(self, other: Any) -> Enclosure:
        if _is_zero(other):
            return self
        right = Enclosure.of(other)
        if self.shape != right.shape:
            raise ObsynthError(f"enclosures of shapes {self.shape} and {right.shape} do not fit")
        mid = self.mid + right.mid
        return Enclosure(mid, raised(self.rad + right.rad + UNIT_ROUNDOFF * np.abs(mid), 4))

    __radd__ = __add__

    def __sub__(self, other: Any) -> Enclosure:
        return self if _is_zero(other) else self + (-Enclosure.of(other))

    def __rsub__(self, other: Any) -> Enclosure:
        return -self if _is_zero(other) else Enclosure.of(other) - self

    def __mul__(self, other: Any) -> Enclosure:
        right = Enclosure.of(other)
        mid = self.mid * right.mid
        left_size = np.abs(self.mid) + self.rad
        rad = left_size * right.rad + self.rad * np.abs(right.mid) + UNIT_ROUNDOFF * np.abs(mid)
        return Enclosure(mid, raised(rad, 8))

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Enclosure:
        right = Enclosure.of(other)
        smallest = np.abs(right.mid) * (1 - 2 * UNIT_ROUNDOFF) - raised(right.rad, 1)
        if not np.all(smallest > 0):
            raise ObsynthError("division by an enclosure that contains zero")
        mid = self.mid / right.mid
        rad = (self.rad + np.abs(mid) * right.rad) / smallest + 2 * UNIT_ROUNDOFF * np.abs(mid)
        return Enclosure(mid, raised(rad, 12))

    def __rtruediv__(self, other: Any) -> Enclosure:
        return Enclosure.of(other) / self

    def __matmul__(self, other: Any) -> Enclosure:
        right = Enclosure.of(other)
        inner = self.shape[1]
        mid = self.mid @ right.mid
        left_size = np.abs(self.mid)
        rounding = gamma_bound(inner) * (left_size @ np.abs(right.mid))
        spread = rounding
        if np.any(right.rad):
            spread = spread + (left_size + self.rad) @ right.rad
        if np.any(self.rad):
            spread = spread + self.rad @ np.abs(right.mid)
        return Enclosure(mid, raised(spread, inner + 8))

    def __rmatmul__(self, other: Any) -> Enclosure:
        return Enclosure.of(other) @ self


def _rounded(matrix: ExactMatrix) -> Enclosure:
    """Nearest doubles, with what is lost."""
    mid = matrix.to_floats()
    lost = [
        [smallest_above(abs(value - Fraction(near))) for value, near in zip(*rows, strict=True)]
        for rows in zip(matrix.to_fractions(), mid.tolist(), strict=True)
    ]
    return Enclosure(mid, np.array(lost).reshape(mid.shape))


def _is_zero(value: Any) -> bool:
    return isinstance(value, (int, float)) and value == 0


# Generous bound on all underflow errors of one factorisation of a matrix scaled to a unit
# diagonal: n (n + 2) 2^-1074 and the same again for the scaling.
_UNDERFLOW = 1e-290

# Above the underflow of one squared radius.
_SMALLEST = 2.0**-1022

# Entries treated at a time, so that the work arrays stay in the cache.
_CHUNK_ENTRIES = 2**17


@dataclass(frozen=True, eq=False)
class ProofResult:
    """Which enclosures hold positive definite matrices only, and by how much.

    margin: guaranteed lower bound of the smallest eigenvalue; -inf where nothing is proved
    relative: the same after scaling the diagonal to about one: compare vertices by this
    """

    proved: BoolArray
    margin: FloatArray
    relative: FloatArray

    @property
    def all_proved(self) -> bool:
        """Whether every matrix is proved."""
        return bool(self.proved.all())

    def worst(self, count: int = 1) -> IntArray:
        """Find the matrices with the smallest relative margin, worst first."""
        return np.argsort(self.relative, kind="stable")[:count]


def prove_positive_definite(
    mid: ArrayLike | Enclosure, rad: ArrayLike = 0.0, *, floor: float = 0.0, sharp: bool = True
) -> ProofResult:
    """Prove that every symmetric matrix within ``rad`` of ``mid`` is positive definite."""
    matrices = mid if isinstance(mid, Enclosure) else Enclosure.of(mid, rad)
    if matrices.shape[0] != matrices.shape[1]:
        raise ObsynthError(f"a matrix of shape {matrices.shape} is not square")
    n = matrices.shape[0]
    stack = matrices.mid if matrices.mid.ndim == 3 else matrices.mid[None]
    radii = np.broadcast_to(matrices.rad, stack.shape)
    chunk = max(1, _CHUNK_ENTRIES // (n * n))
    pieces = [
        _prove(stack[start : start + chunk], radii[start : start + chunk], start, floor, sharp)
        for start in range(0, len(stack), chunk)
    ]
    lower, unscaled = np.concatenate(pieces, axis=1) if pieces else np.zeros((2, 0))
    proved = lower > 0
    # One step down covers the rounding of the sum.
    bound = down(floor + unscaled) if floor else unscaled
    return ProofResult(
        proved=proved,
        margin=np.where(proved, bound, -np.inf),
        relative=np.where(proved, lower, -np.inf),
    )


def _prove(mid: FloatArray, rad: FloatArray, first: int, floor: float, sharp: bool) -> FloatArray:
    """Lower bounds of the smallest eigenvalues, scaled and unscaled, as two rows."""
    n = mid.shape[-1]
    with np.errstate(all="ignore"):
        centre, spread, scale = _scaled(mid, rad, first)
        if floor:
            # Taking the floor from A takes floor D^-2 from the scaled matrix.
            np.einsum("bii->bi", centre)[:] -= floor / (scale * scale)
        finite = np.isfinite(centre.sum(axis=(1, 2))) & np.isfinite(spread)
        if not finite.all():
            centre = np.where(finite[:, None, None], centre, 0.0)
        trace = np.abs(np.diagonal(centre, axis1=1, axis2=2)).sum(axis=1)
        needed = spread + (2.0 * gamma_bound(n + 8)) * (trace + n) + 4 * _UNDERFLOW
        lower = _factorise(centre, np.where(finite, needed, np.inf), spread)
        if sharp and finite.any():
            estimate = np.full(len(centre), -np.inf)
            estimate[finite] = np.linalg.eigvalsh(centre[finite])[:, 0]
            for fraction in (1.0 - 2.0**-10, 0.75):
                shift = fraction * estimate
                tried = finite & (shift > needed) & (shift > lower)
                better = _factorise(centre[tried], shift[tried], spread[tried])
                lower[tried] = np.maximum(lower[tried], better)
        # D B D = A with D diagonal: the smallest eigenvalue of A is at least min(D^2) that of B.
        unscaled = lower * scale.min(axis=1) ** 2 * (1.0 - 4 * UNIT_ROUNDOFF)
    return np.stack([lower, unscaled])


def _scaled(
    mid: FloatArray, rad: FloatArray, first: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Symmetric midpoints with a diagonal near one, bounds of the radii's norms, the scale."""
    mirrored = np.swapaxes(mid, 1, 2)
    gap = np.abs(mid - mirrored)
    symmetric = not gap.any()
    if not symmetric:
        allowed = (rad + np.swapaxes(rad, 1, 2)) * (1.0 + 8 * UNIT_ROUNDOFF)
        if np.any(gap > allowed):
            member, i, j = np.argwhere(gap > allowed)[0]
            raise ObsynthError(
                f"matrix {first + member} is not symmetric: entries ({i}, {j}) and ({j}, {i}) "
                f"differ by {gap[member, i, j]:.3g}, more than their radii explain",
                member=int(first + member),
                entry=(int(i), int(j)),
            )
        mid = 0.5 * (mid + mirrored)
        rad = 0.5 * (rad + np.swapaxes(rad, 1, 2)) * (1.0 + 4 * UNIT_ROUNDOFF)
        rad = rad + 2 * UNIT_ROUNDOFF * np.abs(mid)
    diagonal = np.abs(np.diagonal(mid, axis1=1, axis2=2))
    usable = np.isfinite(diagonal) & (diagonal > 0)
    exponent = np.where(usable, np.frexp(np.where(usable, diagonal, 1.0))[1], 0)
    scale = np.ldexp(1.0, np.clip(exponent // 2, -400, 400))
    factor = 1.0 / (scale[:, :, None] * scale[:, None, :])
    return mid * factor, _norm_bound(rad, factor), scale


def _norm_bound(rad: FloatArray, factor: FloatArray) -> FloatArray:
    """Upper bound of the spectral norm of any symmetric matrix within the scaled radius."""
    count, n = rad.shape[0], rad.shape[-1]
    if rad.strides[0] == 0 and not rad[:1].any():
        return np.zeros(count)
    if rad.strides[0] == 0:
        # One radius for all vertices: the largest factors serve them all.
        rad, factor = rad[:1], factor.max(axis=0, keepdims=True)
    scaled = rad * factor
    sums = np.minimum(
        scaled.sum(axis=2).max(axis=1),
        np.sqrt((scaled * scaled).sum(axis=(1, 2)) + n * n * _SMALLEST),
    )
    bound = sums * (1.0 + 2 * gamma_bound(n * n + 8)) + _UNDERFLOW
    return np.broadcast_to(bound, count)


def _factorise(centre: FloatArray, shift: FloatArray, spread: FloatArray) -> FloatArray:
    """Proved lower bounds of the smallest eigenvalues, -inf where the factorisation fails."""
    n = centre.shape[-1]
    # The batch runs along the last, contiguous axis; row k of ``work`` becomes row k of R.
    work = np.array(np.moveaxis(centre, 0, -1), order="C")
    diagonal = np.einsum("iib->ib", work)
    diagonal -= shift
    trace = np.abs(diagonal).sum(axis=0)
    largest = np.abs(diagonal).max(axis=0)
    complete = np.isfinite(shift)
    for j in range(n):
        column = work[j, j:]
        if j:
            column -= np.einsum("krb,kb->rb", work[:j, j:], work[:j, j])
        complete &= column[0] > 0
        column /= np.sqrt(column[0])
    # R'R = fl(B - c I) + E with |E|_2 <= g / (1 - g) trace (theorem 10.3, rows of R bounded
    # by the diagonal), and the diagonal of B - c I itself was rounded once or, with a floor, twice.
    rounded = 4 * UNIT_ROUNDOFF * (largest + np.abs(shift))
    loss = gamma_bound(n + 4) * trace * (1.0 + 1e-6) + rounded
    lower = (shift - loss - spread) - 8 * UNIT_ROUNDOFF * (np.abs(shift) + loss + spread)
    return np.where(complete & np.isfinite(lower), lower - _UNDERFLOW, -np.inf)
