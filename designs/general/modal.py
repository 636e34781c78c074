"""Modal coordinates in which the first error fades, and the proof that a stored recursion does.

Y is the stored inverse of a stored basis V, and its own inverse is enclosed: with
``|I - Y V| <= D``, ``Y^-1 = V (Y V)^-1`` lies within ``|V| D (I - D)^-1`` of V. Blocks are columns
of one or two coordinates (two for a complex pair); the norm of a block is its spectral norm.
"""

from collections.abc import Callable, Iterator
from contextlib import suppress

import numpy as np
from scipy.linalg import matrix_balance, schur

from obsynth.derive.rigour import TINY, Enclosure, add_up, lowered, product_up, raised
from obsynth.designs.core.certificate import Claim
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.general.peak import spectral_radius
from obsynth.designs.general.record import Fading, Modes
from obsynth.symbolic.arrays import FloatArray, IntArray

# Room for other orders of summation when the numbers are computed again elsewhere: of the numbers,
# and of the radii where nothing but rounding is left.
SLACK, ROOM = 1.0 + 2.0**-36, 8.0
# Between the spectral radius of G and 1: the decay that is stored and proved.
SHARES = (1e-6, 1e-3, 0.1)
# Row sums of I - Y V below it: Y is regular.
REGULAR = 0.5
# Of the peak bounds: a first error that adds less has settled.
SETTLED = 0.1

Recursion = tuple[FloatArray, FloatArray, FloatArray]
"""G, the reach R to the errors, and the start S: nonnegative matrices, rounded up."""


def choose(
    A: FloatArray,
    recursion: Callable[[Modes, float], Recursion | None],
    steady: FloatArray,
    widest: FloatArray,
) -> Fading | None:
    """Choose the modal recursion that settles first from a first error; None where none contracts.

    A: what moves the error; recursion: of a basis, its radii multiplied by the number given;
    steady: peak bounds of the errors; widest: of the first one
    """
    room, found = SETTLED * steady, []
    for modes in bases(A):
        needed = recursion(modes, ROOM)
        if needed is None or not all(np.all(np.isfinite(matrix)) for matrix in needed):
            continue
        G, reach, start = (matrix * SLACK for matrix in needed)
        decay = proved_decay(G)
        if decay < 1.0:
            fading = Fading(G, reach, start, decay, modes)
            found.append((_settling(fading, start @ widest, room), fading))
    return min(found, key=lambda pair: pair[0])[1] if found else None


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


def _settling(fading: Fading, mu: FloatArray, room: FloatArray) -> int:
    """Return after how many samples what mu adds is within some room, by doubling."""
    powers = [fading.G]
    while np.any(fading.reach @ (powers[-1] @ mu) > room) and len(powers) < 40:
        powers.append(powers[-1] @ powers[-1])
    count = 1
    for j, power in reversed(list(enumerate(powers))):
        if np.any(fading.reach @ (power @ mu) > room):
            mu, count = power @ mu, count + 2**j
    return count


def prove_recursion(
    fading: Fading,
    recursion: Callable[[Modes, float], Recursion | None],
    exponential: Callable[[float], Recursion],
) -> Iterator[Claim]:
    """Prove a stored recursion against what the stored gains and family need."""
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
            needed = exponential(float(fading.G[0, 0]))
        else:
            needed = recursion(modes, 1.0)
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
