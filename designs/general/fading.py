"""How the first error fades from the peak bounds: a nonnegative recursion, and its proof.

docs/methods/general_class.md, The first error, in the letters used here: ``mu+ <= G mu`` in a basis
V with the inverse Y, by blocks of one or two coordinates, or an exponential where none contracts.
"""

from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from itertools import pairwise

import numpy as np
from scipy.linalg import matrix_balance, schur

from obsynth.derive.rigour import (
    TINY,
    UNIT_ROUNDOFF,
    Enclosure,
    add_up,
    lowered,
    product_up,
    raised,
)
from obsynth.designs.core.certificate import Claim
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.general.peak import power_sum, response, small_gain_solution, spectral_radius
from obsynth.designs.general.record import Fading, Modes
from obsynth.designs.general.system import ErrorSystem, magnitude
from obsynth.symbolic.arrays import FloatArray, IntArray

# Between the spectral radius of G and 1: the decay that is stored and proved.
SHARES = (1e-6, 1e-3, 0.1)
# Row sums of I - Y V below it: Y is regular.
REGULAR = 0.5
Recursion = tuple[FloatArray, FloatArray, FloatArray]
"""G, the reach R to the errors, and the start S: nonnegative matrices, rounded up."""
# Room for other orders of summation when the numbers are computed again elsewhere: of the numbers,
# and of the radii where nothing but rounding is left.
SLACK, ROOM = 1.0 + 2.0**-36, 8.0
# Of the peak bounds: a first error that adds less has settled.
SETTLED = 0.1
# Of the way from the slowest decay to 1, for the exponential.
DECAYS = (0.1, 0.3, 0.6, 0.9)


def blocks_of(modes: Modes) -> IntArray:
    """Return the columns of every block by pairs of indices, -1 for none."""
    ends = np.cumsum(modes.blocks)
    return np.column_stack([ends - modes.blocks, np.where(modes.blocks == 2, ends - 1, -1)])


def proved_decay(G: FloatArray) -> float:
    """Return a decay that is proved, little above the spectral radius; 1 where none is."""
    radius = spectral_radius(G)
    candidates = (radius + share * (1.0 - radius) for share in SHARES)
    return next((decay for decay in candidates if contracts(G, decay)), 1.0)


def bases(A: FloatArray) -> Iterator[Modes]:
    """Propose real bases in which A is block diagonal, or block triangular."""
    balanced, (scale, _) = matrix_balance(A, permute=False, separate=True)
    values, vectors = np.linalg.eig(balanced)
    columns, blocks = [], []
    for k in np.flatnonzero(values.imag >= 0.0):
        v = vectors[:, k]
        pair = [v.real, v.imag] if values[k].imag else [v.real]
        columns += pair
        blocks.append(len(pair))
    triangular, rotation = schur(balanced)
    sizes: list[int] = []
    i = 0
    while i < len(A):
        sizes.append(1 + int(i + 1 < len(A) and triangular[i + 1, i] != 0.0))
        if sizes[-1] == 2:
            # [a b; c a] with b c < 0 becomes a rotation times its size
            rotation[:, i + 1] *= np.sqrt(-triangular[i + 1, i] / triangular[i, i + 1])
        i += sizes[-1]
    for basis, found in ((np.column_stack(columns), blocks), (rotation, sizes)):
        basis = scale[:, None] * basis
        with suppress(np.linalg.LinAlgError):
            yield Modes(basis, np.linalg.inv(basis), np.array(found))


def distance(modes: Modes) -> tuple[FloatArray, float]:
    """Bound ``|I - Y V|``, and its largest row sum."""
    rest = Enclosure.of(np.eye(len(modes.basis))) - Enclosure.of(modes.inverse) @ modes.basis
    error = raised(np.abs(rest.mid) + rest.rad, 1)
    return error, float(raised(error.sum(axis=1), len(error)).max(initial=0.0))


def enclosed_inverse(modes: Modes) -> Enclosure | None:
    """Enclose the inverse of the stored inverse; None where it is not proved to have one."""
    error, norm = distance(modes)
    if not norm < REGULAR:
        return None
    # D (I - D)^-1 is D plus what its row sums bound, norm^2 / (1 - norm), in every entry
    spread = add_up(error, raised(np.full_like(error, 2.0 * norm * norm), 4))
    return Enclosure(modes.basis, product_up(np.abs(modes.basis), spread))


def single(count: int) -> IntArray:
    """Return blocks of one coordinate each, as `blocks_of` does."""
    return np.column_stack([np.arange(count), np.full(count, -1)])


def block_norms(matrix: Enclosure, rows: IntArray, columns: IntArray, room: float) -> FloatArray:
    """Bound the spectral norm of every block, given by pairs of indices, -1 for none."""
    mid, rad = (np.pad(part, ((0, 1), (0, 1))) for part in (matrix.mid, matrix.rad))
    parts = [np.ix_(rows[:, i], columns[:, j]) for i in (0, 1) for j in (0, 1)]
    a, b, c, d = (mid[part] for part in parts)
    # the larger singular value of [a b; c d]
    middle = 0.5 * (np.hypot(a + d, b - c) + np.hypot(a - d, b + c))
    return raised(middle + room * np.sum([rad[part] for part in parts], axis=0), 24)


def contracts(G: FloatArray, decay: float) -> bool:
    """Whether ``G v <= decay v`` holds for a positive v, proved: then G^k fades like decay^k."""
    if not 0.0 < decay < 1.0:
        return False
    try:
        v = np.asarray(np.linalg.solve(decay * np.eye(len(G)) - G, np.ones(len(G))), dtype=float)
    except np.linalg.LinAlgError:
        return False
    usable = np.all(np.isfinite(v)) and np.all(v > 0)
    return bool(usable and np.all(product_up(G, v) <= lowered(decay * v, 1)))


def settling(fading: Fading, mu: FloatArray, room: FloatArray) -> int:
    """Return after how many samples what mu adds is within some room, by doubling."""
    powers = [fading.G]
    while np.any(fading.reach @ (powers[-1] @ mu) > room) and len(powers) < 40:
        powers.append(powers[-1] @ powers[-1])
    count = 1
    for j, power in reversed(list(enumerate(powers))):
        if np.any(fading.reach @ (power @ mu) > room):
            mu, count = power @ mu, count + 2**j
    return count


def fade(system: ErrorSystem, b: FloatArray, widest: FloatArray) -> Fading:
    """Choose the recursion that settles first from ``|e_p| <= widest``, shapes (N,)."""
    room, found = SETTLED * b[system.size :], []
    for modes in bases(system.moving.mid):
        needed = recursion(system, modes, ROOM)
        if needed is None or not all(np.all(np.isfinite(matrix)) for matrix in needed):
            continue
        G, reach, start = (matrix * SLACK for matrix in needed)
        decay = proved_decay(G)
        if decay < 1.0:
            fading = Fading(G, reach, start, decay, modes)
            found.append((settling(fading, start @ widest, room), fading))
    if found:
        return min(found, key=lambda pair: pair[0])[1]
    G, reach, start = _best_exponential(system)
    return Fading(G, reach, start * SLACK, proved_decay(G), None)


def _best_exponential(system: ErrorSystem) -> Recursion:
    slow = spectral_radius(system.closed.mid)
    tried = []
    for share in DECAYS:
        with suppress(InfeasibleDesign):
            decay = float(np.format_float_positional(slow + share * (1.0 - slow), precision=7))
            found = exponential(system, decay)
            tried.append((float(found[2].sum()) / -np.log(decay), found))
    if not tried:
        raise InfeasibleDesign(
            "peak bounds: no decay of the first error can be proved",
            ["the small-gain condition holds with next to no margin; use a smaller domain"],
        )
    return min(tried, key=lambda pair: pair[0])[1]


def exponential(system: ErrorSystem, decay: float) -> Recursion:
    """Return G, R and S of the exponential with a given decay, S rounded up."""
    if not 0.0 < decay < 1.0:
        raise InfeasibleDesign(f"peak bounds: a decay of {decay:.6g} is none below 1")
    N, closed, h, F = system.size, system.closed, system.of_h, system.of_F
    rad = raised((closed.rad + 2.0 * UNIT_ROUNDOFF * np.abs(closed.mid)) / decay, 4)
    powers = power_sum(Enclosure(closed.mid / decay, rad))
    eye = Enclosure.of(np.eye(N))
    parts = [system.B_y, Enclosure.of(F.columns), eye]
    B = Enclosure(np.hstack([p.mid for p in parts]), np.hstack([p.rad for p in parts]))
    # an input of e_p arrives one step later, which 1 / decay stands for
    S = raised(response(powers, system.seen, system.T @ B).total / decay, 1)
    at = np.cumsum([0, len(h.radii), len(F.radii), N])
    S_h, S_F, U = (S[:, a:b] for a, b in pairwise(at.tolist()))
    Z, R_h, R_F = np.abs(system.Z), system.rest[N:, :N], system.rest[:N, :N]
    drawn_h = add_up(
        product_up(S_h, h.coupling(N)),
        product_up(U, product_up(magnitude(system.back), R_h)),
    )
    own = add_up(product_up(product_up(Z, np.abs(h.columns)), h.coupling(N)), product_up(Z, R_h))
    drawn_h[N:] = add_up(drawn_h[N:], own)
    gain = np.hstack([drawn_h, add_up(product_up(S_F, F.coupling(N)), product_up(U, R_F))])
    if not spectral_radius(gain) < 1.0:
        raise InfeasibleDesign(f"peak bounds: no decay of {decay:.6g} can be guaranteed")
    # responses without feedback
    first = response(powers, system.seen, system.T)
    free = add_up(first.terms.max(axis=0), first.spread)
    columns = [small_gain_solution(gain, free[:, j])[N:] for j in range(N)]
    unit = np.eye(N)
    return decay * unit, unit, np.column_stack(columns)


def recursion(system: ErrorSystem, modes: Modes, room: float = 1.0) -> Recursion | None:
    """Return G, R_c and S for a basis, rounded up, radii times room; None where Y is singular."""
    inverse = enclosed_inverse(modes)
    if inverse is None:
        return None
    norms, N, blocks = partial(block_norms, room=room), system.size, blocks_of(modes)
    h, F, Y = system.of_h, system.of_F, Enclosure.of(modes.inverse)
    Z, R_h, R_F = np.abs(system.Z), system.rest[N:, :N], system.rest[:N, :N]
    each = single(N)
    reach_q = norms(system.T @ inverse, each, blocks)
    seen_h = product_up(h.coupling(N), reach_q)
    left_h = product_up(R_h, reach_q)
    reach = add_up(
        norms(system.M @ inverse, each, blocks),
        product_up(product_up(Z, np.abs(h.columns)), seen_h),
        product_up(Z, left_h),
    )
    seen_F = product_up(F.coupling(N), reach)
    size = norms(Y, blocks, each)
    G = add_up(
        norms(Y @ system.moving @ inverse, blocks, blocks),
        product_up(norms(Y @ system.B_y, blocks, single(len(h.radii))), seen_h),
        product_up(norms(Y @ F.columns, blocks, single(len(F.radii))), seen_F),
        product_up(size, product_up(R_F, reach)),
        product_up(size, product_up(magnitude(system.back), left_h)),
    )
    return G, reach, size


def prove_fading(system: ErrorSystem, fading: Fading) -> Iterator[Claim]:
    """Prove the stored recursion from the stored gains and family."""
    modes, decay = fading.modes, fading.decay
    if modes is not None:
        room = REGULAR - distance(modes)[1]
        yield Claim(
            "basis",
            "inverse times basis encloses the identity, so that the first error has coordinates",
            bool(room > 0.0),
            room,
            "products enclosed, largest row sum",
        )
    proof = "coordinates of the error system enclosed, all numbers rounded up"
    needed: tuple[FloatArray, ...] | None
    try:
        if modes is None:
            proof = "powers of the error system divided by those of the decay, rounded up"
            needed = exponential(system, float(fading.G[0, 0]))
        else:
            needed = recursion(system, modes)
    except InfeasibleDesign as error:
        needed, proof = None, str(error)
    stored = (fading.G, fading.reach, fading.start)
    margins = [
        np.min((have - least) / np.maximum(least, TINY))
        for have, least in zip(stored, needed or (), strict=False)
    ]
    margin = float(min(margins, default=-np.inf))
    yield Claim(
        "transient",
        "G, reach and start bound what the first error adds, at every k",
        bool(margin >= 0.0),
        margin,
        proof,
    )
    holds = contracts(fading.G, decay)
    yield Claim(
        "decay",
        f"what the first error adds to the bounds decays with {decay:.7g} per sample",
        holds,
        1.0 - decay if holds else -np.inf,
        "G v <= decay v for a positive v, rounded up",
    )
