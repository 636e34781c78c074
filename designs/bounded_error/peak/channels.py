"""Rank-one channels of an affine family of Jacobians."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from obsynth.derive.rigour import ExactMatrix
from obsynth.symbolic.arrays import FloatArray

IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Channels:
    """Rank-one uncertainties ``delta_j b_j c_j'``, ``|delta_j| <= r_j``, of the Jacobian.

    columns: the b_j
    rows: the c_j'
    radii: the r_j, rounded up
    source: which direction of the affine family a channel comes from. A direction that is not of
        rank one makes one channel for each of its columns
    """

    columns: FloatArray
    rows: FloatArray
    radii: FloatArray
    source: IntArray

    def __len__(self) -> int:
        return int(self.radii.size)


def split_channels(directions: FloatArray, ranges: FloatArray, middle: FloatArray) -> Channels:
    """Turn the directions of an affine family into rank-one channels, without rounding."""
    n = directions.shape[-1]
    columns, rows, radii, source = [], [], [], []
    half = np.maximum(ranges[:, 1] - middle, middle - ranges[:, 0])
    for k, direction in enumerate(directions):
        if ranges[k, 0] == ranges[k, 1] or not np.any(direction):
            continue
        for column, row in _rank_one_parts(direction):
            columns.append(column)
            rows.append(row)
            radii.append(np.nextafter(half[k], np.inf))
            source.append(k)
    return Channels(
        columns=np.array(columns).reshape(-1, n).T,
        rows=np.array(rows).reshape(-1, n),
        radii=np.array(radii),
        source=np.array(source, dtype=np.int64),
    )


def _rank_one_parts(direction: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Split a matrix into b c' without rounding: one part where that is exact, else columns."""
    i, j = np.unravel_index(np.argmax(np.abs(direction)), direction.shape)
    column, row, pivot = direction[:, j], direction[i], direction[i, j]
    given = ExactMatrix.of(direction).to_fractions()
    for left, right in ((column, row / pivot), (column / pivot, row)):
        product = ExactMatrix.of(left[:, None]) @ ExactMatrix.of(right[None, :])
        if product.to_fractions() == given:
            return [(left, right)]
    eye = np.eye(direction.shape[1])
    return [(direction[:, k], eye[k]) for k in np.flatnonzero(np.any(direction, axis=0))]
