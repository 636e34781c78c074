"""Decoupling of the unknown inputs: when there is one, and the matrices E, T, Pi, exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.derive.errors import StructureError
from obsynth.derive.rigour import ExactMatrix
from obsynth.derive.split import Split
from obsynth.symbolic.arrays import FloatArray

_RANK_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Decoupling:
    """Matrices that remove the unknown input from the estimation error.

    E: eq. (13), as stored
    T: ``I + E C`` rounded to doubles
    Pi: ``I + C E`` rounded to doubles
    rank: rank of D and of C D: the number q of unknown inputs
    residual: largest entry of ``|(I + E C) D|`` for the stored doubles, computed exactly: 0 where
        the decoupling is exact
    projector: whether ``I + E C`` of the stored doubles is exactly a projector and equal to `T`
    """

    E: FloatArray
    T: FloatArray
    Pi: FloatArray
    rank: int
    residual: float
    projector: bool


def decouple(C: FloatArray, D: FloatArray) -> Decoupling:
    """Compute E, T and Pi in exact arithmetic and round them to doubles.

    Buciakowski et al., eqs. (13)-(14); C (m, n), D (n, q). Refuses a C D without full column rank.
    """
    C = np.asarray(C, dtype=float)
    m, n = C.shape
    q = D.shape[1]
    if q == 0:
        return Decoupling(np.zeros((n, m)), np.eye(n), np.eye(m), 0, 0.0, True)
    exact_C, exact_D = ExactMatrix.of(C), ExactMatrix.of(D)
    CD = exact_C @ exact_D
    gram = CD.T @ CD
    if gram.entries.det() == 0:
        raise StructureError(
            f"rank(C D) is {CD.entries.rank()} but there are {q} unknown inputs: an unknown input "
            "does not reach the outputs within one step, so it cannot be decoupled; measure a "
            "state that it enters",
            rank=CD.entries.rank(),
            required=q,
        )
    E = (-exact_D @ gram.inverse() @ CD.T).to_floats()
    exact_E = ExactMatrix.of(E)
    exact_T = np.eye(n) + exact_E @ exact_C
    T = exact_T.to_floats()
    Pi = (np.eye(m) + exact_C @ exact_E).to_floats()
    residual = float(np.max(np.abs((exact_T @ exact_D).to_floats()), initial=0.0))
    projector = (exact_T @ exact_T).entries == exact_T.entries == ExactMatrix.of(T).entries
    return Decoupling(E, T, Pi, q, residual, bool(projector))


def _rank(matrix: FloatArray) -> int:
    if matrix.size == 0:
        return 0
    size = np.linalg.norm(matrix, axis=0)
    scaled = matrix / np.where(size > 0.0, size, 1.0)
    return int(np.linalg.matrix_rank(scaled, tol=_RANK_TOLERANCE))


def listed(names: list[str] | tuple[str, ...]) -> str:
    """Join names."""
    return ", ".join(names)


def unknown_input_condition(split: Split) -> Decoupling:
    """Check rank(D) = rank(C D) = q and return the matrices that decouple the unknown inputs.

    Assumption 4 and equation (13) of Buciakowski et al.
    """
    model, D, C = split.model, split.D, split.C
    n, m, q = len(D), len(C), D.shape[1]
    if q == 0:
        return decouple(C, D)
    names, states = model.names("d"), model.names("x")
    CD = C @ D
    rank_D, rank_CD = _rank(D), _rank(CD)
    if rank_D < q:
        dead = [names[j] for j in range(q) if not D[:, j].any()]
        what = (
            f"{listed(dead)} enters no equation"
            if dead
            else f"{listed(names)} act on the states in the same way and cannot be told apart"
        )
        raise StructureError(
            f"rank(D) = {rank_D} for {q} unknown inputs: {what}; merge or remove them",
            condition="rank(D) = q",
            rank_D=rank_D,
            rank_CD=rank_CD,
            q=q,
            symbols=tuple(dead) or names,
        )
    if rank_CD < q:
        lost = _null_vectors(CD)
        symbols = [s for j, s in enumerate(names) if np.abs(lost[j]).max() > 1e-6]
        acts = [states[i] for i in range(n) if np.abs(D[i] @ lost).max() > 1e-9]
        more = f"; {q} unknown inputs need at least {q} outputs" if m < q else ""
        raise StructureError(
            f"rank(C D) = {rank_CD} but rank(D) = {q}: the unknown input {listed(symbols)} acts "
            f"on {listed(acts)}, and no output ({listed(model.output_names)}) shows it one step "
            f"later{more}. Measure {acts[0]}, or treat {symbols[0]} as a bounded disturbance",
            condition="rank(C D) = rank(D)",
            rank_D=rank_D,
            rank_CD=rank_CD,
            q=q,
            symbols=tuple(symbols),
            states=tuple(acts),
        )
    return decouple(C, D)


def _null_vectors(matrix: FloatArray) -> FloatArray:
    _, values, vectors = np.linalg.svd(matrix, full_matrices=True)
    full = np.zeros(matrix.shape[1])
    full[: len(values)] = values
    chosen = full <= _RANK_TOLERANCE * max(float(full.max(initial=0.0)), 1.0)
    return np.asarray(vectors[chosen].T)
