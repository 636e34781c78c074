"""Sums of absolute impulse responses and their derivative, fast but without guarantee.

A^(j + m i) B is (A^j) (A^(m i) B): the left factors Q A^j and the right factors A^(m i) B are
made by doubling, and one product gives all responses. The derivative goes the same way
backwards, so it costs about as much as two evaluations, whatever the number of gains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
