"""Sums of absolute impulse responses, and the peak (l1) bounds of every error that they give.

docs/methods/general_class.md, Peak bounds, in the letters used here: X_k, S and R of the sums, and
``n + G b <= b``, n from disturbances, rounding and the channels that disturbances drive, G from
those that errors drive. All is rounded up, but for `absolute_sums`, which a search uses.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import matrix_balance

from obsynth.derive.rigour import TINY, Enclosure, add_up, gamma_bound, lowered, product_up, raised
from obsynth.designs.core.certificate import Claim
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.general.system import ErrorSystem, Extra, magnitude
from obsynth.symbolic.arrays import FloatArray

# A quarter of a gigabyte of powers.
MAX_NUMBERS = 2**25
CHECK_EVERY = 64
SMALL = 2.0**-60
# Room that the certificate leaves for other orders of summation on other machines.
SLACK = 2.0**-40


@dataclass(frozen=True, eq=False)
class AbsoluteSums:
    """``sum_k |Q A^k B|``, every response (left, n_o, right, n_i), and factors of doublings."""

    total: FloatArray
    squares: list[FloatArray]
    left: list[FloatArray]
    right: list[FloatArray]
    responses: FloatArray

    def derivative(self, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the derivative of ``sum(weights * total)`` with respect to A and B."""
        size = self.squares[0].shape[0]
        n_o, n_i = weights.shape
        signs = np.sign(self.responses)
        signs *= weights[None, :, None, :]
        left, right = self.left[-1], self.right[-1]
        flat = signs.reshape(len(left) * n_o, len(right) * n_i)
        columns = right.transpose(1, 0, 2).reshape(size, -1)
        left_bar = (flat @ columns.T).reshape(left.shape)
        right_bar = (left.reshape(-1, size).T @ flat).reshape(size, len(right), n_i)
        right_bar = right_bar.transpose(1, 0, 2)
        bars = [np.zeros((size, size)) for _ in self.squares]
        first = len(self.left) - 1
        for level in reversed(range(len(self.right) - 1)):
            before, square = self.right[level], self.squares[first + level]
            early, late = right_bar[: len(before)], right_bar[len(before) :]
            bars[first + level] += np.tensordot(late, before, axes=([0, 2], [0, 2]))
            right_bar = early + square.T @ late
        for level in reversed(range(first)):
            before, square = self.left[level], self.squares[level]
            early, late = left_bar[: len(before)], left_bar[len(before) :]
            bars[level] += np.tensordot(before, late, axes=([0, 1], [0, 1]))
            left_bar = early + late @ square.T
        for level in reversed(range(len(self.squares) - 1)):
            square, bar = self.squares[level], bars[level + 1]
            bars[level] += bar @ square.T + square.T @ bar
        return bars[0], right_bar[0]


def absolute_sums(A: FloatArray, B: FloatArray, Q: FloatArray, wanted: float) -> AbsoluteSums:
    """Sum over at least so many steps."""
    doublings = max(int(np.ceil(np.log2(max(wanted, 4.0)))), 2)
    size = len(A)
    squares, left, right = [A], [Q[None]], [B[None]]
    for level in range(doublings):
        square = squares[-1]
        if level < doublings // 2:
            left.append(np.concatenate([left[-1], left[-1] @ square]))
        else:
            right.append(np.concatenate([right[-1], square @ right[-1]]))
        if level < doublings - 1:
            squares.append(square @ square)
    rows, columns = left[-1], right[-1]
    product = rows.reshape(-1, size) @ columns.transpose(1, 0, 2).reshape(size, -1)
    responses = product.reshape(len(rows), len(Q), len(columns), B.shape[1])
    return AbsoluteSums(np.abs(responses).sum(axis=(0, 2)), squares, left, right, responses)


@dataclass(frozen=True, eq=False)
class PowerSum:
    """Powers of an enclosed Schur matrix with bounds of their sum and of their errors.

    powers, total, error: X_k, S and a bound of ``|A^k - X_k|`` as above
    bound: at least ``sum_k |A^k|`` for every A of the enclosure
    contraction: at least the largest row sum of R
    """

    powers: FloatArray
    total: FloatArray
    bound: FloatArray
    error: FloatArray
    contraction: float

    @property
    def steps(self) -> int:
        """Number of powers before truncation."""
        return int(self.powers.shape[0])


@dataclass(frozen=True, eq=False)
class Response:
    """Bounds ``|Q A^k B| <= terms[k] + spread``, terms zero beyond the last, and their total."""

    terms: FloatArray
    spread: FloatArray
    total: FloatArray


def power_sum(A: Enclosure) -> PowerSum:
    """Bound the sum of the absolute powers of a matrix, or refuse."""
    size = A.mid.shape[0]
    spectral_radius = float(np.max(np.abs(np.linalg.eigvals(A.mid)), initial=0.0))
    if not spectral_radius < 1.0:
        raise InfeasibleDesign(
            f"peak bounds: the error system is not stable, spectral radius {spectral_radius:.6g}",
            ["use other gains, for example those of a design by LMIs"],
            spectral_radius=spectral_radius,
        )
    # powers of two, so exact: mixed units must not spoil the norm of the remainder
    _, (scale, _) = matrix_balance(A.mid, permute=False, separate=True)
    ratio = scale[:, None] / scale
    mid, rad = A.mid / ratio, A.rad / ratio
    most = max(MAX_NUMBERS // size**2, 2)
    powers = _powers(mid, most)
    sizes = np.abs(powers)
    steps = len(powers)
    total = raised(sizes.sum(axis=0), steps)
    local = raised(gamma_bound(size + 1) * np.abs(mid) + rad, 4)
    residual = add_up(product_up(local, total), product_up(raised(np.abs(mid) + rad, 1), sizes[-1]))
    contraction = float(raised(np.max(residual.sum(axis=1), keepdims=True), size)[0])
    if not contraction < 0.5:
        raise InfeasibleDesign(
            "peak bounds: the impulse responses of the error system decay too slowly to be summed",
            [
                f"spectral radius {spectral_radius:.9g}, {steps} steps leave a remainder of "
                f"{contraction:.3g}, which has to be below one half",
                "use gains with a faster decay",
            ],
            spectral_radius=spectral_radius,
            steps=steps,
            remainder=contraction,
        )
    # (I - R)^-1 <= I + R + R^2 + R^3 + c^4 / (1 - c), the last in every entry
    square = product_up(residual, residual)
    rest = raised(np.full((size, size), contraction**4 / (1.0 - contraction)), 5)
    inverse = add_up(np.eye(size), residual, square, product_up(square, residual), rest)
    bound = product_up(total, inverse)
    return PowerSum(
        powers=powers * ratio,
        total=total * ratio,
        bound=bound * ratio,
        error=product_up(bound, residual) * ratio,
        contraction=contraction,
    )


def _powers(matrix: FloatArray, most: int) -> FloatArray:
    """Return X_0, X_1, ... until they are negligible; one step at a time, so that errors stay."""
    size = matrix.shape[0]
    powers = np.empty((CHECK_EVERY, size, size))
    powers[0] = np.eye(size)
    steps = 1
    while steps < most:
        if steps + CHECK_EVERY > len(powers):
            powers = np.concatenate([powers, np.empty_like(powers)])
        for k in range(steps, steps + CHECK_EVERY):
            np.matmul(matrix, powers[k - 1], out=powers[k])
        steps += CHECK_EVERY
        if np.max(np.abs(powers[steps - 1])) < SMALL:
            break
    return powers[:steps]


def response(powers: PowerSum, outputs: FloatArray | Enclosure, B: Enclosure) -> Response:
    """Bound ``|Q A^k B| <= |Q X_k B| + |Q| |A^k - X_k| |B|``, products and radii included."""
    Q = outputs if isinstance(outputs, Enclosure) else Enclosure.of(outputs)
    size = B.mid.shape[0]
    steps = powers.steps
    terms = np.abs((Q.mid @ powers.powers) @ B.mid)
    weight = raised(gamma_bound(2 * size + 2) * np.abs(B.mid) + B.rad, 4)
    most = raised(np.abs(B.mid) + B.rad, 1)
    inner = add_up(product_up(powers.total, weight), product_up(powers.error, most))
    spread = product_up(np.abs(Q.mid), inner)
    if np.any(Q.rad):
        spread = add_up(spread, product_up(Q.rad, product_up(powers.bound, most)))
    return Response(
        terms=terms, spread=spread, total=add_up(raised(terms.sum(axis=0), steps), spread)
    )


@dataclass(frozen=True, eq=False)
class Sums:
    """``n + G b`` of the bounds, and the powers that they come from. Shapes (2 N,), (2 N, 2 N)."""

    n: FloatArray
    G: FloatArray
    powers: PowerSum


def error_sums(system: ErrorSystem, extra: Extra) -> Sums:
    """Add up the responses, rounded up."""
    N, n_v = system.size, len(system.v_radius)
    h, F = system.of_h, system.of_F
    eye = Enclosure.of(np.eye(N))
    parts = [system.B_v, system.B_y, Enclosure.of(F.columns), eye]
    B = Enclosure(np.hstack([p.mid for p in parts]), np.hstack([p.rad for p in parts]))
    powers = power_sum(system.closed)
    S = response(powers, system.seen, system.T @ B).total
    at = np.cumsum([0, n_v, len(h.radii), len(F.radii), N])
    S_v, S_h, S_F, U = (S[:, a:b] for a, b in pairwise(at.tolist()))
    Z = np.abs(system.Z)
    S_v = add_up(S_v, np.vstack([magnitude(system.through), magnitude(system.direct)]))
    own = np.vstack([np.zeros((N, len(h.radii))), product_up(Z, np.abs(h.columns))])
    S_h = add_up(S_h, own)
    R_F, R_h = system.rest[:N], system.rest[N:]
    v_F, v_h = (product_up(R[:, N:], system.v_radius) for R in (R_F, R_h))
    back = magnitude(system.back)
    at_once = np.concatenate([extra.q, add_up(extra.c, product_up(Z, v_h))])
    n = add_up(
        product_up(S_v, system.v_radius),
        product_up(S_h, h.sizes(N, system.v_radius)),
        product_up(S_F, F.sizes(N, system.v_radius)),
        product_up(U, add_up(extra.p, v_F, product_up(back, v_h))),
        at_once,
    )
    drawn_h = add_up(product_up(S_h, h.coupling(N)), product_up(U, product_up(back, R_h[:, :N])))
    drawn_h[N:] = add_up(drawn_h[N:], product_up(Z, R_h[:, :N]))
    drawn_F = add_up(product_up(S_F, F.coupling(N)), product_up(U, R_F[:, :N]))
    return Sums(n, np.hstack([drawn_h, drawn_F]), powers)


def spectral_radius(matrix: FloatArray) -> float:
    """Return the largest absolute eigenvalue as computed."""
    return float(np.max(np.abs(np.linalg.eigvals(matrix)), initial=0.0))


def small_gain_solution(G: FloatArray, n: FloatArray) -> FloatArray:
    """Return a b, barely above ``(I - G)^-1 n``, with ``n + G b <= b`` in rounded-up numbers."""
    eye = np.eye(len(n))
    b = np.maximum(np.linalg.solve(eye - G, n), n)
    b = np.maximum(np.linalg.solve(eye - G, n + SLACK * b + 64.0 * TINY), n)
    for _ in range(100):
        image = add_up(n, product_up(G, b))
        if np.all(image <= b) and np.all(np.isfinite(b)):
            return b
        b = np.maximum(b, image * (1.0 + 2.0**-45))
    raise InfeasibleDesign(
        "peak bounds: the small-gain condition holds without a margin that doubles can prove",
        ["use other gains, or a smaller domain"],
        rho=spectral_radius(G),
        G=G,
    )


def contraction(G: FloatArray, b: FloatArray) -> float:
    """Bound the spectral radius of G by max (G v)_i / v_i over the errors that feed back."""
    coupled = np.flatnonzero(np.any(G, axis=0))
    if coupled.size == 0:
        return 0.0
    inner, scale = G[np.ix_(coupled, coupled)], np.maximum(b[coupled], 64.0 * TINY)
    v = np.linalg.solve(np.eye(coupled.size) - inner, scale)
    v = np.maximum(v, 2.0**-500 * np.max(np.abs(v)))
    return float(np.max(raised(product_up(inner, v) / v, 1)))


def prove_peak(sums: Sums, b: FloatArray, names: tuple[str, ...]) -> Iterator[Claim]:
    """Prove that a given b bounds the errors, whatever it came from; names of the N errors."""
    image = add_up(sums.n, product_up(sums.G, b))
    held = image <= b
    room = np.where(held, lowered(np.maximum(b - image, 0.0), 2), -np.inf)
    lost = dict.fromkeys(names[k % len(names)] for k in np.flatnonzero(~held))
    yield Claim(
        "peak",
        "n + G b <= b: the stored b bounds every error at every k",
        bool(np.all(held)),
        float((room / np.maximum(b, 1e-300)).min()),
        f"sums of {sums.powers.steps} powers with an enclosed remainder of "
        f"{sums.powers.contraction:.1e}, all numbers rounded up"
        + (f"; too small for {', '.join(lost)}" if lost else ""),
    )
    gain = contraction(sums.G, b)
    yield Claim(
        "small_gain",
        "the spectral radius of G is below 1",
        gain < 1.0,
        1.0 - gain,
        "max (G v)_i / v_i for a positive v, rounded up",
    )
