"""What faults and unknown inputs do to the outputs: invariant zeros, separable faults."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from obsynth.derive.jacobian.bounds import JacobianBounds
from obsynth.derive.split import Split
from obsynth.derive.structure.conditions import Numbers, column_sizes, mode_text, scaled_rank
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.shown import Shown

Signals = Literal["unknown", "all"]
_TOLERANCE = 1e-10
_ROUNDING = 1e-12


def system_zeros(A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray) -> Numbers:
    """Finite invariant zeros: where the Rosenbrock pencil [A - z I, B; C, D] loses rank.

    Emami-Naeini and Van Dooren (Automatica 1982) remove what is infinite or singular by orthogonal
    transformations; the zeros are eigenvalues of what is left, the largest modulus first.

    Rounding splits a zero of multiplicity k by about eps^(1/k): what a relative change of the
    entries of 1e-12 makes coincide is returned as one zero, their mean, which rounding hardly
    moves.
    """
    size = float(np.abs(A).max(initial=0.0)) or 1.0
    B, D = _unit_columns(B / size, D)
    C, D = (part.T for part in _unit_columns(C.T, D.T))
    A, B, C, D = _reduce(A / size, B, C, D)
    # D has full row rank now; the same once more for the columns
    A, B, C, D = _reduce(A.T, C.T, B.T, D.T)
    if A.size == 0:
        return np.zeros(0, dtype=complex)
    values = _gather(A - B @ np.linalg.solve(D, C) if D.size else A) * size
    return np.asarray(values[np.argsort(-np.abs(values), kind="stable")], dtype=complex)


def _gather(matrix: FloatArray) -> Numbers:
    """Eigenvalues, with those that rounding alone tells apart replaced by their mean."""
    from scipy.linalg import eig

    values, left, right = eig(matrix, left=True, right=True)
    size = max(1.0, float(np.linalg.norm(matrix)))
    with np.errstate(divide="ignore"):
        # how far rounding moves an eigenvalue; those that split from a multiple one move far
        reach = _ROUNDING * size / np.abs((left.conj() * right).sum(axis=0))
    found, left_over = values.copy(), np.ones(len(values), dtype=bool)
    for start in range(len(values)):
        if not left_over[start]:
            continue
        distance = np.abs(values - values[start])
        near = left_over & (distance <= reach + reach[start])
        group = [j for j in np.argsort(distance, kind="stable") if near[j]]
        while not _coincide((values[group] - values[group].mean()) / size):
            group.pop()
        found[group] = values[group].mean()
        left_over[group] = False
    found.imag[np.abs(found.imag) <= _ROUNDING * size] = 0.0
    return np.asarray(found, dtype=complex)


def _coincide(offsets: Numbers) -> bool:
    """Whether the product of z - offset is z^k, up to rounding of its coefficients."""
    return bool(np.abs(np.poly(offsets)[1:]).max() <= _ROUNDING)


def _unit_columns(upper: FloatArray, lower: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Scale the columns of [upper; lower] to size one; zeros do not change."""
    size = column_sizes(np.vstack([upper, lower]))
    return upper / size, lower / size


def _row_rank(matrix: FloatArray) -> tuple[int, FloatArray]:
    """Rank, and an orthogonal matrix whose transpose puts the rows that matter first."""
    if matrix.size == 0:
        return 0, np.eye(len(matrix))
    left, values, _ = np.linalg.svd(matrix)
    return int((values > _TOLERANCE).sum()), left


def _reduce(
    A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Remove states until D has full row rank; the zeros stay the same."""
    while True:
        found, turn = _row_rank(D)
        C, D = turn.T @ C, turn.T @ D
        if found == len(D):
            return A, B, C, D
        below = C[found:]
        C, D = C[:found], D[:found]
        if below.shape[1] == 0:
            return A, B, C, D
        lost, turn = _row_rank(below.T)
        if lost == 0:
            return A, B, C, D
        # outputs without feed-through hold the first `lost` states at zero, so that their
        # derivatives become outputs
        A, B, C = turn.T @ A @ turn, turn.T @ B, C @ turn
        C, D = np.vstack([A[:lost, lost:], C[:, lost:]]), np.vstack([B[:lost], D])
        A, B = A[lost:, lost:], B[lost:]


@dataclass(frozen=True, eq=False, repr=False)
class PolytopeZeros(Shown):
    """Zeros from some signals to the outputs, at every vertex of the Jacobian family.

    worst: the zero that decays least, at `vertex`: largest modulus, or real part in continuous time
    """

    signals: tuple[str, ...]
    zeros: tuple[Numbers, ...]
    worst: complex | None
    decays: bool
    vertex: int | None

    @property
    def multiplicity(self) -> int:
        """How often the worst zero occurs at its vertex."""
        return 0 if self.vertex is None else self.zeros[self.vertex].tolist().count(self.worst)

    def __str__(self) -> str:
        what = f"from {', '.join(self.signals)} to the outputs" if self.signals else "without input"
        if self.worst is None:
            return f"none {what}, at all {len(self.zeros)} vertices"
        value = list_zeros(np.array([self.worst] * self.multiplicity))
        verdict = "all decay" if self.decays else "does not decay"
        return (
            f"{what}: slowest {value} at vertex {int(self.vertex or 0) + 1} of {len(self.zeros)} "
            f"({verdict})"
        )


def list_zeros(zeros: Numbers) -> str:
    """Write zeros with six digits, a multiple one once with the number of times it occurs."""
    listed = zeros.tolist()
    return ", ".join(
        mode_text(z) + (f" ({listed.count(z)} times)" if listed.count(z) > 1 else "")
        for z in dict.fromkeys(listed)
    )


def _entering(split: Split, signals: Signals) -> tuple[FloatArray, FloatArray]:
    """Columns with which unknown inputs, or these and the faults, enter states and outputs."""
    B, D = split.D, np.zeros((len(split.C), split.D.shape[1]))
    if signals == "unknown":
        return B, D
    return np.hstack([B, split.B_f]), np.hstack([D, split.D_f])


def invariant_zeros(split: Split, M: FloatArray, signals: Signals = "all") -> Numbers:
    """Invariant zeros of a plant with Jacobian M of g, (n, n): from the signals to the outputs."""
    B, D = _entering(split, signals)
    return system_zeros(split.A + M, B, split.C, D)


def separable_faults(split: Split, M: FloatArray) -> tuple[tuple[str, ...], int, int]:
    """Faults that can be told apart from all others and from unknown inputs; rank, signals.

    The normal rank is that at fixed points off the axes.
    """
    names = split.model.names("f")
    inputs, direct = _entering(split, "all")
    q, count = split.D.shape[1], inputs.shape[1]

    def rank(columns: list[int]) -> int:
        found = 0
        for z in (1.37 + 0.61j, -0.83 + 1.29j):
            pencil = z * np.eye(len(split.A)) - split.A - M
            transfer = split.C @ np.linalg.solve(pencil, inputs[:, columns]) + direct[:, columns]
            found = max(found, scaled_rank(transfer))
        return found

    every = list(range(count))
    whole = rank(every)
    apart = tuple(
        name for k, name in enumerate(names) if rank([c for c in every if c != q + k]) < whole
    )
    return apart, whole, count


def zeros_over_polytope(
    split: Split, bounds: JacobianBounds, signals: Signals = "unknown"
) -> PolytopeZeros:
    """Compute the invariant zeros of a plant at every vertex of its Jacobian family.

    Those from unknown inputs have to decay for a decoupling observer (strong detectability, Hautus
    1983), those from faults as well for a stable inverse.
    """
    model = split.model
    names = model.names("d") + (model.names("f") if signals == "all" else ())
    found = tuple(invariant_zeros(split, M, signals) for M in bounds.vertices())
    discrete = model.Ts is not None
    ranked = [
        (abs(zero) if discrete else zero.real, -index, zero)
        for index, zeros in enumerate(found)
        for zero in zeros.tolist()
    ]
    if not ranked:
        return PolytopeZeros(names, found, None, True, None)
    size, index, worst = max(ranked, key=lambda item: item[:2])
    decays = size < (1.0 if discrete else 0.0) - 1e-9
    return PolytopeZeros(names, found, worst, decays, -index)
