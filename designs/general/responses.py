"""Guaranteed sums of absolute impulse responses, truncation and rounding included.

Let A be known up to an entrywise radius, and X_0 = I, X_{k+1} = fl(A X_k),
X_k = 0 for k >= N. With the local errors D_k = X_{k+1} - A X_k one has
A^k = X_k - sum_{j<k} A^{k-1-j} D_j, hence with R >= sum_k |D_k|

    sum_k |A^k| <= S + (sum_k |A^k|) R,      S = sum_k |X_k| ,

for the partial sums first, which therefore stay bounded by S (I - R)^-1 as soon
as the norm of R is below one: the sums converge, and A is Schur. Every single
power satisfies |A^k - X_k| <= S (I - R)^-1 R.

Sums of absolute impulse responses and their derivative, fast but without guarantee.

A^(j + m i) B is (A^j) (A^(m i) B): the left factors Q A^j and the right factors A^(m i) B are
made by doubling, and one product gives all responses. The derivative goes the same way
backwards, so it costs about as much as two evaluations, whatever the number of gains.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import matrix_balance

from obsynth.derive.rigour import Enclosure, add_up, gamma_bound, product_up, raised
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.symbolic.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class AbsoluteSums:
    """``sum_k |Q A^k B|`` over a number of steps, with what its derivative needs.

    squares: A, A^2, A^4,
    left, right: the factors after every doubling
    responses: every ``Q A^k B``, as (left steps, n_o, right steps, n_i)
    """

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


# A quarter of a gigabyte of powers.
MAX_NUMBERS = 2**25
CHECK_EVERY = 64
SMALL = 2.0**-60


@dataclass(frozen=True, eq=False)
class PowerSum:
    """Powers of an enclosed Schur matrix with bounds of their sum and of their errors.

    powers: X_k, the computed powers; zero is meant beyond the last
    total: S, at least the sum of all ``|X_k|``
    bound: at least ``sum_k |A^k|`` for every A of the enclosure
    error: at least ``|A^k - X_k|`` for every k >= 0 and every such A
    contraction: at least the largest row sum of R; below one, which proves that the matrix is Schur
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
    """Absolute impulse responses ``|Q A^k B|`` of every output to every input.

    terms: computed ``|Q X_k B|``
    spread: ``|Q A^k B| <= terms[k] + spread`` for every k >= 0, with zero for the terms beyond the
        last
    total: at least ``sum_k |Q A^k B|``
    """

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
    """Bound the responses of some outputs to some inputs.

    ``|Q A^k B| <= |Q X_k B| + |Q| |A^k - X_k| |B|``; the rounding of the two
    products and the radii of B and Q are bounded in the same way.
    """
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
