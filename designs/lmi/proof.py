"""Why yes and why no: proofs at every vertex; blocks that bind, and a bound on the margin.

Any matrices Z_i >= 0 bound the margin by t <= (c0 + r'x) / sum tr Z_i (docs/proofs.md, Matrix
inequalities); a solver's dual solution makes it sharp, with r of the size of its accuracy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.derive.rigour import (
    Enclosure,
    ExactMatrix,
    ProofResult,
    is_positive_definite,
    prove_positive_definite,
)
from obsynth.designs.lmi.conic import Solution
from obsynth.designs.lmi.expression import Affine, IntArray
from obsynth.designs.lmi.problem import Problem, symmetric_block
from obsynth.symbolic.arrays import FloatArray

# Entries of the blocks formed at a time, so that the work arrays stay in the cache.
_CHUNK_ENTRIES = 2**16

RUMP = "floating-point Cholesky after Rump, formation of the blocks enclosed"

# The margin of this many vertices tells what to expect of all.
_SAMPLE = 256


@dataclass(frozen=True)
class FamilyProof:
    """What was proved of a matrix inequality at its vertices.

    failed: vertices without proof (at most ten are listed)
    margin: guaranteed lower bound of the smallest eigenvalue over all vertices; -inf if one failed
    worst: vertices with the smallest margins, worst first
    exact: those of them confirmed in exact rational arithmetic
    """

    failed: tuple[int, ...]
    margin: float
    worst: tuple[int, ...]
    exact: tuple[int, ...] = ()

    @property
    def all_proved(self) -> bool:
        """Whether the inequality is proved at every vertex."""
        return not self.failed


def prove_family(
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
        failed=tuple(int(k) for k in failed[:10]),
        margin=float(min(margin.min(), np.inf)) if not len(failed) else -np.inf,
        worst=tuple(worst),
        exact=tuple(confirmed),
    )


def inverse_bounds(P: FloatArray, rows: FloatArray) -> FloatArray:
    """Return doubles just above ``r P^-1 r'`` for rows r, proved; shapes (n, n), (k, n), (k,)."""
    inverse, found = np.linalg.inv(P), np.empty(len(rows))
    for i, row in enumerate(rows):
        near = float(row @ inverse @ row)
        for slack in 10.0 ** np.arange(-12, -5):
            found[i] = near * (1.0 + slack) + (1e-300 if near == 0 else 0.0)
            if _corner(P, row, found[i], sharp=False).all_proved:
                break
    return found


def prove_inverse(P: FloatArray, rows: FloatArray, upper: FloatArray) -> tuple[bool, float]:
    """Whether ``r P^-1 r'`` is proved to stay below numbers for all rows, and the least margin."""
    found = [_corner(P, *pair) for pair in zip(rows, upper.tolist(), strict=True)]
    margin = min((float(one.relative.min()) for one in found), default=np.inf)
    return all(one.all_proved for one in found), margin


def _corner(P: FloatArray, row: FloatArray, upper: float, sharp: bool = True) -> ProofResult:
    """Decide ``[upper, r; r', P] > 0``, which says that ``r P^-1 r' < upper``."""
    of = Enclosure.of
    block = symmetric_block([[of(np.array([[upper]]))], [of(row[:, None]), of(P)]])
    return prove_positive_definite(block, sharp=sharp)


# Blocks with less than this share of the dual weight get the multiplier zero.
_NEGLIGIBLE = 1e-10


@dataclass(frozen=True)
class Binding:
    """A block (at a vertex) that stands in the way, and its share of the dual weight."""

    block: str
    vertex: int | None
    share: float

    def __str__(self) -> str:
        where = "" if self.vertex is None else f" at vertex {self.vertex}"
        return f"{self.block}{where}: {100 * self.share:.0f} %"


@dataclass(frozen=True, eq=False)
class MarginBound:
    """An upper bound of the margin, checked in exact rational arithmetic.

    multipliers: Z_i by block, exactly positive definite or zero (psd), or not negative; doubles
    offset, slope: with free entries below s in size the margin is at most ``offset + slope s``
    """

    multipliers: Mapping[str, NDArray[np.float64]]
    offset: Fraction
    slope: Fraction

    def at(self, size: float) -> float:
        """Bound of the margin for free entries below ``size``."""
        return float(self.offset + self.slope * Fraction(size))

    @property
    def size_excluded(self) -> float:
        """No design with free entries below this size satisfies the constraints at all."""
        if self.offset >= 0:
            return 0.0
        return float(-self.offset / self.slope) if self.slope else float("inf")


def binding_blocks(
    problem: Problem,
    solution: Solution,
    chosen: Mapping[str, NDArray[np.intp]] | None = None,
    count: int = 5,
) -> tuple[Binding, ...]:
    """List the strict blocks with the largest dual weight."""
    found = []
    for name, item in problem.blocks.items():
        if not item.asks_margin or name not in solution.duals:
            continue
        dual = solution.duals[name]
        weights = np.atleast_1d(np.trace(dual, axis1=-2, axis2=-1))
        numbers = (chosen or {}).get(name, np.arange(len(weights)))
        family = item.expression.members is not None
        found += [
            Binding(name, int(k) if family else None, float(w))
            for k, w in zip(numbers, weights, strict=True)
        ]
    total = sum(binding.share for binding in found) or 1.0
    shares = [Binding(b.block, b.vertex, b.share / total) for b in found]
    ranked = sorted(shares, key=lambda b: -b.share)
    return tuple(binding for binding in ranked[:count] if binding.share > 0.01)


def bound_margin(problem: Problem, solution: Solution, margin: str) -> MarginBound | None:
    """Bound the margin that any values of the variables can reach, for data in doubles."""
    found = _multipliers(problem, solution)
    if found is None:
        return None
    constant, residuals = _pairings(problem, found)
    total = -residuals.pop((margin, 0))
    if total <= 0:
        return None
    return MarginBound(
        multipliers=found,
        offset=constant / total,
        slope=sum((abs(r) for r in residuals.values()), Fraction(0)) / total,
    )


def excluded_size(problem: Problem, solution: Solution) -> float:
    """Size of free entries below which none satisfies the constraints, 0 where that is not shown.

    With t left out, c0 + r'x >= 0 at a feasible point, for the ray of a solver as for any Z_i >= 0.
    """
    found = _multipliers(problem, solution)
    if found is None:
        return 0.0
    constant, residuals = _pairings(problem, found)
    slope = sum((abs(r) for r in residuals.values()), Fraction(0))
    if constant >= 0:
        return 0.0
    return float(-constant / slope) if slope else float("inf")


def _multipliers(problem: Problem, solution: Solution) -> dict[str, NDArray[np.float64]] | None:
    """Return the dual solution moved into its cones, exactly."""
    multipliers: dict[str, NDArray[np.float64]] = {}
    names = [name for name, item in problem.blocks.items() if item.cone == "psd"]
    psd = [solution.duals[name] for name in names if name in solution.duals]
    traces = [np.trace(z, axis1=-2, axis2=-1).sum() for z in psd]
    weight = _NEGLIGIBLE * float(sum(traces))
    for name, item in problem.blocks.items():
        dual = solution.duals.get(name)
        if dual is None or not np.isfinite(dual).all() or item.cone == "exponential":
            return None
        if item.cone == "psd":
            stack = dual.reshape(-1, *dual.shape[-2:])
            multipliers[name] = np.stack([_definite(z, weight) for z in stack]).reshape(dual.shape)
        else:
            multipliers[name] = dual if item.cone == "zero" else np.maximum(dual, 0.0)
    return multipliers


def _pairings(
    problem: Problem, multipliers: Mapping[str, NDArray[np.float64]]
) -> tuple[Fraction, dict[tuple[str, int], Fraction]]:
    """Return c0 and r of the weighted sum of all constraints, exactly."""
    unknowns = [(name, k) for name, v in problem.variables.items() for k in range(v.size)]
    constant, residuals = Fraction(0), dict.fromkeys(unknowns, Fraction(0))
    for name, weights in multipliers.items():
        offset, slopes = _pairing(problem.blocks[name].expression, weights)
        constant += offset
        for key, slope in slopes.items():
            residuals[key] += slope
    return constant, residuals


def _definite(dual: NDArray[np.float64], negligible: float) -> NDArray[np.float64]:
    """Shift a dual matrix until it is exactly positive definite, or drop it."""
    if not float(np.trace(dual)) > negligible:
        return np.zeros_like(dual)
    middle = 0.5 * (dual + dual.T)
    eye = np.eye(len(middle))
    size = float(np.abs(middle).max()) or 1e-300
    least = float(np.linalg.eigvalsh(middle)[0])
    shift = max(-least, 0.0) + 1e-15 * size
    while not is_positive_definite(middle + shift * eye):
        shift = 2.0 * shift
    return middle + shift * eye


def _pairing(
    expression: Affine, weights: NDArray[np.float64]
) -> tuple[Fraction, dict[tuple[str, int], Fraction]]:
    """Exact inner product of the weights with an expression: constant and coefficients."""
    column = ExactMatrix.of(np.swapaxes(weights, -1, -2).reshape(1, -1))
    flat = column.entries.entries()
    fixed = np.swapaxes(expression.constant, -1, -2).ravel()
    total: Any = 0
    for k in np.flatnonzero(fixed):
        total += flat[k] * ExactMatrix.of(fixed[k]).entries[0, 0]
    slopes: dict[tuple[str, int], Any] = {}
    for variable, operator in expression.terms.items():
        entries = operator.tocoo()
        exact = ExactMatrix.of(entries.data.reshape(1, -1)).entries.entries()
        for value, row, unknown in zip(exact, entries.row, entries.col, strict=True):
            key = (variable.name, int(unknown))
            slopes[key] = slopes.get(key, 0) + flat[row] * value
    return _fraction(total), {key: _fraction(slope) for key, slope in slopes.items()}


def _fraction(number: Any) -> Fraction:
    return Fraction(int(number.p), int(number.q)) if hasattr(number, "p") else Fraction(number)
