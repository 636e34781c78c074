"""How bad can it get: disturbances and operating points that make the fault error large."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from obsynth.designs.core.observer import Observer
from obsynth.designs.core.signals import noise_centre
from obsynth.designs.hinf.method import HinfUIO
from obsynth.designs.hinf.record import HinfDesign
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError
from obsynth.symbolic.shown import Shown

ComplexArray = NDArray[np.complex128]
FREQUENCIES = 48
REFINEMENTS = 6
NEWTON = 30
ROUNDS = 12
# Where a signal has no range, operating points are looked for within so many units of zero.
REACH = 10.0
# Distance kept from the ends of a range, as a share of its width: w moves the plant a little.
DISTANCE = 1e-3
Functions = tuple[ca.Function, ca.Function]
CHUNK = 500
# A longer disturbance is tried until the gain is this close to that of the linearisation.
CLOSE = 1.0 - 1e-6


@dataclass(frozen=True, eq=False)
class OperatingPoints:
    """Points x = f(x, u, v), v faults and d, with Jacobians (N, n, n) by x."""

    x: FloatArray
    u: FloatArray
    v: FloatArray
    jacobian: FloatArray

    def __len__(self) -> int:
        return len(self.x)

    def take(self, index: NDArray[np.intp]) -> OperatingPoints:
        """Return some of the points."""
        return OperatingPoints(self.x[index], self.u[index], self.v[index], self.jacobian[index])

    def joined(self, other: OperatingPoints) -> OperatingPoints:
        """Return the points of both."""
        pairs = ((getattr(self, k), getattr(other, k)) for k in ("x", "u", "v", "jacobian"))
        return OperatingPoints(*(np.concatenate(pair) for pair in pairs))


def _functions(model: Plant) -> Functions:
    """(x, u, v) -> rhs and its Jacobian by (x, u, v)."""
    n, n_u, n_f, n_d = (len(model.names(kind)) for kind in ("x", "u", "f", "d"))
    x, u, v = ca.SX.sym("x", n), ca.SX.sym("u", n_u), ca.SX.sym("v", n_f + n_d)
    quiet = [ca.DM(noise_centre(model)), *(ca.DM.zeros(len(model.names(k))) for k in ("p", "rho"))]
    value = model.function()(x, u, v[n_f:], v[:n_f], *quiet)[0]
    slopes = ca.densify(ca.jacobian(value, ca.vertcat(x, u, v)))
    return ca.Function("rhs", [x, u, v], [value]), ca.Function("slopes", [x, u, v], [slopes])


def _batch(function: ca.Function, *arguments: FloatArray) -> FloatArray:
    count = len(arguments[0])
    rows, columns = function.size_out(0)
    value = np.array(function.map(count)(*(a.T for a in arguments)))
    return np.moveaxis(value.reshape(rows, count, columns), 1, 0)


def hold_points(
    model: Plant, x: FloatArray, u: FloatArray, functions: Functions | None = None
) -> OperatingPoints:
    """Move points x (N, n), u (N, n_u) to the nearest that faults and d can hold, if any."""
    rhs, slopes = functions or _functions(model)
    n, n_u = x.shape[1], u.shape[1]
    z = np.hstack([x, u, np.zeros((len(x), rhs.size_in(2)[0]))])
    boxes = np.vstack([_inner(model.box("x")), model.box("u")])
    # v costs next to nothing, so that x and u stay where they were wanted if they can.
    weight = np.concatenate([np.ones(n + n_u), np.full(z.shape[1] - n - n_u, 1e4)])
    selector = np.eye(n, z.shape[1])

    def parts(points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        return points[:, :n], points[:, n : n + n_u], points[:, n + n_u :]

    for _ in range(NEWTON):
        residual = _batch(rhs, *parts(z))[:, :, 0] - z[:, :n]
        matrix = (_batch(slopes, *parts(z)) - selector) * weight
        usable = np.isfinite(matrix).all(axis=(1, 2)) & np.isfinite(residual).all(axis=1)
        z, matrix, residual = z[usable], matrix[usable], residual[usable]
        if not len(z):
            break
        step = weight * (np.linalg.pinv(matrix) @ residual[:, :, None])[:, :, 0]
        z = z - step
        z[:, : n + n_u] = np.clip(z[:, : n + n_u], boxes[:, 0], boxes[:, 1])
        if np.abs(step).max(initial=0.0) < 1e-13 * max(1.0, np.abs(z).max(initial=0.0)):
            break
    residual = _batch(rhs, *parts(z))[:, :, 0] - z[:, :n] if len(z) else np.zeros((0, n))
    size = 1.0 + np.abs(z).max(axis=1, initial=0.0)
    z = z[np.abs(residual).max(axis=1, initial=0.0) < 1e-10 * size]
    jacobian = _batch(slopes, *parts(z))[:, :, :n] if len(z) else np.zeros((0, n, n))
    return OperatingPoints(*parts(z), jacobian)


def frozen_gain(
    design: HinfDesign, jacobian: FloatArray, refinements: int = REFINEMENTS
) -> tuple[FloatArray, FloatArray, ComplexArray]:
    """Return peak gain, frequency and w (N, n_w) of errors linearised with Jacobians (N, n, n)."""
    gains, C, W = design.gains, design.C, design.W
    kept = np.eye(len(C.T)) - gains.F @ C
    loop = kept @ jacobian - gains.K @ C
    output = gains.H @ C @ jacobian + gains.D @ C
    modes = np.linalg.eigvals(loop)
    unstable = np.abs(modes).max(axis=1) >= 1.0
    common = np.linspace(0.0, np.pi, FREQUENCIES)
    grid = np.hstack([np.broadcast_to(common, (len(loop), FREQUENCIES)), np.abs(np.angle(modes))])
    eye = np.eye(loop.shape[-1])
    spacing = np.pi / (FREQUENCIES - 1)
    rows = np.arange(len(loop))
    for round_number in range(refinements + 1):
        z = np.exp(1j * grid)[:, :, None, None]
        response = np.linalg.solve(z * eye - loop[:, None], (kept @ W).astype(complex))
        transfer = output[:, None] @ response + gains.H @ C @ W
        # n_f is small, so the squares of the singular values are quicker than these.
        squares = np.linalg.eigvalsh(transfer @ np.conj(np.swapaxes(transfer, -1, -2)))[..., -1]
        best = np.argmax(squares, axis=1)
        peak = grid[rows, best]
        if round_number < refinements:
            width = spacing * 0.2**round_number
            grid = np.clip(peak[:, None] + np.linspace(-width, width, 11), 0.0, np.pi)
    _, sizes, right = np.linalg.svd(transfer[rows, best])
    return np.where(unstable, np.inf, sizes[:, 0]), peak, right[:, 0].conj()


def search_points(
    design: HinfDesign, count: int = 256, seed: int = 0, keep: int = 4
) -> OperatingPoints:
    """Find the operating points with the largest frozen gains: samples, then a random ascent."""
    rng = np.random.default_rng(seed)
    model, functions = design.plant, _functions(design.plant)
    boxes = [_finite(model.box(kind)) for kind in ("x", "u")]
    draws = [rng.uniform(b[:, 0], b[:, 1], (count, len(b))) for b in boxes]
    found = hold_points(model, draws[0], draws[1], functions)
    rest = [np.zeros((1, len(b))) for b in boxes]
    origin = hold_points(model, rest[0], rest[1], functions)
    found = found.joined(origin)
    if not len(found):
        return found
    gain = frozen_gain(design, found.jacobian, 1)[0]
    spread = 0.1
    for _ in range(ROUNDS):
        top = np.argsort(-gain, kind="stable")[:keep]
        found, gain = found.take(top), gain[top]
        near = [
            np.repeat(value, 16, axis=0)
            + spread * (b[:, 1] - b[:, 0]) * rng.standard_normal((16 * len(found), len(b)))
            for value, b in zip((found.x, found.u), boxes, strict=True)
        ]
        inside = [np.clip(v, b[:, 0], b[:, 1]) for v, b in zip(near, boxes, strict=True)]
        more = hold_points(model, inside[0], inside[1], functions)
        found = found.joined(more)
        gain = np.concatenate([gain, frozen_gain(design, more.jacobian, 1)[0]])
        spread *= 0.5
    return found.take(np.argsort(-gain, kind="stable")[:keep])


def _inner(box: FloatArray) -> FloatArray:
    width = box[:, 1] - box[:, 0]
    kept = np.where(np.isfinite(width), DISTANCE * width, 0.0)
    return np.column_stack([box[:, 0] + kept, box[:, 1] - kept])


def _finite(box: FloatArray) -> FloatArray:
    lower = np.where(np.isfinite(box[:, 0]), box[:, 0], np.minimum(box[:, 1], 0.0) - REACH)
    upper = np.where(np.isfinite(box[:, 1]), box[:, 1], np.maximum(lower, 0.0) + REACH)
    return np.column_stack([lower, upper])


@dataclass(frozen=True, eq=False, repr=False)
class WorstCase(Shown):
    """A disturbance that was simulated on the nonlinear plant, and what it did.

    Attributes
    ----------
    gain : float
        |f - fhat| / |w| of the simulation, from e_0 = 0: a lower bound of the worst-case gain.
    limit : float
        Gain of the linearised error at the operating point, approached by longer disturbances.
    x, u, v : ndarray of shape (n,), (n_u,), (s,)
        The operating point; v are the faults and unknown inputs that hold the plant there.
    frequency : float
        Of w, in radians per sample.
    w : ndarray of shape (N, n_w)
        About the middle of its range.
    error : ndarray of shape (N, n_f)
        f_k - fhat_k.
    certified : float
        The level that the observer's certificate proves.
    """

    gain: float
    limit: float
    x: FloatArray
    u: FloatArray
    v: FloatArray
    frequency: float
    w: FloatArray
    error: FloatArray
    certified: float

    def __str__(self) -> str:
        at = ", ".join(f"{value:.6g}" for value in self.x)
        return (
            f"worst case found: gain {self.gain:.7g} of at most {self.certified:.7g}, at "
            f"x = ({at}) with w at {self.frequency:.4g} rad per sample over {len(self.w)} samples"
        )


def worst_case(
    observer: Observer,
    steps: int = 20_000,
    points: int = 256,
    amplitude: float = 1e-4,
    seed: int = 0,
) -> WorstCase:
    """Search for the operating point and the disturbance with the largest gain to f - fhat.

    Random noise is a weak test of an energy gain: it hardly ever excites the one direction at the
    one frequency that matters. Here the plant is held at operating points, by faults (which the
    observer is blind to) and inputs; at the worst of them w is a half sine over the peak frequency
    of the error, in the direction of the largest singular value; and the whole nonlinear loop,
    the observer's own step in it, is simulated.

    Parameters
    ----------
    observer : Observer
        Of `HinfUIO`.
    steps : int
        Longest disturbance.
    points : int
        Random operating points to start from.
    amplitude : float
        Of w: small, so that the plant stays where its slopes are worst.
    seed : int

    Returns
    -------
    WorstCase
        ``gain`` never exceeds the true worst case, and the closer it comes to the certified
        level the less that level gives away.

    Raises
    ------
    ObsynthError
        If the observer is of another method.

    Examples
    --------
    >>> from obsynth.designs import HinfUIO
    >>> from obsynth.symbolic import Plant
    >>> plant = Plant("first order")
    >>> (x,), (f,) = plant.states("x"), plant.faults("f")
    >>> (w,) = plant.disturbances("w")
    >>> plant.dynamics([x / 2 + f + w], Ts=1)
    >>> plant.outputs([x])
    ('y1',)
    >>> observer = HinfUIO(method="general").design(plant)
    >>> found = worst_case(observer, steps=1000)
    >>> bool(0.99 < found.gain / found.certified <= 1.0)
    True
    """
    if observer.method != HinfUIO.CONTRACT.name:
        raise ObsynthError(f"worst_case is for HinfUIO; this observer is of {observer.method}")
    design: HinfDesign = observer.certificate.design
    candidates = search_points(design, points, seed)
    if not len(candidates):
        raise ObsynthError(
            f"{design.plant.name} cannot be held anywhere in the ranges of its states by faults "
            "and inputs; widen the ranges"
        )
    loop = _Loop(observer, design)
    best: WorstCase | None = None
    limits, frequencies, directions = frozen_gain(design, candidates.jacobian)
    length = min(CHUNK, steps)
    while True:
        for k in range(len(candidates)):
            w = _half_sine(length, frequencies[k], directions[k], amplitude)
            found = loop.run(candidates.take(np.array([k])), w, limits[k], frequencies[k])
            if best is None or found.gain > best.gain:
                best = found
        if length >= steps or best is None or best.gain >= CLOSE * float(limits.max()):
            break
        length = min(4 * length, steps)
    if best is None:
        raise ObsynthError("no disturbance could be simulated")
    return best


def _half_sine(
    length: int, frequency: float, direction: NDArray[np.complex128], amplitude: float
) -> FloatArray:
    k = np.arange(length)
    window = amplitude * np.sin(np.pi * (k + 0.5) / length)
    carried = np.exp(1j * frequency * k)[:, None] * direction
    if frequency < 1e-9 or np.pi - frequency < 1e-9:
        # A real transfer matrix has real singular vectors, up to a common phase.
        carried = carried * np.exp(-1j * np.angle(direction[np.argmax(np.abs(direction))]))
    return np.asarray(window[:, None] * carried.real)


class _Loop:
    """Plant and observer in one function, run in chunks."""

    def __init__(self, observer: Observer, design: HinfDesign) -> None:
        model = design.plant
        self.observer, self.design = observer, design
        n, n_u, n_f, n_d = (len(model.names(kind)) for kind in ("x", "u", "f", "d"))
        size = observer.step.size_in(0)[0]
        x, memory = ca.SX.sym("x", n), ca.SX.sym("memory", size)
        u, w, at = ca.SX.sym("u", n_u), ca.SX.sym("w", len(model.w)), ca.SX.sym("at", n)
        v = ca.SX.sym("v", n_f + n_d)
        feedback = ca.SX.sym("feedback", (n_f + n_d) * n)
        held = v + ca.reshape(feedback, n_f + n_d, n) @ (x - at)
        empty = [ca.DM.zeros(len(model.names(kind))) for kind in ("p", "rho")]
        noise = w + ca.DM(noise_centre(model))
        following, y = model.function()(x, u, held[n_f:], held[:n_f], noise, *empty)
        outputs = observer.step(memory, u, y)
        state = ca.Function(
            "loop",
            [ca.vertcat(x, memory), w, u, v, at, feedback],
            [ca.vertcat(following, outputs[0]), held[:n_f], outputs[2]],
        )
        self._chunk = state.mapaccum("chunk", CHUNK)
        self._n = n

    def run(
        self, point: OperatingPoints, w: FloatArray, limit: float, frequency: float
    ) -> WorstCase:
        """Simulate one disturbance at one operating point; one sample more shows the last fault."""
        x, u, v = point.x[0], point.u[0], point.v[0]
        feedback = holding_gain(point.jacobian[0], self.design.L)
        padded = np.zeros((-(-(len(w) + 1) // CHUNK) * CHUNK, w.shape[1]))
        padded[: len(w)] = w
        state = np.concatenate([x, self.observer.memory0(x)])
        fixed = [
            np.repeat(value[:, None], CHUNK, axis=1) for value in (u, v, x, feedback.T.ravel())
        ]
        faults, estimates, visited = [], [], []
        for start in range(0, len(padded), CHUNK):
            piece = padded[start : start + CHUNK].T
            states, held, fhat = (np.array(r) for r in self._chunk(state, piece, *fixed))
            state = states[:, -1]
            visited.append(states[: self._n].T)
            faults.append(held.T)
            estimates.append(fhat.T)
        error = (np.vstack(faults)[:-1] - np.vstack(estimates)[1:])[: len(w)]
        gain = float(np.linalg.norm(error) / np.linalg.norm(w))
        box, path = self.design.plant.box("x"), np.vstack(visited)[: len(w)]
        if not (np.isfinite(gain) and np.all(path >= box[:, 0]) and np.all(path <= box[:, 1])):
            # Outside its domain the guarantee says nothing, so nothing found there counts.
            gain = 0.0
        level = float(self.design.bound.mu)
        return WorstCase(
            gain,
            float(limit),
            x,
            u,
            v,
            float(frequency),
            w,
            error,
            level,
        )


def holding_gain(jacobian: FloatArray, L: FloatArray) -> FloatArray:
    """Return a feedback from x to faults that keeps the plant near a point; zero where it stays."""
    if np.abs(np.linalg.eigvals(jacobian)).max() < 1.0 - 1e-3:
        return np.zeros((L.shape[1], len(L)))
    P: FloatArray = np.eye(len(L))
    gain: FloatArray = np.zeros((L.shape[1], len(L)))
    for _ in range(500):
        weight = L.T @ P @ L + 1e-6 * np.eye(L.shape[1])
        gain = -np.asarray(np.linalg.solve(weight, L.T @ P @ jacobian), dtype=float)
        closed = jacobian + L @ gain
        P = np.eye(len(L)) + 1e-6 * gain.T @ gain + closed.T @ P @ closed
        P = P / max(1.0, float(np.abs(P).max()) / 1e12)
    return gain
