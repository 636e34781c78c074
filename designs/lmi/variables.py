"""The unknowns of an LMI: which entries are free and in which order."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import scipy.sparse as sparse
from numpy.typing import ArrayLike, NDArray


class Structure(StrEnum):
    """Pattern of a matrix variable."""

    FULL = "full"
    SYMMETRIC = "symmetric"
    DIAGONAL = "diagonal"
    SCALAR = "scalar"


def upper_triangle(n: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of the upper triangle, stacked by columns."""
    columns, rows = np.tril_indices(n)
    return rows, columns


@dataclass(frozen=True)
class Variable:
    """A matrix variable: a value compared by name, shape and structure.

    name: name under which the solution returns it
    shape: rows and columns
    structure: which entries are free
    """

    name: str
    shape: tuple[int, int]
    structure: Structure

    @property
    def size(self) -> int:
        """Number of free entries."""
        return len(self.free_entries[0])

    @property
    def free_entries(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows and columns of the free entries, in the order of the parameter vector."""
        rows, columns = self.shape
        if self.structure is Structure.SYMMETRIC:
            return upper_triangle(rows)
        if self.structure is Structure.DIAGONAL:
            index = np.arange(rows)
            return index, index
        index = np.arange(rows * columns)
        return index % rows, index // rows

    def operator(self) -> sparse.csr_array:
        """Sparse map (rows * columns, size) from the free entries to the column-stacked matrix."""
        rows, columns = self.free_entries
        index = np.arange(len(rows))
        targets = columns * self.shape[0] + rows
        if self.structure is Structure.SYMMETRIC:
            off = rows != columns
            targets = np.concatenate([targets, (rows * self.shape[0] + columns)[off]])
            index = np.concatenate([index, index[off]])
        entries = self.shape[0] * self.shape[1]
        return sparse.csr_array((np.ones(len(index)), (targets, index)), shape=(entries, len(rows)))

    def unpack(self, entries: ArrayLike) -> NDArray[np.float64]:
        """Matrix with the given free entries."""
        stacked = self.operator() @ np.asarray(entries, dtype=float)
        matrix: NDArray[np.float64] = stacked.reshape(self.shape, order="F")
        return matrix

    def pack(self, matrix: ArrayLike) -> NDArray[np.float64]:
        """Free entries of a matrix of this variable's shape."""
        values = np.asarray(matrix, dtype=float).reshape(self.shape)
        return values[self.free_entries]
