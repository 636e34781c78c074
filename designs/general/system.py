"""The error system of the general class, enclosed: docs/methods/general_class.md, The observer.

With e_p, e_q, e_c the errors of the three stages, v less its middle, T = I - L0 C, and a channel
``b delta z``, |delta| <= r, for every column of every direction; an innovation moves
``back = A0 Z + K`` in all.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from obsynth.derive.rigour import UNIT_ROUNDOFF, Enclosure, add_up, product_up, raised
from obsynth.designs.general.record import GeneralDesign
from obsynth.symbolic.arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Channels:
    """Columns ``b delta z`` (rows, count), z an entry of [e; v], ``|delta| <= radius``."""

    columns: FloatArray
    radii: FloatArray
    sources: IntArray

    def coupling(self, size: int) -> FloatArray:
        """Return how the channels are driven by the errors, (count, N)."""
        found = np.zeros((len(self.radii), size))
        inner = np.flatnonzero(self.sources < size)
        found[inner, self.sources[inner]] = self.radii[inner]
        return found

    def sizes(self, size: int, v_radius: FloatArray) -> FloatArray:
        """Return how large those are that disturbances drive, (count,), zero for others."""
        found = np.zeros(len(self.radii))
        outer = np.flatnonzero(self.sources >= size)
        found[outer] = raised(self.radii[outer] * v_radius[self.sources[outer] - size], 1)
        return found


@dataclass(frozen=True, eq=False)
class ErrorSystem:
    """The matrices above, all enclosed. Shapes: N errors, n_v disturbances, m outputs.

    A0, W0, C0, V0: the middle, exact doubles
    T, kept: ``I - L0 C`` and ``I - Z C0``, (N, N)
    back: ``A0 Z + K``, (N, m)
    through, direct: ``L0 V`` and ``L0 V + Z (V0 - C0 L0 V)``, what v adds to e_q, e_c
    B_v, B_y: what v and the channels of h add to e_p
    of_h, of_F: channels; `of_h.columns` (m, .), `of_F.columns` (N, .)
    rest: what the family varies beside its channels, entrywise, (N + m, N + n_v)
    v_radius: of v about v0
    """

    A0: FloatArray
    W0: FloatArray
    C0: FloatArray
    V0: FloatArray
    L0: FloatArray
    Z: FloatArray
    T: Enclosure
    kept: Enclosure
    back: Enclosure
    through: Enclosure
    direct: Enclosure
    B_v: Enclosure
    B_y: Enclosure
    of_h: Channels
    of_F: Channels
    rest: FloatArray
    v_radius: FloatArray

    @property
    def size(self) -> int:
        """N."""
        return len(self.A0)

    @cached_property
    def M(self) -> Enclosure:
        """``(I - Z C0) T``, which takes e_p to e_c, (N, N)."""
        return self.kept @ self.T

    @cached_property
    def onward(self) -> Enclosure:
        """``A0 - back C0``, which takes e_q to the next e_p, (N, N)."""
        return Enclosure.of(self.A0) - self.back @ self.C0

    @cached_property
    def closed(self) -> Enclosure:
        """What moves e_q, (N, N)."""
        return self.T @ self.onward

    @cached_property
    def moving(self) -> Enclosure:
        """What moves e_p, (N, N)."""
        return self.onward @ self.T

    @cached_property
    def seen(self) -> Enclosure:
        """``[I; I - Z C0]``, which takes e_q to [e_q; e_c], (2 N, N)."""
        eye, kept = np.eye(self.size), self.kept
        return Enclosure(np.vstack([eye, kept.mid]), np.vstack([0.0 * eye, kept.rad]))


def split_columns(
    directions: FloatArray, radii: FloatArray, rows: slice, widths: FloatArray
) -> Channels:
    """Take the directions of a family apart by columns that vary over variables of some width."""
    part = directions[:, rows]
    varies = np.any(part != 0.0, axis=1) & (radii > 0.0)[:, None] & (widths > 0.0)
    which, sources = np.nonzero(varies)
    return Channels(part[which, :, sources].T, radii[which], sources)


def error_system(design: GeneralDesign) -> ErrorSystem:
    """Form the error system of a design with gains."""
    family, N = design.family, design.size
    middle, mids = design.middle, family.ranges.mean(axis=1)
    apart = np.maximum(family.ranges[:, 1] - mids, mids - family.ranges[:, 0])
    radii = np.where(apart > 0.0, np.nextafter(apart, np.inf), 0.0)
    # what rounding the middle moves
    size = np.abs(family.constant) + np.tensordot(np.abs(mids), np.abs(family.directions), axes=1)
    spread = 2.0 * (len(mids) + 1) * UNIT_ROUNDOFF * size
    rest = raised(family.radius + np.where(len(mids) > 0, spread, 0.0), 4)
    rest[(family.radius == 0.0) & (size == 0.0)] = 0.0
    A0, W0, C0, V0 = middle[:N, :N], middle[:N, N:], middle[N:, :N], middle[N:, N:]
    widths = np.concatenate([np.ones(N), design.v_radius])
    eye, of = np.eye(N), Enclosure.of
    L0, Z = of(design.L0), of(design.Z)
    T = of(eye) - L0 @ Enclosure(C0, rest[N:, :N])
    through = L0 @ Enclosure(V0, rest[N:, N:])
    shown = of(V0) - of(C0) @ through
    back = of(A0) @ Z + design.K
    of_h = split_columns(family.directions, radii, slice(N, None), widths)
    of_F = split_columns(family.directions, radii, slice(0, N), widths)
    return ErrorSystem(
        A0=A0,
        W0=W0,
        C0=C0,
        V0=V0,
        L0=design.L0,
        Z=design.Z,
        T=T,
        kept=of(eye) - Z @ C0,
        back=back,
        through=through,
        direct=through + Z @ shown,
        B_v=of(W0) - of(A0) @ through - back @ shown,
        B_y=-(back @ of_h.columns),
        of_h=of_h,
        of_F=of_F,
        rest=rest,
        v_radius=design.v_radius,
    )


def magnitude(value: Enclosure) -> FloatArray:
    """Bound the entries of an enclosure."""
    total: FloatArray = np.abs(value.mid) + value.rad
    return np.where(value.rad > 0, np.nextafter(total, np.inf), total)


@dataclass(frozen=True, eq=False)
class Extra:
    """What else enters, rounding above all: bounds for e_q and e_c directly, and for e_p."""

    q: FloatArray
    c: FloatArray
    p: FloatArray


def extra_inputs(system: ErrorSystem, design: GeneralDesign) -> Extra:
    """Bound what rounding and the leak of L0 add, (N,) each."""
    rounding = design.rounding
    c = add_up(product_up(magnitude(system.kept), rounding.q), rounding.c)
    onward = product_up(magnitude(system.onward), rounding.q)
    return Extra(
        rounding.q, c, add_up(onward, product_up(np.abs(system.A0), rounding.c), rounding.p)
    )
