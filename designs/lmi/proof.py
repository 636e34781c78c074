"""Proof of a matrix inequality at every vertex, for the numbers as they are stored."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from obsynth.derive.rigour import (
    Enclosure,
    ExactMatrix,
    is_positive_definite,
    prove_positive_definite,
)
from obsynth.designs.core.errors import CertificateError
from obsynth.designs.lmi.expression import IntArray

# Entries of the blocks formed at a time, so that the work arrays stay in the cache.
_CHUNK_ENTRIES = 2**16

# The margin of this many vertices tells what to expect of all.
_SAMPLE = 256


@dataclass(frozen=True)
class FamilyProof:
    """What was proved of a matrix inequality at its vertices.

    name: name of the inequality
    count: number of vertices
    failed: vertices without proof (at most ten are listed)
    margin: guaranteed lower bound of the smallest eigenvalue over all vertices; -inf if one failed
    worst: vertices with the smallest margins, worst first
    exact: those of them confirmed in exact rational arithmetic
    """

    name: str
    count: int
    failed: tuple[int, ...]
    margin: float
    worst: tuple[int, ...]
    exact: tuple[int, ...] = ()

    @property
    def all_proved(self) -> bool:
        """Whether the inequality is proved at every vertex."""
        return not self.failed

    def __str__(self) -> str:
        if not self.all_proved:
            listed = ", ".join(map(str, self.failed))
            return f"{self.name}: NOT proved at vertices {listed} of {self.count}"
        text = f"{self.name}: proved at {self.count} vertices, margin {self.margin:.3g}"
        return text + (f", {len(self.exact)} of them exactly" if self.exact else "")

    def require(self) -> FamilyProof:
        """Return the proof, or raise ``CertificateError`` if a vertex has none."""
        if not self.all_proved:
            raise CertificateError(
                str(self),
                ["the stored numbers do not satisfy it with a margin that rounding leaves"],
                failed=self.failed,
                proof=self,
            )
        return self


def prove_family(
    name: str,
    count: int,
    enclosed: Callable[[IntArray], Enclosure],
    exact: Callable[[int], ExactMatrix] | None = None,
    exact_count: int = 3,
) -> FamilyProof:
    """Prove that the matrices at all vertices are positive definite."""
    size = enclosed(np.zeros(1, dtype=np.intp)).shape[-1]
    step = max(1, _CHUNK_ENTRIES // (size * size))
    sample = np.unique(np.linspace(0, count - 1, min(count, _SAMPLE)).astype(np.intp))
    expected = prove_positive_definite(enclosed(sample))
    failed = sample[~expected.proved]
    # All others are asked for the margin of the sample; the few below it are looked at singly.
    floor = float(expected.margin.min()) if len(failed) == 0 else 0.0
    low, margins = [sample], [expected.margin]
    if len(sample) < count:
        for start in range(0, count, step):
            part = np.arange(start, min(start + step, count))
            result = prove_positive_definite(enclosed(part), floor=floor, sharp=False)
            below = part[~result.proved]
            if len(below):
                low.append(below)
                margins.append(prove_positive_definite(enclosed(below)).margin)
    vertices, margin = np.concatenate(low), np.concatenate(margins)
    vertices, first = np.unique(vertices, return_index=True)
    margin = margin[first]
    failed = vertices[~(margin > 0)]
    order = np.argsort(margin, kind="stable")
    worst = [int(k) for k in vertices[order[: max(exact_count, 1)]]]
    confirmed = []
    if exact is not None and not len(failed):
        for vertex in worst:
            if not is_positive_definite(exact(vertex)):
                failed = np.append(failed, vertex)
            else:
                confirmed.append(vertex)
    return FamilyProof(
        name=name,
        count=count,
        failed=tuple(int(k) for k in failed[:10]),
        margin=float(min(margin.min(), np.inf)) if not len(failed) else -np.inf,
        worst=tuple(worst),
        exact=tuple(confirmed),
    )
