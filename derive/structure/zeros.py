"""Invariant zeros of state-space systems, and over the vertices of a Jacobian family."""

from dataclasses import dataclass
from html import escape
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from obsynth.derive.jacobian.bounds import JacobianBounds
from obsynth.derive.split import Split

Array = NDArray[np.float64]
Numbers = NDArray[np.complex128]
_TOLERANCE = 1e-10


def system_zeros(A: Array, B: Array, C: Array, D: Array) -> Numbers:
    """Finite invariant zeros: where the Rosenbrock pencil [A - z I, B; C, D] loses rank.

    The algorithm of Emami-Naeini and Van Dooren removes from the pencil everything that is
    infinite or singular by orthogonal transformations, for any number of inputs and outputs and
    any normal rank; what is left has an invertible D, and its zeros are eigenvalues.

    Parameters
    ----------
    A, B, C, D : ndarray, shapes (n, n), (n, k), (m, n), (m, k)
        The system.

    Returns
    -------
    ndarray of complex
        The largest modulus first. Modes that the outputs do not see or the inputs do not reach
        are among them as far as they lower the rank.

    References
    ----------
    A. Emami-Naeini, P. Van Dooren, Computation of zeros of linear multivariable systems,
    Automatica 18(4), 1982.

    Examples
    --------
    >>> A, B = np.array([[-1.0, 0.0], [0.0, -2.0]]), np.array([[1.0], [1.0]])
    >>> system_zeros(A, B, np.array([[1.0, 1.0]]), np.zeros((1, 1))).real.round(12).tolist()
    [-1.5]
    """
    size = float(np.abs(A).max(initial=0.0)) or 1.0
    B, D = _unit_columns(B / size, D)
    C, D = (part.T for part in _unit_columns(C.T, D.T))
    A, B, C, D = _reduce(A / size, B, C, D)
    # D has full row rank now; the same once more for the columns
    A, B, C, D = _reduce(A.T, C.T, B.T, D.T)
    if A.size == 0:
        return np.zeros(0, dtype=complex)
    values = np.linalg.eigvals(A - B @ np.linalg.solve(D, C) if D.size else A) * size
    return np.asarray(values[np.argsort(-np.abs(values), kind="stable")], dtype=complex)


def _unit_columns(upper: Array, lower: Array) -> tuple[Array, Array]:
    """Scale the columns of [upper; lower] to size one; zeros do not change."""
    size = np.sqrt((upper**2).sum(axis=0) + (lower**2).sum(axis=0))
    size = np.where(size > 0.0, size, 1.0)
    return upper / size, lower / size


def _row_rank(matrix: Array) -> tuple[int, Array]:
    """Rank, and an orthogonal matrix whose transpose puts the rows that matter first."""
    if matrix.size == 0:
        return 0, np.eye(len(matrix))
    left, values, _ = np.linalg.svd(matrix)
    return int((values > _TOLERANCE).sum()), left


def _reduce(A: Array, B: Array, C: Array, D: Array) -> tuple[Array, Array, Array, Array]:
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


@dataclass(frozen=True, eq=False)
class PolytopeZeros:
    """Zeros from some signals to the outputs, at every vertex of the Jacobian family.

    Attributes
    ----------
    signals : tuple of str
        The inputs of the system: unknown inputs, or these and the faults.
    zeros : tuple of ndarray of complex
        At every vertex.
    worst : complex or None
        The zero that decays least: largest modulus, or real part in continuous time.
    decays : bool
        True when all of them decay, so that no motion of the signals can go on without a trace in
        the outputs.
    vertex : int or None
        Where the worst one was found.
    """

    signals: tuple[str, ...]
    zeros: tuple[Numbers, ...]
    worst: complex | None
    decays: bool
    vertex: int | None

    def __str__(self) -> str:
        what = f"from {', '.join(self.signals)} to the outputs" if self.signals else "without input"
        if self.worst is None:
            return f"none {what}, at all {len(self.zeros)} vertices"
        value = f"{self.worst.real:.6g}" if self.worst.imag == 0 else f"{self.worst:.6g}"
        verdict = "all decay" if self.decays else "does not decay"
        return (
            f"{what}: slowest {value} at vertex {int(self.vertex or 0) + 1} of {len(self.zeros)} "
            f"({verdict})"
        )

    def _repr_html_(self) -> str:
        return f"<p>Invariant zeros {escape(str(self))}</p>"


def zeros_over_polytope(
    split: Split, bounds: JacobianBounds, signals: Literal["unknown", "all"] = "unknown"
) -> PolytopeZeros:
    """Compute the invariant zeros of a plant at every vertex of its Jacobian family.

    From the unknown inputs to the outputs, zeros that decay are what an observer that decouples
    them needs (strong detectability, Hautus 1983). From unknown inputs and faults together, they
    are what reconstructing the faults with a stable inverse needs.

    Parameters
    ----------
    split : Split
        The plant's matrices.
    bounds : JacobianBounds
        Bounds of dg/dx.
    signals : {"unknown", "all"}
        Unknown inputs only, or unknown inputs and faults.

    Returns
    -------
    PolytopeZeros
        Zeros at every vertex and the worst of them. Between the vertices they can be worse.

    Examples
    --------
    >>> from obsynth.derive.jacobian.bounds import jacobian_bounds
    >>> from obsynth.derive.split import split
    >>> from obsynth.symbolic.plants import quadruple_tank
    >>> parts = split(quadruple_tank().discretise("euler", Ts=1.0))
    >>> found = zeros_over_polytope(parts, jacobian_bounds(parts), "all")
    >>> round(found.worst.real, 6), found.decays
    (0.99647, True)
    """
    model = split.model
    B, D = split.D, np.zeros((len(split.C), split.D.shape[1]))
    names = model.names("d")
    if signals == "all":
        B, D = np.hstack([B, split.B_f]), np.hstack([D, split.D_f])
        names = (*names, *model.names("f"))
    found = tuple(system_zeros(split.A + M, B, split.C, D) for M in bounds.vertices())
    discrete = model.Ts is not None
    worst: complex | None = None
    vertex = None
    for index, zeros in enumerate(found):
        for zero in zeros.tolist():
            size = abs(zero) if discrete else zero.real
            if worst is None or size > (abs(worst) if discrete else worst.real):
                worst, vertex = complex(zero), index
    if worst is not None and abs(worst.imag) < 1e-9 * max(1.0, abs(worst)):
        worst = complex(worst.real, 0.0)
    limit = 1.0 if discrete else 0.0
    reached = -np.inf if worst is None else (abs(worst) if discrete else worst.real)
    return PolytopeZeros(names, found, worst, bool(reached < limit - 1e-9), vertex)
