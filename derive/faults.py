"""What the faults do to the outputs: which can be told apart, and how fast they can be followed."""

import numpy as np
from numpy.typing import NDArray

from obsynth.derive.split import Split

Array = NDArray[np.float64]
_RANK_TOLERANCE = 1e-9
_ZERO_TOLERANCE = 1e-6


def _inputs(split: Split) -> tuple[Array, Array]:
    """Stack the columns with which unknown inputs and faults enter states and outputs."""
    direct = np.zeros((len(split.C), split.D.shape[1]))
    return np.hstack([split.D, split.B_f]), np.hstack([direct, split.D_f])


def separable_faults(split: Split, M: Array) -> tuple[tuple[str, ...], int, int]:
    """Faults that can be told apart from all others and from unknown inputs.

    The normal rank of the transfer matrix from unknown inputs and faults to the outputs is taken
    at a few fixed points off the axes, where a rank below it has probability zero.
    """
    names = split.model.names("f")
    q, n_f = split.D.shape[1], len(names)
    inputs, direct = _inputs(split)

    def rank(columns: list[int]) -> int:
        found = 0
        for z in (1.37 + 0.61j, -0.83 + 1.29j):
            pencil = z * np.eye(len(split.A)) - split.A - M
            transfer = split.C @ np.linalg.solve(pencil, inputs[:, columns]) + direct[:, columns]
            size = np.linalg.norm(transfer, axis=0)
            scaled = transfer / np.where(size > 0.0, size, 1.0)
            if scaled.size:
                found = max(found, int(np.linalg.matrix_rank(scaled, tol=_RANK_TOLERANCE)))
        return found

    every = list(range(q + n_f))
    whole = rank(every)
    apart = tuple(
        name for k, name in enumerate(names) if rank([c for c in every if c != q + k]) < whole
    )
    return apart, whole, q + n_f


def invariant_zeros(split: Split, M: Array) -> NDArray[np.complex128]:
    """Invariant zeros from unknown inputs and faults to the outputs.

    A zero that does not decay (modulus >= 1, real part >= 0 in continuous time) means that some
    motion of faults and unknown inputs grows without a trace in the outputs. With more outputs than
    signals there usually are none.
    """
    from scipy.linalg import eigvals

    inputs, direct = _inputs(split)
    n, signals, outputs = len(split.A), inputs.shape[1], len(split.C)
    if signals == 0 or signals > outputs:
        return np.zeros(0, dtype=complex)
    rng = np.random.default_rng(0)
    found: NDArray[np.complex128] | None = None
    # two random selections of outputs: only zeros of the full system belong to both
    for _ in range(1 if signals == outputs else 2):
        choice = np.eye(outputs) if signals == outputs else rng.normal(size=(signals, outputs))
        pencil = np.block([[split.A + M, inputs], [choice @ split.C, choice @ direct]])
        unit = np.zeros_like(pencil)
        unit[:n, :n] = np.eye(n)
        values = eigvals(pencil, unit)
        values = values[np.isfinite(values) & (np.abs(values) < 1e6)]
        if found is None:
            found = values
        else:
            near = np.abs(found[:, None] - values[None, :]) < _ZERO_TOLERANCE
            found = found[near.any(axis=1)]
    result = np.zeros(0, dtype=complex) if found is None else found
    return np.asarray(result[np.argsort(-np.abs(result), kind="stable")], dtype=complex)
