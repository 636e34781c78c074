"""Zonotopes of code: ``c + G xi`` with |xi| <= 1, and what rounding adds, a box beside.

Every operation returns c, G and a slack such that the set of real arithmetic lies within
(docs/methods/set_membership_observer.md, What floating point adds).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from obsynth.designs.core.boxes import Ends, Rounding
from obsynth.symbolic.arrays import FloatArray

FEW = 12
"""Generators that a coordinate shares with a strip, up to which every breakpoint is tried."""
_TINY = {"double": 1e-290, "single": 2.0**-100}
_UP = 1.0 + 2.0**-40
"""Above the rounding of sums of up to a thousand terms, in doubles."""


@dataclass(frozen=True)
class Real:
    """What rounding takes in a precision; terms: of the longest sum."""

    precision: str = "double"
    terms: int = 0

    @property
    def step(self) -> float:
        """Four units of rounding."""
        return 2.0 * Rounding(self.precision).step

    @property
    def tiny(self) -> float:
        """Above what underflow takes of a sum."""
        return _TINY[self.precision]

    @property
    def up(self) -> float:
        """A factor above the rounding of sums of nonnegative terms."""
        return max(_UP, 1.0 + (self.terms + 8) * Rounding(self.precision).step)


DOUBLE = Real()


@dataclass(frozen=True, eq=False)
class Zonotope:
    """``c + G xi + eta``, |xi| <= 1, |eta| <= slack: (N,), (N, M), (N,)."""

    centre: ca.SX
    generators: ca.SX
    slack: ca.SX
    real: Real = DOUBLE

    @classmethod
    def of(cls, box: Ends, columns: int, real: Real = DOUBLE) -> "Zonotope":
        """Return a box with its generators first and zeros up to a number of columns."""
        N = box.lower.numel()
        centre = 0.5 * box.lower + 0.5 * box.upper
        radius = ca.fmax(box.upper - centre, centre - box.lower) * real.up
        filling = ca.SX(N, columns - N)
        return cls(centre, ca.horzcat(ca.diag(radius), filling), ca.SX(N, 1), real)

    @property
    def radius(self) -> ca.SX:
        """How far the set reaches from c, rounded up, (N,)."""
        return row_sums(self.generators) * self.real.up + self.slack

    @property
    def hull(self) -> Ends:
        """The box around the set."""
        reach = self.radius * self.real.up + self.real.step * ca.fabs(self.centre)
        return Ends(self.centre - reach, self.centre + reach)


@dataclass(frozen=True, eq=False)
class Strips:
    """Readings ``y = H x + o + eta`` with ``|eta| <= sigma``: (m, N), (m,), (m,)."""

    H: ca.SX
    innovation: ca.SX
    seen: ca.SX
    sigma: ca.SX
    real: Real = DOUBLE

    @classmethod
    def read(cls, z: Zonotope, H: ca.SX, rest: ca.SX, sigma: ca.SX, used: ca.SX) -> "Strips":
        """Return what readings say of a zonotope; nothing where they are not used.

        rest: ``y - o``, (m,); sigma takes what rounding adds to ``b = rest - H c`` and ``a = H G``
        """
        N, real = H.shape[1], z.real
        size = ca.fabs(H) @ (ca.fabs(z.centre) + z.radius) + ca.fabs(rest)
        wide = sigma * real.up + (N + 4) * real.step * size + ca.fabs(H) @ z.slack * real.up
        wide = wide + real.tiny
        return cls(H, used * (rest - H @ z.centre), H @ z.generators, wide, real)

    @property
    def against(self) -> ca.SX:
        """1 where a strip and the zonotope have nothing in common."""
        reach = (row_sums(self.seen) + self.sigma) * self.real.up
        return ca.sum1(ca.fabs(self.innovation) > reach) > 0.5


def moved(
    z: Zonotope, J: ca.SX, offset: ca.SX, columns: Sequence[ca.SX], spread: ca.SX
) -> Zonotope:
    """Return ``J z + offset + columns xi + diag(spread) xi``, the slack within the spread."""
    N, real = J.shape[0], z.real
    size = ca.fabs(J) @ (ca.fabs(z.centre) + z.radius) + ca.fabs(offset)
    wide = spread * real.up + (N + 4) * real.step * size + ca.fabs(J) @ z.slack * real.up
    wide = wide + real.tiny
    generators = ca.horzcat(*columns, ca.diag(wide), J @ z.generators)
    return Zonotope(J @ z.centre + offset, generators, ca.SX(N, 1), real)


def corrected(z: Zonotope, L: ca.SX, strips: Strips, used: ca.SX) -> Zonotope:
    """Return ``z + L (y - H z - o - eta)``, which holds the state whatever L is, (N, m)."""
    m, real = L.shape[1], z.real
    gain = L @ ca.diag(used)
    b, a, sigma = strips.innovation, strips.seen, strips.sigma
    size = ca.fabs(gain) @ (ca.fabs(b) + row_sums(a) + sigma)
    slack = (m + 4) * real.step * (ca.fabs(z.centre) + z.radius + size) + z.slack * real.up
    generators = ca.horzcat(gain @ ca.diag(sigma), z.generators - gain @ a)
    return Zonotope(z.centre + gain @ b, generators, slack + real.tiny, real)


def cut(z: Zonotope, strips: Strips, used: ca.SX) -> Ends:
    """Bound coordinates by one strip at a time and the zonotope together, (N,).

    docs/methods/set_membership_observer.md, Step, 5. Where a strip and the set have a point in
    common, neither |lam b| nor ``|lam| sum_j |a_j|`` is above ``sum_j |g_ij|`` and the reach.
    """
    hull, real = z.hull, z.real
    lower, upper = ca.SX(hull.lower), ca.SX(hull.upper)
    rooms = 8.0 * real.step * (row_sums(z.generators) + ca.fabs(z.centre)) + z.slack * real.up
    rooms = rooms + real.tiny
    for q in range(strips.H.shape[0]):
        a, sigma, b = strips.seen[q, :], strips.sigma[q], strips.innovation[q]
        size = ca.sum2(a * a) + sigma * sigma + real.tiny
        for i in range(z.centre.numel()):
            g = z.generators[i, :]
            common = [j for _, j in zip(*(g * a).sparsity().get_triplet(), strict=True)]
            if not common:
                continue
            gains = [ca.sum2(g * a) / size]
            if len(common) <= FEW:
                gains += [ca.if_else(ca.fabs(a[j]) > real.tiny, g[j] / a[j], 0.0) for j in common]
            for gain in gains:
                lam = used[q] * gain
                reach = ca.sum2(ca.fabs(g - lam * a)) + ca.fabs(lam) * sigma
                reach, middle = reach * real.up + rooms[i], z.centre[i] + lam * b
                lower[i] = ca.if_else(middle - reach > lower[i], middle - reach, lower[i])
                upper[i] = ca.if_else(middle + reach < upper[i], middle + reach, upper[i])
    return Ends(lower, upper)


@dataclass(frozen=True, eq=False)
class Frame:
    """Coordinates in which columns become a box, and what proves it; all (N, N).

    V, W: the coordinates and nearly their inverse
    size, leak: at least ``|W| (I - |I - V W|)^-1``, and that times ``|I - V W|``
    """

    V: FloatArray
    W: FloatArray
    size: FloatArray
    leak: FloatArray
    real: Real = DOUBLE

    @property
    def rounding(self) -> FloatArray:
        """Eight times what rounding V changes, in its own coordinates; 4 N times it is below 1."""
        return np.asarray(2.0 * self.real.step * (self.size @ np.abs(self.V)))

    @property
    def again(self) -> FloatArray:
        """What covers rounding V diag(reach), and itself: at least I + rounding / 8 times it."""
        powers = (np.linalg.matrix_power(self.rounding, k) for k in range(len(self.V) + 1))
        return np.asarray(sum(powers))


def reduced(z: Zonotope, keep: int, frame: Frame) -> Zonotope:
    """Replace all but the first columns, and the slack, by a box in coordinates of a frame."""
    N, real = len(frame.V), z.real
    kept, dropped = z.generators[:, :keep], z.generators[:, keep:]
    W, wide = _sparse(frame.W), row_sums(dropped) * real.up
    rounding = (N + 4) * real.step * np.abs(frame.W)
    reach = row_sums(W @ dropped) * real.up + _sparse(frame.leak + rounding) @ wide * real.up
    reach = reach + _sparse(frame.size) @ z.slack * real.up + real.tiny
    reach = _sparse(frame.again) @ reach * real.up
    box = _sparse(frame.V) @ ca.diag(reach)
    return Zonotope(z.centre, ca.horzcat(box, kept), ca.SX(N, 1), real)


def row_sums(matrix: ca.SX) -> ca.SX:
    """Return the sums of absolute values along rows, as a dense column."""
    return ca.densify(ca.sum2(ca.fabs(matrix)))


def _sparse(matrix: FloatArray) -> ca.DM:
    return ca.sparsify(ca.DM(matrix))
