"""The gain by linear programming, and coordinates in which there is one: nothing proved needs it.

A_m - L C and A_M - L C are made Metzler and Hurwitz with one p. The conditions (the method's page,
Gain) are linear in p and W = diag(p) L for a fixed decay alpha; the largest alpha is found by a
ratio iteration in which every iterate is a design. (The paper's L = p w' solves neither p'L = w'
nor the Metzler condition.) Coordinates are real modes of A - L C, row by row (Other coordinates).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from obsynth.designs.core.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.lmi.expression import diagonal, full, scalar, trace
from obsynth.designs.lmi.problem import Problem
from obsynth.designs.set_adaptive.model import SetModel
from obsynth.symbolic.arrays import FloatArray

_ITERATIONS = 40
_SHIFT = 1e-12
_LEAST = 1e-9
_OTHER = 'in other coordinates it may be: coordinates="auto"'
# Rounds gains down to a grid: a smaller entry only raises the off-diagonal entries of A - L C.
_GRID = 2.0**40
_RATES, _RATIOS = np.geomspace(0.05, 20.0, 25), (1.1, 1.4, 2.0, 3.0)
"""Of the slowest mode, in units of the size of A, and from one mode to the next."""
_SHARE = 32.0
"""What a step is of the fastest time constant, at most."""
_MOVING = 0.2
"""What the outputs move at, in shares of what they can."""
_ROUNDS = 20


@dataclass(frozen=True, eq=False)
class Gain:
    """A gain L (n, m), and p (n,) > 0, alpha that certify it: p'(A_upper - L C) <= -alpha p'."""

    L: FloatArray
    p: FloatArray
    alpha: float


def design_gain(
    A_lower: FloatArray,
    A_upper: FloatArray,
    C: FloatArray,
    cap: float,
    names: tuple[str, ...] = (),
    judge: Callable[[FloatArray], Gain] | None = None,
) -> Gain:
    """Return the gain of the fastest decay with entries up to `cap`, as `judge` values it."""
    alpha, best = -np.inf, None
    if judge is None:
        _require_metzler(A_lower, C, cap, names)
    bound = float(np.abs(A_upper).sum() + cap * np.abs(C).sum())
    guess = -bound
    for _ in range(_ITERATIONS):
        p, W = _feasible(A_lower, A_upper, C, cap, guess)
        L = np.clip(W / p[:, None], -cap, cap)
        gain = judge(L) if judge else analyse_gain(A_lower, A_upper, C, _metzler(L, A_lower, C))
        if best is None or gain.alpha > alpha:
            step, alpha, best = gain.alpha - alpha, gain.alpha, gain
            if step <= _SHIFT * bound:
                break
            guess = alpha
        else:
            break
    if best is None or best.alpha <= 0.0:
        raise _refusal(A_upper, C, cap, alpha, names)
    return best


def analyse_gain(A_lower: FloatArray, A_upper: FloatArray, C: FloatArray, L: FloatArray) -> Gain:
    """Return p, a Perron vector, and the largest decay of a gain; negative if it is unstable."""
    lacking = off_diagonal(A_lower - L @ C)
    if lacking.min(initial=0.0) < 0.0:
        i, j = np.unravel_index(np.argmin(lacking), lacking.shape)
        raise InfeasibleDesign(
            "A_m - L C is not Metzler for this gain",
            [f"entry ({i + 1}, {j + 1}) is as low as {lacking[i, j]:.6g}: lower L there", _OTHER],
            entry=(int(i), int(j)),
        )
    M = A_upper - L @ C
    size = float(np.abs(M).max(initial=1e-300))
    best: Gain | None = None
    for coupling in (0.0, 1e-12, 1e-9, 1e-6):
        values, vectors = np.linalg.eig(M.T + coupling * size)
        p = np.real(vectors[:, int(np.argmax(values.real))])
        p = p / p.sum()
        if p.min() <= 1e-12:
            continue
        alpha = float((-(p @ M) / p).min())
        found = Gain(L, p, alpha - 1e-12 * (size + abs(alpha)))
        if best is None or found.alpha > best.alpha:
            best = found
    if best is None:
        raise SolverTrouble("no positive vector p was found for the Metzler matrix A_M - L C")
    return best


def gain_problem(
    A_lower: FloatArray, A_upper: FloatArray, C: FloatArray, cap: float, alpha: float
) -> Problem:
    """Return the program for a decay; variables P = diag(p), W = P L, R = diag(r), margin."""
    n, m = A_lower.shape[0], C.shape[0]
    problem = Problem("gain of the set adaptive observer")
    P, R, W, t = diagonal("P", n), diagonal("R", n), full("W", n, m), scalar("margin")
    ones = np.ones((1, n))
    problem.add("positive p", P >= 0.0)
    problem.add("positive r", R >= 0.0)
    problem.add_equality("size of p", trace(P) - np.ones((1, 1)))
    problem.add("Metzler", P @ A_lower - W @ C + R >= 0.0)
    decay = ones @ (P @ A_upper - W @ C) + alpha * (ones @ P)
    problem.add("decay", -1.0 * decay - t @ ones >= 0.0)
    for name, sign in (("cap from above", 1.0), ("cap from below", -1.0)):
        problem.add(name, cap * (P @ np.ones((n, m))) - sign * W >= 0.0)
    problem.maximise(t)
    return problem


def settled_response(M: FloatArray, C: FloatArray, G: FloatArray) -> FloatArray:
    """Return |C M^-1 G|, where N settles, (m, n_f); a thousandth of its terms where they cancel."""
    settled, terms = C @ np.linalg.solve(M, G), np.abs(C) @ np.linalg.solve(M, np.abs(G))
    return np.asarray(np.maximum(np.abs(settled), 1e-3 * terms))


def off_diagonal(matrix: FloatArray) -> FloatArray:
    """Return a copy with zeros on the diagonal."""
    result = matrix.copy()
    np.fill_diagonal(result, 0.0)
    return result


def _feasible(
    A_lower: FloatArray, A_upper: FloatArray, C: FloatArray, cap: float, alpha: float
) -> tuple[FloatArray, FloatArray]:
    """Solve max t with p'A_upper - 1'W C + alpha p' <= -t p_j-independent margin, p normalised."""
    from scipy.optimize import linprog

    n, m = A_lower.shape[0], C.shape[0]

    def row(p: FloatArray, W: FloatArray, margin: float = 0.0) -> FloatArray:
        return np.concatenate([p, W.ravel(), [margin]])

    rows, none = [], np.zeros((n, m))
    for i, own in enumerate(np.eye(n)):
        rows += [row(-A_lower[i, j] * own, np.outer(own, C[:, j])) for j in range(n) if j != i]
        for unit in np.eye(m):
            rows += [row(-cap * own, np.outer(own, sign * unit)) for sign in (1.0, -1.0)]
    for j, own in enumerate(np.eye(n)):
        rows.append(row(A_upper[:, j] + alpha * own, np.tile(-C[:, j], (n, 1)), 1.0))
    total, objective = row(np.ones(n), none)[None], row(np.zeros(n), none, -1.0)
    limits = np.zeros(len(rows))
    bounds = [(_LEAST, None)] * n + [(None, None)] * (n * m) + [(None, None)]
    found = linprog(objective, np.array(rows), limits, total, [1.0], bounds, method="highs-ds")
    if found.x is None:
        raise SolverTrouble(f"the gain program was not solved: {found.message}")
    x = np.asarray(found.x)
    # the solver keeps to bounds within a tolerance that is larger than this one
    return np.maximum(x[:n], _LEAST), x[n:-1].reshape(n, m)


def _metzler(L: FloatArray, A_lower: FloatArray, C: FloatArray) -> FloatArray:
    """Lower a gain by what the solver's tolerance left of the Metzler condition."""
    L = np.where(np.abs(L) < 1e-9 * np.abs(L).max(initial=0.0), 0.0, L)
    L = np.floor(L * _GRID) / _GRID
    n = len(A_lower)
    for i in range(n):
        for j in range(n):
            excess = float(L[i] @ C[:, j]) - float(A_lower[i, j])
            if i != j and excess > 0.0:
                k = int(np.argmax(C[:, j]))
                L[i, k] -= (excess / C[k, j]) * (1.0 + 1e-9) + 2.0**-50 * abs(L[i, k])
    return L


def least_excess(A: FloatArray, C: FloatArray, cap: float) -> FloatArray:
    """Return what A lacks beside its diagonal for A - L C to be Metzler, the least sum of it."""
    from scipy.optimize import linprog

    n, m = len(A), len(C)
    lacks = np.zeros((n, n))
    beside = ~np.eye(n, dtype=bool)
    for i in range(n):
        shown, own = C[:, beside[i]].T, A[i, beside[i]]
        rows = np.hstack([shown, -np.eye(n - 1)])
        objective = np.r_[np.zeros(m), np.ones(n - 1)]
        limits = [(-cap, cap)] * m + [(0.0, None)] * (n - 1)
        found = linprog(objective, rows, own, bounds=limits, method="highs-ds")
        if found.x is None:
            raise SolverTrouble(f"the gain program was not solved: {found.message}")
        lacks[i, beside[i]] = found.x[m:] * (1.0 + 1e-9) + 1e-9 * np.abs(A).max()
    return lacks


def _require_metzler(
    A_lower: FloatArray, C: FloatArray, cap: float, names: tuple[str, ...]
) -> None:
    """Refuse what no gain within the cap makes Metzler, where outputs show single states."""
    best = off_diagonal(A_lower + cap * C.sum(axis=0))
    if best.min(initial=0.0) >= 0.0:
        return
    i, j = np.unravel_index(np.argmin(best), best.shape)
    to, of = (names[k] if names else f"state {k + 1}" for k in (i, j))
    why = f"no output shows {of}, so that no gain changes it"
    if C[:, j].any():
        why = f"an entry of L of {A_lower[i, j] / C[:, j].max():.6g} would do: raise gain_cap"
    raise InfeasibleDesign(
        "no gain makes A_m - L C Metzler",
        [f"what {of} does to {to} is as low as {A_lower[i, j]:.6g}; {why}", _OTHER],
        entry=(int(i), int(j)),
    )


def _refusal(
    A_upper: FloatArray, C: FloatArray, cap: float, alpha: float, names: tuple[str, ...]
) -> InfeasibleDesign:
    hidden = [i for i in range(len(A_upper)) if not C[:, i].any()]
    block = A_upper[np.ix_(hidden, hidden)]
    lines = [f"with |L| <= {cap:g} the best decay is {alpha:.6g}"]
    if hidden:
        own = float(np.linalg.eigvals(block).real.max())
        shown = ", ".join(names[i] for i in hidden) if names else str(hidden)
        lines.append(
            f"no gain acts on the unmeasured states ({shown}) alone; the bound of their block has "
            f"the eigenvalue {own:.6g}"
        )
        if own >= 0.0:
            lines.append("narrow the declared ranges, or measure one of these states")
    return InfeasibleDesign("no gain makes A_M - L C Hurwitz", lines, alpha=alpha)


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
