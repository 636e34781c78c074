"""Modal coordinates in which the first error fades, and whether a recursion does.

Y is the stored inverse of a stored basis V, and its own inverse is enclosed: with
``|I - Y V| <= D``, ``Y^-1 = V (Y V)^-1`` lies within ``|V| D (I - D)^-1`` of V. Blocks are columns
of one or two coordinates (two for a complex pair); the norm of a block is its spectral norm.
"""

from collections.abc import Iterator
from contextlib import suppress

import numpy as np
from scipy.linalg import matrix_balance, schur

from obsynth.derive.rigour import Enclosure, add_up, lowered, product_up, raised
from obsynth.designs.general.peak import spectral_radius
from obsynth.designs.general.record import Fading, Modes
from obsynth.symbolic.arrays import FloatArray, IntArray

# Between the spectral radius of G and 1: the decay that is stored and proved.
SHARES = (1e-6, 1e-3, 0.1)
# Row sums of I - Y V below it: Y is regular.
REGULAR = 0.5


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
