"""A matrix inequality at every vertex, formed for some vertices at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from obsynth.derive.rigour.definite import prove_positive_definite
from obsynth.designs.lmi.expression import Affine
from obsynth.designs.lmi.problem import Block

IntArray = NDArray[np.intp]

# Entries of the matrices formed at a time.
_CHUNK_ENTRIES = 2**21

# Eigenvalues are computed for no more than so many failing vertices of a family.
_EXAMINED = 2048


# Name under which a margin is handed to a tightened formula.
_MARGIN = "taken_margin"


@dataclass(frozen=True, eq=False)
class Violations:
    """Vertices of a family where a matrix is not positive definite enough.

    vertices: worst first
    eigenvalues: smallest eigenvalue at each of them
    directions: eigenvectors to these
    """

    vertices: IntArray
    eigenvalues: NDArray[np.float64]
    directions: NDArray[np.float64]

    def spread(self, count: int, alike: float = 0.9) -> IntArray:
        """Pick the worst vertices whose eigenvectors differ; the worst is always among them."""
        picked: list[int] = []
        for k in range(len(self.vertices)):
            overlap = np.abs(self.directions[picked] @ self.directions[k])
            if not len(overlap) or overlap.max() < alike:
                picked.append(k)
            if len(picked) == count:
                break
        return self.vertices[picked]


@dataclass(frozen=True, eq=False)
class Family:
    """A symmetric matrix per vertex that has to be positive definite.

    name: name of the block in problems and messages
    count: number of vertices
    formula: ``formula(vertices, **unknowns)`` with an integer array: the matrices at these
        vertices, in the arithmetic of the unknowns
    unknowns: the expressions to insert when the solver asks
    strict: whether the margin of a design is asked of it
    """

    name: str
    count: int
    formula: Callable[..., Any]
    unknowns: Mapping[str, Affine] = field(default_factory=dict)
    strict: bool = True

    @classmethod
    def of_block(cls, block: Block) -> Family:
        """Take the vertices of an assembled block."""
        expression = block.expression

        def formula(vertices: IntArray, **values: Any) -> Any:
            part = expression.member(vertices)
            inserted = any(not isinstance(value, Affine) for value in values.values())
            return part.value(values) if inserted else part

        unknowns = {v.name: Affine.of_variable(v) for v in expression.terms}
        return cls(block.name, expression.members or 1, formula, unknowns, block.strict)

    def tightened(self, margin: Affine | float) -> Family:
        """Take ``margin`` times the identity from every matrix, as :meth:`Problem.tightened`."""
        if not self.strict:
            return self

        def formula(vertices: IntArray, **values: Any) -> Any:
            taken = values.pop(_MARGIN, margin)
            matrices = self.formula(vertices, **values)
            return matrices - taken * np.eye(matrices.shape[-1])

        unknowns = dict(self.unknowns)
        if isinstance(margin, Affine):
            unknowns[_MARGIN] = margin
        return replace(self, formula=formula, unknowns=unknowns)

    def expression(self, vertices: ArrayLike) -> Affine:
        """Matrices at some vertices for the solver."""
        matrices: Affine = self.formula(np.asarray(vertices, dtype=np.intp), **self.unknowns)
        return matrices

    def value(self, vertices: ArrayLike, values: Mapping[str, ArrayLike]) -> Any:
        """Matrices at some vertices for values of the variables, as floats."""
        inserted = {name: unknown.value(values) for name, unknown in self.unknowns.items()}
        return self.formula(np.asarray(vertices, dtype=np.intp), **inserted)

    def chunks(self, size: int) -> Iterator[IntArray]:
        """All vertices, so many at a time that n x n matrices fit the memory."""
        step = max(1, _CHUNK_ENTRIES // (size * size))
        for start in range(0, self.count, step):
            yield np.arange(start, min(start + step, self.count))

    def violations(
        self,
        values: Mapping[str, ArrayLike],
        floor: float = 0.0,
        among: IntArray | None = None,
    ) -> Violations:
        """Vertices where the smallest eigenvalue is not above a floor."""
        first = self.value([0], values)
        size = first.shape[-1]
        lift = floor * np.eye(size)
        parts = self.chunks(size) if among is None else iter((among,))
        failing = [
            part[~prove_positive_definite(self.value(part, values) - lift, sharp=False).proved]
            for part in parts
        ]
        vertices = np.concatenate(failing) if failing else np.zeros(0, dtype=np.intp)
        if len(vertices) > _EXAMINED:
            vertices = np.random.default_rng(0).choice(vertices, _EXAMINED, replace=False)
        if not len(vertices):
            return Violations(vertices, np.zeros(0), np.zeros((0, size)))
        eigenvalues, vectors = np.linalg.eigh(self.value(vertices, values))
        order = np.argsort(eigenvalues[:, 0], kind="stable")
        return Violations(vertices[order], eigenvalues[order, 0], vectors[order, :, 0])
