"""Decoupling of the faults by orthogonal transformations, made exact.

What the observer uses are rational matrices next to those of singular value decompositions, for
which the identities of `Decoupled` hold exactly (docs/methods/interval_observer.md, Decoupling).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from obsynth.derive.errors import StructureError
from obsynth.derive.rigour import Exact, exact, inverse, nearest
from obsynth.designs.interval.model import IntervalModel
from obsynth.symbolic import ObsynthError, Plant
from obsynth.symbolic.arrays import FloatArray

ORTHOGONAL = 1e-9
MODE = 1e-9


@dataclass(frozen=True, eq=False)
class Transformation:
    """F = H [R0; 0] K0' and C H1 = N [R1; 0] K1', Section 4 of the paper; H, N orthogonal."""

    H: Annotated[FloatArray, "n n"]
    R0: Annotated[FloatArray, "n_f+q n_f+q"]
    K0: Annotated[FloatArray, "n_f+q n_f+q"]
    N: Annotated[FloatArray, "m m"]
    R1: Annotated[FloatArray, "n_f+q n_f+q"]
    K1: Annotated[FloatArray, "n_f+q n_f+q"]


@dataclass(frozen=True, eq=False)
class Decoupled:
    """The plant after the faults are taken away, exact: T2 F = 0, F_left F = I.

    N12: N12 y = C2 z2 + N12 W2 w, z2 = T2 x
    Phi, W: x = Phi (y - W2 w) + W z2
    """

    T2: Exact
    N12: Exact
    Phi: Exact
    W: Exact
    F_left: Exact
    C2: Exact


@dataclass(frozen=True, eq=False)
class Reduced:
    """The plant without its faults, in doubles, one matrix per vertex.

    A, D: T2 A_i W, T2 A_i Phi; W1: T2 W1
    y_size: largest |y| over the declared boxes; signals: largest |x|, |u| and 1
    W: x = W z2 and a share that the measurement gives
    changes: T2 times what every scheduling scalar changes over its range in [A B o]
    """

    A: FloatArray
    D: FloatArray
    C2: FloatArray
    N12: FloatArray
    W1: FloatArray
    W2: FloatArray
    w_width: FloatArray
    y_size: FloatArray
    W: FloatArray
    changes: FloatArray
    signals: FloatArray

    @classmethod
    def of(cls, model: IntervalModel, free: Decoupled) -> Reduced:
        """Round the exact matrices."""
        a, _, _ = model.columns
        n2, m = free.T2.shape[0], len(model.C)
        A = [nearest(free.T2 @ v[:, a] @ free.W) for v in model.vertices]
        D = [nearest(free.T2 @ v[:, a] @ free.Phi) for v in model.vertices]
        box = nearest(model.box("w")).reshape(-1, 2)
        C, W2 = nearest(model.C), nearest(model.W2)
        x = nearest(model.size("x"))
        size = np.abs(C) @ x + np.abs(W2) @ np.abs(box).max(axis=1, initial=0.0)
        ranges = model.family.ranges[:, 1] - model.family.ranges[:, 0]
        return cls(
            np.array(A).reshape(len(A), n2, n2),
            np.array(D).reshape(len(D), n2, m),
            nearest(free.C2),
            nearest(free.N12),
            nearest(free.T2 @ model.W1),
            W2,
            box[:, 1] - box[:, 0],
            size,
            nearest(free.W),
            nearest(free.T2) @ (ranges[:, None, None] * model.family.directions),
            np.concatenate([x, nearest(model.size("u")), [1.0]]),
        )


def find_transformation(model: IntervalModel, given: Mapping[str, Any]) -> Transformation:
    """Return singular value decompositions, or what is given (None: not given), by letters."""
    F, C, q = nearest(model.F), nearest(model.C), model.q
    H, R0, K0 = _factorise(given, ("H", "R0", "K0"), F, "F")
    N, R1, K1 = _factorise(given, ("N", "R1", "K1"), C @ H[:, :q], "C H1")
    return Transformation(H, R0, K0, N, R1, K1)


def _factorise(
    given: Mapping[str, Any], names: tuple[str, str, str], target: FloatArray, what: str
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return (orthogonal, inner, outer) with orthogonal [inner; 0] outer' = target."""
    size, q = target.shape
    orthogonal, inner, outer = (given[name] for name in names)
    if orthogonal is None:
        if inner is not None or outer is not None:
            raise ObsynthError(
                f"{names[1]} or {names[2]} is given without {names[0]}: they belong together",
                option=names[0],
            )
        left, values, right = np.linalg.svd(target, full_matrices=True)
        return left, np.diag(values), right.T
    orthogonal = shaped(orthogonal, (size, size), names[0])
    inner = orthogonal[:, :q].T @ target if inner is None else shaped(inner, (q, q), names[1])
    outer = np.eye(q) if outer is None else shaped(outer, (q, q), names[2])
    skew = float(np.abs(orthogonal.T @ orthogonal - np.eye(size)).max(initial=0.0))
    if skew > ORTHOGONAL:
        raise ObsynthError(
            f"{names[0]} is not orthogonal: |{names[0]}'{names[0]} - I| is {skew:.3g}",
            option=names[0],
        )
    miss = float(np.abs(orthogonal[:, :q] @ inner @ outer.T - target).max(initial=0.0))
    if miss > ORTHOGONAL * max(1.0, float(np.abs(target).max(initial=0.0))):
        raise ObsynthError(
            f"{', '.join(names)} do not factorise {what}: the largest difference is {miss:.3g}",
            option=names[0],
        )
    return orthogonal, inner, outer


def shaped(value: Any, shape: tuple[int, int], name: str, option: str | None = None) -> FloatArray:
    """Return finite numbers as an array of a shape; an empty one is of any empty shape."""
    array = np.array(value, dtype=float)
    if array.size == 0 and 0 in shape:
        array = np.zeros(shape)
    if array.shape != shape:
        raise ObsynthError(
            f"{name} has to be finite with shape {shape}; its shape is {array.shape}",
            option=option or name,
        )
    return array


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


def check_detectable(plant: Plant, data: Reduced) -> None:
    """Refuse a pair (A2, C2) with a mode that does not decay and is not seen, Assumption 4."""
    names = plant.names("x")
    for number, A in enumerate(data.A):
        for mode in np.linalg.eigvals(A):
            if abs(mode) < 1.0 - MODE:
                continue
            pencil = np.vstack([mode * np.eye(len(A)) - A, data.C2.astype(complex)])
            size = np.linalg.norm(pencil, axis=0)
            size = np.where(size > 0.0, size, 1.0)
            _, values, vectors = np.linalg.svd(pencil / size)
            if values[-1] > MODE:
                continue
            motion = np.abs(data.W @ (vectors[-1].conj() / size))
            moving = tuple(
                name for name, v in zip(names, motion, strict=True) if v > 1e-6 * motion.max()
            )
            text = f"{mode.real:.6g}" if abs(mode.imag) < 1e-12 else f"{mode:.6g}"
            raise StructureError(
                f"the pair (A2, C2) is not detectable: once the faults are removed, a motion of "
                f"{', '.join(moving)} with the mode {text}, which does not decay, leaves the "
                f"outputs {', '.join(plant.output_names)} unchanged (vertex {number + 1}). "
                f"Measure {moving[0]} as well",
                condition="detectability",
                symbols=moving,
                states=moving,
                mode=complex(mode),
                vertex_index=number,
            )
