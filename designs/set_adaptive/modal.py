"""A choice of coordinates and gain for plants whose own coordinates have no Metzler error matrix.

Real modal coordinates of A - L C, row by row: docs/methods/set_adaptive_observer.md, Other
coordinates. Nothing that is proved rests on the choice.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from obsynth.designs.core.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.set_adaptive.gain import Gain, analyse_gain, design_gain, least_excess
from obsynth.designs.set_adaptive.model import SetModel
from obsynth.symbolic.arrays import FloatArray

_RATES, _RATIOS = np.geomspace(0.05, 20.0, 25), (1.1, 1.4, 2.0, 3.0)
"""Of the slowest mode, in units of the size of A, and from one mode to the next."""
_SHARE = 32.0
"""What a step is of the fastest time constant, at most."""
_MOVING = 0.2
"""What the outputs move at, in shares of what they can."""
_ROUNDS = 20


@dataclass(frozen=True, eq=False)
class Choice:
    """Coordinates with a gain.

    S, D (n, n); gain: L of z (n, m), with the vector and the decay of D
    """

    S: FloatArray
    D: FloatArray
    gain: Gain

    @property
    def L(self) -> FloatArray:
        """The gain in the plant's coordinates, rounded."""
        return np.asarray(np.linalg.solve(self.S, self.gain.L))


def middle(model: SetModel) -> tuple[FloatArray, FloatArray]:
    """Return the middle of the bounds of A over the ranges, and their half width."""
    low, high = model.A_span
    return 0.5 * (low + high), 0.5 * (high - low)


def complete(model: SetModel, S: FloatArray, K: FloatArray) -> Choice:
    """Return S (A - L C) S^-1 for a gain in coordinates, without what is negative in it."""
    A = middle(model)[0]
    D = np.linalg.solve(S.T, (S @ A - K @ model.C).T).T
    tiny = 1e-12 * float(np.abs(D).max())
    kept: FloatArray = np.where(np.eye(len(D), dtype=bool), D, np.where(D - tiny > 0.0, D, 0.0))
    return Choice(S, kept, Gain(K, *_decay(kept)))


def _decay(D: FloatArray) -> tuple[FloatArray, float]:
    found = analyse_gain(D, D, np.zeros((0, len(D))), np.zeros((len(D), 0)))
    return found.p, found.alpha


def given_coordinates(model: SetModel, S: FloatArray, cap: float) -> Choice:
    """Return the gain of the fastest decay in given coordinates."""
    A, C = S @ middle(model)[0] @ np.linalg.inv(S), model.C @ np.linalg.inv(S)
    A = A + least_excess(A, C, cap)
    names = tuple(f"z{i + 1}" for i in range(len(S)))
    gain = design_gain(A, A, C, cap, names, lambda K: complete(model, S, K).gain)
    return complete(model, S, gain.L)


def modal_coordinates(model: SetModel, cap: float, Ts: float | None) -> Choice:
    """Return the real modal coordinates whose predicted widths are the smallest."""
    best, least, needed = None, np.inf, np.inf
    for S, K in _candidates(*middle(model)[:1], model.C):
        found = complete(model, S, K)
        if found.gain.alpha <= 0.0:
            continue
        largest = float(np.abs(found.L).max(initial=0.0))
        needed = min(needed, largest)
        cost = predicted_cost(model, found, Ts) if largest <= cap else np.inf
        if cost < least:
            best, least = found, cost
    if best is None:
        lines = [
            f"the smallest that was found has entries of {needed:.4g}: raise gain_cap"
            if np.isfinite(needed)
            else "modes that no output sees have to be real and decay: measure more states"
        ]
        raise SolverTrouble(
            f"no real modal coordinates of A - L C were found with |L| <= {cap:g}", lines
        )
    return best


def modes_of(model: SetModel, L: FloatArray) -> Choice:
    """Return the real modal coordinates of a given gain."""
    M = middle(model)[0] - L @ model.C
    values, vectors = np.linalg.eig(M)
    size = np.abs(M).max()
    if np.abs(values.imag).max() > 1e-9 * size or np.linalg.cond(vectors) > 1e8:
        raise InfeasibleDesign(
            "A - L C has no real modes of its own for this gain",
            [f"its eigenvalues are {np.array2string(values, precision=5)}"],
        )
    S = scaled(np.linalg.inv(vectors.real))
    return complete(model, S, S @ L)


def scaled(S: FloatArray) -> FloatArray:
    """Return rows times powers of two, with entries up to one."""
    largest = np.abs(S).max(axis=1, keepdims=True)
    return np.asarray(S / 2.0 ** np.ceil(np.log2(largest)))


def _candidates(A: FloatArray, C: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
    n, m = len(A), len(C)
    values, vectors = np.linalg.eig(A.T)
    right = np.linalg.pinv(vectors.T)
    shown = np.abs(C @ (right / np.linalg.norm(right, axis=0))).max(axis=0)
    hidden = shown <= 1e-9 * np.abs(C).max()
    if np.any(np.abs(values[hidden].imag) > 1e-9 * np.abs(A).max()):
        return
    kept = vectors.real.T[hidden]
    size = max(float(np.linalg.norm(A, 2)), 1e-12)
    for rate, ratio, first in product(size * _RATES, _RATIOS, range(m)):
        rows, gains = [*kept], [np.zeros(m)] * len(kept)
        for i in range(n - len(kept)):
            gain = np.eye(m)[(first + i) % m]
            M = A.T + rate * ratio**i * np.eye(n)
            if np.linalg.cond(M) < 1e10:
                rows.append(np.linalg.solve(M, C.T @ gain))
                gains.append(gain)
        if len(rows) == n:
            S, K = np.array(rows), np.array(gains)
            scale = 2.0 ** -np.ceil(np.log2(np.abs(S).max(axis=1, keepdims=True)))
            if np.linalg.cond(scale * S) < 1e8:
                yield scale * S, scale * K


def predicted_cost(model: SetModel, found: Choice, Ts: float | None) -> float:
    """Return half widths of faults and states s in the long run, summed as s / (1 + s)."""
    S, K, D = found.S, found.gain.L, found.D
    plant, back = model.plant, np.linalg.inv(S)
    A, varies = middle(model)
    x, f = (0.5 * np.diff(plant.box(kind))[:, 0] for kind in ("x", "f"))
    speed = _MOVING * np.abs(model.rate).max(axis=1)
    step = 1.0 / (_SHARE * -np.diag(D).min()) if Ts is None else Ts
    told = model.noise + step * speed
    known = np.where(model.C.any(axis=0), model.C.T @ told, x)
    left = np.abs(S @ A - D @ S - K @ model.C) + np.abs(S) @ varies
    spread = np.abs(K) @ told + np.abs(S @ model.W1) @ model.w_radius + left @ known
    C, G = model.C @ back, S @ model.G
    wide = np.linalg.solve(-D, spread)
    N = np.abs(C @ np.linalg.solve(-D, G))
    base = (model.noise + np.abs(C) @ wide)[:, None]
    half = f.copy()
    for _ in range(_ROUNDS):
        with np.errstate(divide="ignore", invalid="ignore"):
            said = (base + N @ half[:, None] - N * half) / N
        half = np.minimum(f, np.nan_to_num(said, nan=np.inf).min(axis=0))
    settled = np.abs(back) @ np.linalg.solve(-D, spread + np.abs(G) @ half)
    shares = np.concatenate([half / f, settled / np.maximum(x, 1e-300)])
    return float((shares / (1.0 + shares)).sum())
