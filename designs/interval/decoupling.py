"""Decoupling of the faults by orthogonal transformations, made exact.

The singular value decompositions give H and N in doubles, orthogonal only up to rounding. What the
observer uses are rational matrices next to them for which the identities hold exactly:

    T2 F = 0,    Phi C + W T2 = I,    F_left F = I,    N12 C = C2 T2 .

In the letters of the paper T2 = H2', Phi = H1 E, W = H2 - H1 E Ct2 and F_left = K0 R0^-1 H1'.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.derive.errors import StructureError
from obsynth.derive.rigour import Exact, exact, inverse, nearest
from obsynth.designs.interval.model import IntervalModel
from obsynth.symbolic import ObsynthError
from obsynth.symbolic.arrays import FloatArray

RANK = 1e-9
ORTHOGONAL = 1e-9


@dataclass(frozen=True, eq=False)
class Transformation:
    """F = H [R0; 0] K0' and C H1 = N [R1; 0] K1', Section 4 of the paper.

    H, N: orthogonal
    """

    H: FloatArray
    R0: FloatArray
    K0: FloatArray
    N: FloatArray
    R1: FloatArray
    K1: FloatArray


@dataclass(frozen=True, eq=False)
class Decoupled:
    """The plant after the faults are taken away, exact.

    T2: z2 = T2 x is free of the faults
    N12: N12 y = C2 z2 + N12 W2 w
    Phi, W: x = Phi (y - W2 w) + W z2
    F_left: left inverse of F
    """

    T2: Exact
    N12: Exact
    Phi: Exact
    W: Exact
    F_left: Exact
    C2: Exact


def transformation(
    model: IntervalModel, given: Mapping[str, FloatArray | None] | None = None
) -> Transformation:
    """Return the transformation: singular value decompositions, or what was given."""
    given = dict(given or {})
    F, C = nearest(model.F), nearest(model.C)
    _check_ranks(model, F, C)
    n, q, m = model.n, model.q, len(C)
    left, values, right = np.linalg.svd(F, full_matrices=True)
    H, R0, K0 = _with_given(given, ("H", "R0", "K0"), (left, np.diag(values), right.T), F, n)
    _check("H, R0, K0", H, R0, K0, F)
    first = C @ H[:, :q]
    left, values, right = np.linalg.svd(first, full_matrices=True)
    N, R1, K1 = _with_given(given, ("N", "R1", "K1"), (left, np.diag(values), right.T), first, m)
    _check("N, R1, K1", N, R1, K1, first)
    return Transformation(H, R0, K0, N, R1, K1)


def _with_given(
    given: Mapping[str, Any],
    names: tuple[str, str, str],
    found: tuple[FloatArray, FloatArray, FloatArray],
    target: FloatArray,
    size: int,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    orthogonal, inner, outer = (given.get(name) for name in names)
    q = target.shape[1]
    if orthogonal is None:
        if inner is not None or outer is not None:
            raise ObsynthError(
                f"{names[1]} or {names[2]} is given without {names[0]}: they belong together",
                option=names[0],
            )
        return found
    orthogonal = _shaped(orthogonal, (size, size), names[0])
    inner = orthogonal[:, :q].T @ target if inner is None else _shaped(inner, (q, q), names[1])
    outer = np.eye(q) if outer is None else _shaped(outer, (q, q), names[2])
    return orthogonal, inner, outer


def _shaped(value: Any, shape: tuple[int, int], name: str) -> FloatArray:
    array = np.asarray(value, dtype=float)
    if array.shape != shape or not np.isfinite(array).all():
        raise ObsynthError(
            f"{name} has to be finite with shape {shape}; its shape is {array.shape}", option=name
        )
    return array


def _check(
    names: str, orthogonal: FloatArray, inner: FloatArray, outer: FloatArray, target: FloatArray
) -> None:
    q = target.shape[1]
    first = names.split(",")[0]
    skew = float(np.abs(orthogonal.T @ orthogonal - np.eye(len(orthogonal))).max(initial=0.0))
    if skew > ORTHOGONAL:
        raise ObsynthError(
            f"{first} is not orthogonal: |{first}'{first} - I| is {skew:.3g}", option=first
        )
    size = max(1.0, float(np.abs(target).max(initial=0.0)))
    miss = float(np.abs(orthogonal[:, :q] @ inner @ outer.T - target).max(initial=0.0))
    if miss > ORTHOGONAL * size:
        what = "F" if first == "H" else "C H1"
        raise ObsynthError(
            f"{names} do not factorise {what}: the largest difference is {miss:.3g}", option=first
        )


def _check_ranks(model: IntervalModel, F: FloatArray, C: FloatArray) -> None:
    q = model.q
    names = (*model.plant.names("f"), *model.plant.names("d"))
    rank_F, rank_CF = _rank(F), _rank(C @ F)
    if rank_F < q:
        raise StructureError(
            f"rank(F) = {rank_F} for {q} faults and unknown inputs: {', '.join(names)} act on the "
            "states in the same way and cannot be told apart; merge or remove them",
            condition="rank(F) = q",
            symbols=names,
            rank_F=rank_F,
            rank_CF=rank_CF,
            q=q,
        )
    if rank_CF < q:
        _, values, vectors = np.linalg.svd(C @ F, full_matrices=True)
        full = np.zeros(q)
        full[: len(values)] = values
        lost = vectors[full <= RANK * max(1.0, float(full.max()))].T
        symbols = tuple(s for j, s in enumerate(names) if np.abs(lost[j]).max() > 1e-6)
        states = tuple(
            s for i, s in enumerate(model.plant.names("x")) if np.abs(F[i] @ lost).max() > 1e-9
        )
        raise StructureError(
            f"rank(C F) = {rank_CF} but there are {q} faults and unknown inputs: "
            f"{', '.join(symbols)} acts on {', '.join(states)}, and no output "
            f"({', '.join(model.plant.output_names)}) shows it one step later. Full rank of C and "
            f"of F (Assumption 3) is not enough: measure {states[0]}, or treat {symbols[0]} as a "
            "bounded disturbance",
            condition="rank(C F) = q",
            symbols=symbols,
            states=states,
            rank_F=rank_F,
            rank_CF=rank_CF,
            q=q,
        )


def _rank(matrix: FloatArray) -> int:
    if matrix.size == 0:
        return 0
    size = np.linalg.norm(matrix, axis=0)
    return int(np.linalg.matrix_rank(matrix / np.where(size > 0.0, size, 1.0), tol=RANK))


def decouple_exactly(model: IntervalModel, chosen: Transformation) -> Decoupled:
    """Project the transformation onto matrices that decouple exactly."""
    F, C, q = model.F, model.C, model.q
    H, N = exact(chosen.H), exact(chosen.N)
    T2 = _free_of(H[:, q:].T, F)
    CF = C @ F
    N12 = _free_of(N[:, q:].T, CF)
    back = inverse(np.vstack([T2, N[:, :q].T @ C]))
    W, Phi = back[:, : model.n - q], back[:, model.n - q :] @ N[:, :q].T
    left = exact(chosen.K0) @ inverse(exact(chosen.R0)) @ H[:, :q].T
    F_left = inverse(left @ F) @ left
    return Decoupled(T2, N12, Phi, W, F_left, N12 @ C @ W)


def _free_of(rows: Exact, columns: Exact) -> Exact:
    """Change rows by the least that makes them orthogonal to the columns."""
    if columns.shape[1] == 0:
        return rows
    share: Exact = inverse(columns.T @ columns) @ columns.T
    free: Exact = rows - (rows @ columns) @ share
    return free
