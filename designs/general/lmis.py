"""One storage function ``V = e_c'P e_c`` for the error system of the general class, stated once.

docs/methods/general_class.md, Ellipsoid and energy gain, has the block, in the letters used here.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.derive.rigour import Enclosure, add_up, product_up
from obsynth.designs.general.record import Rounding
from obsynth.designs.general.system import Channels, ErrorSystem, magnitude
from obsynth.designs.lmi.problem import he, symmetric_block
from obsynth.symbolic.arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Loop:
    """E, Y, rows z (n_q, K) of the channels, components of v that stand for v_k and v_{k+1}."""

    E: Enclosure
    Y: Enclosure
    z: Enclosure
    before: IntArray
    after: IntArray

    @property
    def sizes(self) -> tuple[int, int, int]:
        """N, n_w, n_q."""
        return self.E.shape[0], len(self.before) + len(self.after), self.z.shape[0]


def error_loop(system: ErrorSystem) -> Loop:
    """Form the maps of an error system; v in units of its bound."""
    N, radius, rest = system.size, system.v_radius, system.rest
    h, F = system.of_h, system.of_F
    A0, W0 = (
        Enclosure(system.A0, rest[:N, :N]),
        Enclosure(system.W0, rest[:N, N:]),
    )
    C0, V0 = (
        Enclosure(system.C0, rest[N:, :N]),
        Enclosure(system.V0, rest[N:, N:]),
    )
    # where an entry is not exactly zero, its rounding at least is left open
    moves, shows = (np.any(part != 0.0, axis=0) for part in (rest[:N, N:], rest[N:, N:]))
    moves[F.sources[F.sources >= N] - N] = True
    shows[h.sources[h.sources >= N] - N] = True
    before, after = (np.flatnonzero(which & (radius > 0.0)) for which in (moves, shows))
    at = np.cumsum([N, len(before), len(after), len(F.radii), len(h.radii)])
    eye = np.eye(at[-1])
    e, first, second, q_F, q_h = (eye[a:b] for a, b in zip([0, *at], at, strict=False))
    scaled = [np.diag(radius)[:, which] for which in (before, after)]
    next_p = A0 @ e + W0 @ (scaled[0] @ first) + Enclosure.of(F.columns) @ q_F
    E = system.T @ next_p - system.through @ (scaled[1] @ second)
    Y = C0 @ E + V0 @ (scaled[1] @ second) + Enclosure.of(h.columns) @ q_h
    # z_j: the errors before for F and those of e_q after for h, or a component of v
    seen = [
        _rows(F, Enclosure.of(e), scaled[0] @ first),
        _rows(h, E, scaled[1] @ second),
    ]
    z = Enclosure(np.vstack([s.mid for s in seen]), np.vstack([s.rad for s in seen]))
    return Loop(E, Y, z, before, after)


def _rows(channels: Channels, errors: Enclosure, v: FloatArray) -> Enclosure:
    """Return what drives every channel, times its radius."""
    drives = Enclosure(np.vstack([errors.mid, v]), np.vstack([errors.rad, np.zeros_like(v)]))
    picked = Enclosure(drives.mid[channels.sources], drives.rad[channels.sources])
    return picked * channels.radii[:, None]


def closed_rows(loop: Loop, Z: FloatArray) -> Enclosure:
    """Return ``E - Z Y`` of a gain, (N, K)."""
    return loop.E - Enclosure.of(Z) @ loop.Y


def storage_block(
    P: Any, X: Any, keep: Any, noise: Any, tau: Any, z: Any, output: Any = None
) -> Any:
    """Return the block, in any arithmetic; noise, tau and output C'C None where there are none.

    Shapes: X = P (E - Z Y) (N, K), keep (1, 1), noise (n_w, n_w), tau (n_q, n_q), z (n_q, K).
    """
    first = P * keep if output is None else P * keep - output
    parts = [part for part in (first, noise, tau) if part is not None]
    inner = symmetric_block([[0] * i + [part] for i, part in enumerate(parts)])
    if tau is not None:
        seen = z.T @ tau @ z
        inner = inner - he(seen) * 0.5
    return symmetric_block([[inner], [X, P]])


def rounding_in(system: ErrorSystem, rounding: Rounding) -> FloatArray:
    """Bound what rounding of the three stages adds to the next e_c, (N,), rounded up."""
    N, h = system.size, system.of_h
    # what reaches e_q, which the readings' slopes see as well
    moved = add_up(product_up(magnitude(system.T), rounding.p), rounding.q)
    slopes = add_up(
        np.abs(system.C0), system.rest[N:, :N], product_up(np.abs(h.columns), h.coupling(N))
    )
    back = product_up(np.abs(system.Z), product_up(slopes, moved))
    return add_up(moved, back, rounding.c)
