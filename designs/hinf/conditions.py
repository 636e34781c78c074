"""Structural conditions of the method, checked before any inequality, with the user's names."""

from __future__ import annotations

import numpy as np

from obsynth.derive import Split
from obsynth.derive.errors import StructureError
from obsynth.symbolic import Plant, Role
from obsynth.symbolic.arrays import FloatArray

RANK = 1e-9


def check_class(model: Plant) -> None:
    """Refuse what is outside x+ = A x + B u + g(x, u) + L f + W w, y = C x."""
    if model.Ts is None:
        raise StructureError(
            f"{model.name} is in continuous time and the H-infinity unknown input observer works "
            'in discrete time: call discretise("euler", Ts=...) first'
        )
    for kind, what, remedy in (
        ("p", "parameter", "give it a value, or declare its effect as a disturbance"),
        ("rho", "scheduling variable", "declare it as an input, whose range bounds it"),
    ):
        names = model.names(kind)
        if names:
            raise StructureError(
                f"{what} {', '.join(names)}: this method has none; {remedy}", symbols=names
            )
    sensors = tuple(s.name for s in model.f if s.role is Role.SENSOR_FAULT)
    if sensors:
        raise StructureError(
            f"sensor fault {', '.join(sensors)}: this method estimates faults that enter the "
            "dynamics (actuator and process faults)",
            symbols=sensors,
        )
    if not model.f:
        raise StructureError(
            f"{model.name} has no fault to estimate: declare actuator_faults or faults"
        )
    if not model.w:
        raise StructureError(
            f"{model.name} has no disturbance, so there is nothing to attenuate: declare "
            "disturbances and put them into the dynamics"
        )


def check_outputs(parts: Split) -> None:
    """Refuse disturbances in the outputs: (22) has none."""
    rows, columns = np.nonzero(parts.W2)
    if rows.size:
        w = parts.model.names("w")[columns[0]]
        y = parts.model.output_names[rows[0]]
        raise StructureError(
            f"the disturbance {w} enters the output {y}, and equation (2) has none: make it a "
            f"state of its own, n_next = {w}, and write n in place of {w} in all equations and "
            "outputs, which delays it by one sample and changes no energy",
            symbol=w,
            row=y,
        )


def check_decoupling(parts: Split) -> FloatArray:
    """Check rank(C L) = rank(L) = s of (15) and return L, faults first, then unknown inputs."""
    check_outputs(parts)
    model = parts.model
    names = (*model.names("f"), *model.names("d"))
    L = np.hstack([parts.B_f, parts.D])
    s = L.shape[1]
    dead = [name for name, column in zip(names, L.T, strict=True) if not column.any()]
    if dead:
        raise StructureError(
            f"{', '.join(dead)} enters no equation; remove it", symbols=tuple(dead), rank_L=s
        )
    CL = parts.C @ L
    ranks = [_rank(L), _rank(CL)]
    if ranks[1] < s:
        _, values, vectors = np.linalg.svd(_normalised(CL), full_matrices=True)
        full = np.zeros(s)
        full[: len(values)] = values
        lost = vectors[full <= RANK * max(1.0, full.max())]
        blamed = tuple(n for j, n in enumerate(names) if np.abs(lost[:, j]).max() > 1e-6)
        acts = [x for i, x in enumerate(model.names("x")) if np.abs(L[i] @ lost.T).max() > 1e-9]
        where = f" acts on {', '.join(acts)}, but" if acts else ""
        raise StructureError(
            f"rank(C L) = {ranks[1]} and rank(L) = {ranks[0]} for {s} faults and unknown inputs: "
            f"{', '.join(blamed)}{where} cannot be told from the outputs "
            f"({', '.join(model.output_names)}) one sample later, which (15) needs. Measure "
            f"{acts[0] if acts else 'another state'} as well, or merge what acts alike",
            symbols=blamed,
            states=tuple(acts),
            rank_L=ranks[0],
            rank_CL=ranks[1],
            required=s,
        )
    return L


def _normalised(matrix: FloatArray) -> FloatArray:
    size = np.linalg.norm(matrix, axis=0)
    return np.asarray(matrix / np.where(size > 0.0, size, 1.0))


def _rank(matrix: FloatArray) -> int:
    return int(np.linalg.matrix_rank(_normalised(matrix), tol=RANK))


def check_detectability(parts: Split, L: FloatArray, G: FloatArray, vertices: FloatArray) -> None:
    """Test the pair (G (A + M), C) at every vertex: the zeros of (A + M, L, C) have to be stable.

    Observability of (A, C), which the paper asks for beside (15), is not enough: a zero is a
    motion that the fault hides, however well the state could be seen without it.
    """
    n = len(parts.A)
    names = parts.model.names("x")
    for index, M in enumerate(vertices):
        matrix = G @ (parts.A + M)
        for mode in np.linalg.eigvals(matrix):
            if abs(mode) < 1.0 - RANK:
                continue
            pencil = np.vstack([mode * np.eye(n) - matrix, parts.C.astype(complex)])
            # Columns are measured before they cancel, so that what rounding leaves stays small.
            terms = np.vstack([abs(mode) * np.eye(n) + np.abs(matrix), np.abs(parts.C)])
            size = np.linalg.norm(terms, axis=0)
            _, values, vectors = np.linalg.svd(pencil / size)
            if values[-1] > RANK:
                continue
            motion = np.abs(vectors[-1]) / size
            moving = [x for x, size in zip(names, motion, strict=True) if size > 1e-6 * max(motion)]
            raise StructureError(
                f"the states {', '.join(moving)} have a motion with the mode {mode:.6g}, which "
                "does not decay, that a fault hides from the outputs (a zero of (A + M, L, C) at "
                f"vertex {index + 1} of the Jacobian family): no gain makes the error decay. "
                f"Measure {moving[0]} as well",
                condition="detectability",
                symbols=tuple(moving),
                mode=complex(mode),
                vertex=M,
                vertex_index=index,
            )
