"""Structural conditions of fault estimation with unknown inputs, checked before any design."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from obsynth.derive.errors import StructureError
from obsynth.derive.jacobian.bounds import JacobianBounds
from obsynth.derive.split import Split
from obsynth.derive.structure.decoupling import Decoupling, decouple

Array = NDArray[np.float64]
Modes = NDArray[np.complex128]
_RANK_TOLERANCE = 1e-9
_MODE_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Detectability:
    """Outcome of the test of Popov, Belevitch and Hautus at every vertex.

    Attributes
    ----------
    vertices : int
        Number of vertices tested.
    margin : float
        Smallest singular value found, with the columns scaled to norm one; 1 when no vertex has
        a mode that does not decay by itself.
    hidden_modes : tuple of complex
        Modes that no output sees at some vertex but that decay, the slowest last.
    """

    vertices: int
    margin: float
    hidden_modes: tuple[complex, ...]


def _rank(matrix: Array) -> int:
    if matrix.size == 0:
        return 0
    size = np.linalg.norm(matrix, axis=0)
    scaled = matrix / np.where(size > 0.0, size, 1.0)
    return int(np.linalg.matrix_rank(scaled, tol=_RANK_TOLERANCE))


def _listed(names: list[str] | tuple[str, ...]) -> str:
    return ", ".join(names)


def unknown_input_condition(split: Split) -> Decoupling:
    """Check rank(D) = rank(C D) = q and return the matrices that decouple the unknown inputs.

    Assumption 4 and equation (13) of Buciakowski et al.

    Parameters
    ----------
    split : Split
        The plant's matrices.

    Returns
    -------
    Decoupling
        E, T and Pi.

    Raises
    ------
    StructureError
        The unknown inputs cannot be decoupled; ``symbols`` names those concerned, ``states`` what
        they act on, ``rank_D`` and ``rank_CD`` are the numbers.

    Examples
    --------
    >>> from obsynth.derive.split import split
    >>> from obsynth.symbolic.plants import quadruple_tank
    >>> parts = split(quadruple_tank().discretise("euler", Ts=1.0))
    >>> np.diag(unknown_input_condition(parts).T).tolist()
    [1.0, 1.0, 0.0, 1.0]
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
            f"{_listed(dead)} enters no equation"
            if dead
            else f"{_listed(names)} act on the states in the same way and cannot be told apart"
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
            f"rank(C D) = {rank_CD} but rank(D) = {q}: the unknown input {_listed(symbols)} acts "
            f"on {_listed(acts)}, and no output ({_listed(model.output_names)}) shows it one step "
            f"later{more}. Measure {acts[0]}, or treat {symbols[0]} as a bounded disturbance",
            condition="rank(C D) = rank(D)",
            rank_D=rank_D,
            rank_CD=rank_CD,
            q=q,
            symbols=tuple(symbols),
            states=tuple(acts),
        )
    return decouple(C, D)


def _null_vectors(matrix: Array) -> Array:
    _, values, vectors = np.linalg.svd(matrix, full_matrices=True)
    full = np.zeros(matrix.shape[1])
    full[: len(values)] = values
    chosen = full <= _RANK_TOLERANCE * max(float(full.max(initial=0.0)), 1.0)
    return np.asarray(vectors[chosen].T)


def augmented_pair(split: Split, decoupling: Decoupling, M: Array) -> tuple[Array, Array]:
    """State and faults after the unknown inputs are removed.

    Equations (14)-(17) of Buciakowski et al. with M added to A; sensor faults, which the paper
    does not have, enter through D_f.

    Parameters
    ----------
    split : Split
        The plant's matrices.
    decoupling : Decoupling
        From `unknown_input_condition`.
    M : ndarray, shape (n, n)
        A matrix of the Jacobian family of g.

    Returns
    -------
    (ndarray, ndarray)
        [T (A + M), T B_f + E D_f; 0, I] (0 in place of I in continuous time) and [C, D_f].
    """
    n, n_f = split.B_f.shape
    keep = np.eye(n_f) if split.model.Ts is not None else np.zeros((n_f, n_f))
    top = np.hstack(
        [decoupling.T @ (split.A + M), decoupling.T @ split.B_f + decoupling.E @ split.D_f]
    )
    return np.vstack([top, np.hstack([np.zeros((n_f, n)), keep])]), np.hstack([split.C, split.D_f])


def _modes(matrix: Array, n: int, discrete: bool) -> tuple[list[complex], list[complex]]:
    """Eigenvalues that do not decay, and the others; the faults' own mode is exact."""
    values = [complex(v) for v in np.linalg.eigvals(matrix[:n, :n])]
    stays = [
        v
        for v in values
        if (abs(v) >= 1.0 - _MODE_TOLERANCE if discrete else v.real >= -_MODE_TOLERANCE)
    ]
    decays = [v for v in values if v not in stays]
    if len(matrix) > n:
        stays.insert(0, complex(1.0 if discrete else 0.0))
    return stays, decays


def _hidden(matrix: Array, outputs: Array, mode: complex) -> tuple[float, Modes]:
    """Smallest singular value of [mode I - A; C] with scaled columns, and the null vectors."""
    pencil = np.vstack([mode * np.eye(len(matrix)) - matrix, outputs.astype(complex)])
    size = np.linalg.norm(pencil, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    _, values, vectors = np.linalg.svd(pencil / size)
    null = vectors[values <= _RANK_TOLERANCE].conj().T / size[:, None]
    return float(values[-1]), np.asarray(null, dtype=np.complex128)


def detectability(split: Split, bounds: JacobianBounds) -> Detectability:
    """Test that state and faults can be detected at every vertex of the Jacobian family.

    The pair [T (A + M), T B_f; 0, I], [C, 0] must not have a mode of modulus >= 1 (real part >= 0
    in continuous time) that leaves all outputs at zero. Necessary for a design; the matrix
    inequalities are what suffices.

    Parameters
    ----------
    split : Split
        The plant's matrices.
    bounds : JacobianBounds
        Bounds of dg/dx.

    Returns
    -------
    Detectability
        Number of vertices, smallest margin, hidden modes that decay.

    Raises
    ------
    StructureError
        Faults or states that cannot be detected, in ``symbols``, with the mode and the vertex; or
        unknown inputs that cannot be decoupled.

    Examples
    --------
    >>> from obsynth.derive.jacobian.bounds import jacobian_bounds
    >>> from obsynth.derive.split import split
    >>> from obsynth.symbolic.plants import quadruple_tank
    >>> parts = split(quadruple_tank().discretise("euler", Ts=1.0))
    >>> detectability(parts, jacobian_bounds(parts)).vertices
    16
    """
    decoupling = unknown_input_condition(split)
    model = split.model
    discrete = model.Ts is not None
    states, faults = model.names("x"), model.names("f")
    vertices = bounds.vertices()
    margin = 1.0
    decaying: set[complex] = set()
    for index, M in enumerate(vertices):
        matrix, outputs = augmented_pair(split, decoupling, M)
        stays, decays = _modes(matrix, len(states), discrete)
        for mode in stays:
            smallest, null = _hidden(matrix, outputs, mode)
            if null.shape[1]:
                raise _undetectable(mode, null, states, faults, index, M, model.output_names)
            margin = min(margin, smallest)
        for mode in decays:
            if abs(mode) > _MODE_TOLERANCE and _hidden(matrix, outputs, mode)[1].shape[1]:
                decaying.add(complex(round(mode.real, 9), round(mode.imag, 9)))
    ordered = sorted(decaying, key=lambda v: abs(v) if discrete else v.real)
    return Detectability(len(vertices), margin, tuple(ordered))


def _undetectable(
    mode: complex,
    null: Modes,
    states: tuple[str, ...],
    faults: tuple[str, ...],
    index: int,
    M: Array,
    outputs: tuple[str, ...],
) -> StructureError:
    names = (*states, *faults)
    n = len(states)
    size = np.abs(null).max(axis=1)
    wrong_faults = [faults[k] for k in range(len(faults)) if size[n + k] > 1e-6 * size.max()]
    moving = [states[k] for k in range(n) if size[k] > 1e-6 * size.max()]
    blamed = wrong_faults or moving
    kind = "fault" if wrong_faults else "state"
    value = f"{mode.real:.6g}" if abs(mode.imag) < 1e-12 else f"{mode:.6g}"
    column = null[:, int(np.argmax(np.abs(null).max(axis=0)))]
    pivot = names.index(blamed[0])
    ratio = column / column[pivot] if abs(column[pivot]) > 0.0 else column
    motion = ", ".join(
        f"{name} = {r.real:.4g} {blamed[0]}"
        for name, r in zip(names, ratio, strict=True)
        if name != blamed[0] and abs(r) > 1e-6
    )
    hidden = f" together with {motion}" if motion else ""
    return StructureError(
        f"the {kind} {_listed(blamed)} cannot be detected: a motion of {blamed[0]}{hidden} (mode "
        f"{value}, which does not decay) leaves the outputs {_listed(outputs)} unchanged once the "
        f"unknown inputs are removed (vertex {index + 1} of the Jacobian family). Measure "
        f"{moving[0] if moving else blamed[0]} as well, or declare {blamed[0]} differently",
        condition="detectability",
        symbols=tuple(blamed),
        symbol=blamed[0],
        states=tuple(moving),
        mode=mode,
        vertex=M,
        vertex_index=index,
    )
