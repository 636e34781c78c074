"""Structural conditions: can unknown inputs be decoupled, can what is left be detected?"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from obsynth.derive.errors import StructureError
from obsynth.derive.jacobian.bounds import JacobianBounds
from obsynth.derive.rigour import ExactMatrix
from obsynth.derive.split import Split
from obsynth.symbolic.arrays import FloatArray

Numbers = NDArray[np.complex128]
_RANK_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Decoupling:
    """Matrices that remove the unknown input from the estimation error: E of eq. (13), as stored.

    T and Pi are ``I + E C`` and ``I + C E`` rounded to doubles, the rank is that of D and of C D.

    residual: largest entry of ``|(I + E C) D|`` for the stored doubles, computed exactly: 0 where
        the decoupling is exact
    """

    E: FloatArray
    T: FloatArray
    Pi: FloatArray
    rank: int
    residual: float


def decouple(C: FloatArray, D: FloatArray) -> Decoupling:
    """Compute E, T and Pi in exact arithmetic and round them to doubles.

    Buciakowski et al., eqs. (13)-(14); C (m, n), D (n, q). Refuses a C D without full column rank.
    """
    C = np.asarray(C, dtype=float)
    m, n = C.shape
    q = D.shape[1]
    if q == 0:
        return Decoupling(np.zeros((n, m)), np.eye(n), np.eye(m), 0, 0.0)
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
    return Decoupling(E, T, Pi, q, residual)


def column_sizes(matrix: FloatArray | Numbers) -> FloatArray:
    """Return the norms of the columns, 1 for zeros."""
    size = np.linalg.norm(matrix, axis=0)
    return np.asarray(np.where(size > 0.0, size, 1.0))


def scaled_rank(matrix: FloatArray | Numbers) -> int:
    """Rank of a matrix with columns of size one."""
    if matrix.size == 0:
        return 0
    return int(np.linalg.matrix_rank(matrix / column_sizes(matrix), tol=_RANK_TOLERANCE))


def mode_text(mode: complex) -> str:
    """Return six digits of a mode, without an imaginary part of zero."""
    return f"{mode.real:.6g}" if mode.imag == 0 else f"{mode:.6g}"


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
    rank_D, rank_CD = scaled_rank(D), scaled_rank(CD)
    if rank_D < q:
        dead = [names[j] for j in range(q) if not D[:, j].any()]
        what = (
            f"{', '.join(dead)} enters no equation"
            if dead
            else f"{', '.join(names)} act on the states in the same way and cannot be told apart"
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
        outputs = ", ".join(model.output_names)
        more = f"; {q} unknown inputs need at least {q} outputs" if m < q else ""
        raise StructureError(
            f"rank(C D) = {rank_CD} but rank(D) = {q}: the unknown input {', '.join(symbols)} acts "
            f"on {', '.join(acts)}, and no output ({outputs}) shows it one step later{more}. "
            f"Measure {acts[0]}, or treat {symbols[0]} as a bounded disturbance",
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


_STARTS = 2
_RANDOM = 64
_HIDDEN = 1e-9
_MODE_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Detectability:
    """Outcome of the test of Popov, Belevitch and Hautus at every vertex.

    margin: smallest singular value, with columns of norm one; 1 when every mode decays by itself
    hidden_modes: modes that no output sees at some vertex but that decay, the slowest last
    """

    vertices: int
    margin: float
    hidden_modes: tuple[complex, ...]


def augmented_pair(
    split: Split, decoupling: Decoupling, M: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return state and faults after the unknown inputs are removed, M (n, n) a Jacobian of g.

    [T (A + M), T B_f + E D_f; 0, I] (0 in place of I in continuous time) and [C, D_f], eqs.
    (14)-(17) of Buciakowski et al. with sensor faults.
    """
    n, n_f = split.B_f.shape
    keep = np.eye(n_f) if split.model.Ts is not None else np.zeros((n_f, n_f))
    top = np.hstack(
        [decoupling.T @ (split.A + M), decoupling.T @ split.B_f + decoupling.E @ split.D_f]
    )
    return np.vstack([top, np.hstack([np.zeros((n_f, n)), keep])]), np.hstack([split.C, split.D_f])


def _stays(mode: complex, discrete: bool) -> bool:
    return abs(mode) >= 1.0 - _MODE_TOLERANCE if discrete else mode.real >= -_MODE_TOLERANCE


def _modes(matrix: FloatArray, n: int, discrete: bool) -> tuple[list[complex], list[complex]]:
    """Eigenvalues that do not decay, and the others; the faults' own mode is exact."""
    values = [complex(v) for v in np.linalg.eigvals(matrix[:n, :n])]
    stays = [v for v in values if _stays(v, discrete)]
    decays = [v for v in values if v not in stays]
    if len(matrix) > n:
        stays.insert(0, complex(1.0 if discrete else 0.0))
    return stays, decays


def _hidden(matrix: FloatArray, outputs: FloatArray, mode: complex) -> tuple[float, Numbers]:
    """Smallest singular value of [mode I - A; C] with scaled columns, and the null vectors."""
    pencil = np.vstack([mode * np.eye(len(matrix)) - matrix, outputs.astype(complex)])
    size = column_sizes(pencil)
    _, values, vectors = np.linalg.svd(pencil / size)
    null = vectors[values <= _RANK_TOLERANCE].conj().T / size[:, None]
    return float(values[-1]), np.asarray(null, dtype=np.complex128)


def detectability(split: Split, bounds: JacobianBounds) -> Detectability:
    """Test that state and faults can be detected at every vertex of the Jacobian family.

    No mode of modulus >= 1 (real part >= 0) of `augmented_pair` may leave all outputs at zero:
    necessary, while the matrix inequalities suffice.
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
    null: Numbers,
    states: tuple[str, ...],
    faults: tuple[str, ...],
    index: int,
    M: FloatArray,
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
        f"the {kind} {', '.join(blamed)} cannot be detected: a motion of {blamed[0]}{hidden} (mode "
        f"{value}, which does not decay) leaves the outputs {', '.join(outputs)} unchanged once "
        f"the unknown inputs are removed (vertex {index + 1} of the Jacobian family). Measure "
        f"{moving[0] if moving else blamed[0]} as well, or declare {blamed[0]} differently",
        condition="detectability",
        symbols=tuple(blamed),
        symbol=blamed[0],
        states=tuple(moving),
        mode=mode,
        vertex=M,
        vertex_index=index,
    )


@dataclass(frozen=True, eq=False)
class WeakestMember:
    """The member of a Jacobian family that is hardest to observe, as far as a search finds it.

    margin: smallest singular value of [z I - A; C] with columns of size one, over the modes z that
    do not decay; mode: None when all decay everywhere
    """

    margin: float
    mode: complex | None
    members: int

    def __str__(self) -> str:
        if self.mode is None:
            return f"all modes decay by themselves ({self.members} members of the family)"
        return (
            f"smallest margin {self.margin:.2g}, mode {mode_text(self.mode)} "
            f"({self.members} members of the family, a search and no proof)"
        )


def pair_margin(A: FloatArray, C: FloatArray, discrete: bool) -> tuple[float, complex | None]:
    """Distance of a pair from a hidden mode that does not decay."""
    margin, where = 1.0, None
    for mode in np.linalg.eigvals(A).tolist():
        if not _stays(mode, discrete):
            continue
        value, _ = _hidden(A, C, mode)
        if value < margin or where is None:
            margin, where = min(value, margin), complex(mode)
    return margin, where


def weakest_member(split: Split, bounds: JacobianBounds) -> WeakestMember:
    """Search the Jacobian family for a member whose state or faults cannot be detected.

    Detectable vertices do not make a detectable polytope: with x2 seen through s x2 only, s = -1
    and s = 1 are fine and s = 0 is not. So the middle, zeros of scalars and random members are
    looked at.
    """
    from scipy.optimize import minimize

    decoupling = unknown_input_condition(split)
    family = bounds.family
    low, high = family.ranges[:, 0], family.ranges[:, 1]
    discrete = split.model.Ts is not None
    looked = 0

    def margin(scalars: FloatArray) -> tuple[float, complex | None]:
        nonlocal looked
        looked += 1
        inside = np.clip(scalars, low, high)
        return pair_margin(*augmented_pair(split, decoupling, family.at(inside)), discrete)

    middle = 0.5 * (low + high)
    starts = [middle]
    for k in np.flatnonzero((low < 0.0) & (high > 0.0)).tolist():
        crossing = middle.copy()
        crossing[k] = 0.0
        starts.append(crossing)
    starts.append(np.clip(np.zeros_like(middle), low, high))
    rng = np.random.default_rng(0)
    starts += list(low + rng.random((_RANDOM if len(low) else 0, len(low))) * (high - low))
    scored = sorted(((margin(s)[0], k) for k, s in enumerate(starts)), key=lambda pair: pair[0])
    best, best_margin = starts[scored[0][1]], scored[0][0]
    width = np.where(high > low, high - low, 1.0)
    for value, k in scored[:_STARTS]:
        if value >= 1.0 or not len(low):
            break
        found = minimize(
            lambda share: margin(low + share * width)[0],
            (starts[k] - low) / width,
            method="Nelder-Mead",
            bounds=[(0.0, 1.0)] * len(low),
            options={"maxfev": 40 * len(low), "xatol": 1e-10, "fatol": 1e-12},
        )
        if found.fun < best_margin:
            best, best_margin = np.clip(low + found.x * width, low, high), float(found.fun)
    value, mode = margin(best)
    if mode is not None and value <= _HIDDEN:
        scalars = dict(zip(family.labels, best.tolist(), strict=True))
        listed = ", ".join(f"{name} = {s:.6g}" for name, s in scalars.items())
        raise StructureError(
            f"state and faults cannot be detected where {listed}, inside the Jacobian family: the "
            f"mode {mode:.6g} does not decay and no output shows it. Narrow the ranges so that "
            "they avoid this point, or measure more",
            condition="detectability inside the polytope",
            scalars=scalars,
            mode=mode,
            matrix=family.at(best),
        )
    return WeakestMember(value, mode, looked)
