"""Block matrices in any of the three arithmetics: expressions, enclosures, exact rationals.

A formula written with ``block``, ``+ - @ *`` and ``.T`` says its LMI once: given variables it
is the constraint the solver sees, given enclosures it is what gets proved, given exact
matrices it is the independent check.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from obsynth.derive.rigour import Enclosure, ExactMatrix
from obsynth.designs.lmi.expression import Affine, ExpressionError, constant, is_zero


def block(rows: Sequence[Sequence[Any]]) -> Any:
    """Matrix of blocks."""
    grid = [[None if is_zero(cell) else _as_cell(cell) for cell in row] for row in rows]
    if len({len(row) for row in grid}) != 1:
        raise ExpressionError(f"rows of {[len(row) for row in grid]} blocks")
    heights = [_size(row, 0, f"row {i}") for i, row in enumerate(grid)]
    widths = [_size(column, 1, f"column {j}") for j, column in enumerate(zip(*grid, strict=True))]
    kinds = {type(cell) for row in grid for cell in row} - {type(None), np.ndarray}
    if len(kinds) > 1:
        names = sorted(kind.__name__ for kind in kinds)
        raise ExpressionError(f"blocks of different arithmetics: {', '.join(names)}", kinds=names)
    filled = [
        [np.zeros((heights[i], widths[j])) if cell is None else cell for j, cell in enumerate(row)]
        for i, row in enumerate(grid)
    ]
    kind = kinds.pop() if kinds else np.ndarray
    if kind is Affine:
        return _affine_block(filled)
    if kind is Enclosure:
        lifted = [[Enclosure.of(cell) for cell in row] for row in filled]
        return Enclosure(
            _dense_block([[cell.mid for cell in row] for row in lifted]),
            _radius_block([[cell.rad for cell in row] for row in lifted]),
        )
    if kind is ExactMatrix:
        return ExactMatrix.from_blocks([[ExactMatrix.of(cell) for cell in row] for row in filled])
    return _dense_block(filled)


def symmetric_block(rows: Sequence[Sequence[Any]]) -> Any:
    """Symmetric block matrix from its lower triangle: row i holds the blocks 0 to i."""
    for i, row in enumerate(rows):
        if len(row) != i + 1:
            raise ExpressionError(
                f"row {i} of a lower triangle has {i + 1} blocks, this one has {len(row)}"
            )
    n = len(rows)
    return block(
        [[rows[i][j] if j <= i else _transpose(rows[j][i]) for j in range(n)] for i in range(n)]
    )


def he(matrix: Any) -> Any:
    """X + X' of a square matrix in any arithmetic."""
    return matrix + _transpose(matrix)


def _transpose(cell: Any) -> Any:
    if is_zero(cell):
        return 0
    return np.swapaxes(cell, -1, -2) if isinstance(cell, np.ndarray) else cell.T


def _as_cell(cell: Any) -> Any:
    if isinstance(cell, (Affine, Enclosure, ExactMatrix)):
        return cell
    array = np.asarray(cell, dtype=float)
    if array.ndim in (2, 3):
        return array
    if array.size == 1:
        return array.reshape(1, 1)
    raise ExpressionError(
        f"a block of shape {array.shape}: blocks are matrices (r, c), families (N, r, c) or 0",
        shape=array.shape,
    )


def _size(cells: Sequence[Any], axis: int, where: str) -> int:
    sizes = {cell.shape[axis - 2] for cell in cells if cell is not None}
    if len(sizes) != 1:
        raise ExpressionError(
            f"{where} of the block matrix has blocks of sizes {sorted(sizes)}"
            if sizes
            else f"{where} of the block matrix has only zeros, its size is unknown"
        )
    return int(sizes.pop())


def _dense_block(cells: Sequence[Sequence[Any]]) -> Any:
    members = np.broadcast_shapes(*(cell.shape[:-2] for row in cells for cell in row))
    return np.block(
        [[np.broadcast_to(cell, members + cell.shape[-2:]) for cell in row] for row in cells]
    )


def _radius_block(cells: Sequence[Sequence[Any]]) -> Any:
    """Block of radii; one that is common to all vertices stays a view."""
    members = np.broadcast_shapes(*(cell.shape[:-2] for row in cells for cell in row))
    common = [[_common(cell) for cell in row] for row in cells]
    small = _dense_block(common)
    return np.broadcast_to(small, members + small.shape[-2:])


def _common(radius: Any) -> Any:
    return radius[0] if radius.ndim == 3 and radius.strides[0] == 0 else radius


def _affine_block(cells: Sequence[Sequence[Any]]) -> Affine:
    lifted = [[constant(cell) for cell in row] for row in cells]
    members = np.broadcast_shapes(*(cell.constant.shape[:-2] for row in lifted for cell in row))
    offset = 0
    numbers: list[list[Any]] = []
    flat: list[Affine] = []
    for row in lifted:
        numbers.append([])
        for cell in row:
            wide = cell._broadcast(members + cell.shape)
            numbers[-1].append(wide._numbers() + offset)
            flat.append(wide)
            offset += wide.constant.size
    return Affine.stacked(flat)._take(np.block(numbers))
