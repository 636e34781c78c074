"""How bad can it get: disturbances and operating points that make the fault error large."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from obsynth.designs.core.frequency import ComplexArray, peak_gain
from obsynth.designs.core.observer import Observer
from obsynth.designs.core.signals import noise_centre
from obsynth.designs.hinf.method import HinfUIO
from obsynth.designs.hinf.record import HinfDesign
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError
from obsynth.symbolic.shown import Shown

NEWTON = 30
ROUNDS, KEPT, NEAR = 12, 4, 16
# Where a signal has no range, operating points are looked for within so many units of zero.
REACH = 10.0
# Distance kept from the ends of a range, as a share of its width: w moves the plant a little.
DISTANCE = 1e-3
CHUNK = 500
# A longer disturbance is tried until the gain is this close to that of the linearisation.
CLOSE = 1.0 - 1e-6


class OperatingPoints(NamedTuple):
    """Points x = f(x, u, v), v faults and d, with Jacobians (N, n, n) by x."""

    x: FloatArray
    u: FloatArray
    v: FloatArray
    jacobian: FloatArray

    def take(self, index: NDArray[np.intp]) -> OperatingPoints:
        """Return some of the points."""
        return OperatingPoints(*(part[index] for part in self))

    def joined(self, other: OperatingPoints) -> OperatingPoints:
        """Return the points of both."""
        return OperatingPoints(*map(np.concatenate, zip(self, other, strict=True)))


@lru_cache(maxsize=4)
def _motion(model: Plant) -> ca.Function:
    """(x, u, v) -> f(x, u, v) - x and the Jacobian of f by (x, u, v), side by side."""
    n, n_u, n_f, n_d = (len(model.names(kind)) for kind in ("x", "u", "f", "d"))
    x, u, v = ca.SX.sym("x", n), ca.SX.sym("u", n_u), ca.SX.sym("v", n_f + n_d)
    middle = ca.DM(noise_centre(model))
    value = model.function()(x=x, u=u, d=v[n_f:], f=v[:n_f], w=middle)["rhs"]
    slopes = ca.jacobian(value, ca.vertcat(x, u, v))
    both = ca.densify(ca.horzcat(value - x, slopes))
    return ca.Function("motion", [ca.vertcat(x, u, v)], [both])


def hold_points(model: Plant, x: FloatArray, u: FloatArray) -> OperatingPoints:
    """Move points x (N, n), u (N, n_u) to the nearest that faults and d can hold, if any."""
    motion, n, held = _motion(model), x.shape[1], x.shape[1] + u.shape[1]
    z = np.hstack([x, u, np.zeros((len(x), motion.size_in(0)[0] - held))])
    low, high = np.vstack([_inner(model.box("x")), model.box("u")]).T
    # v costs next to nothing, so that x and u stay where they were wanted if they can.
    weight = np.where(np.arange(z.shape[1]) < held, 1.0, 1e4)

    def evaluated(z: FloatArray) -> tuple[FloatArray, FloatArray]:
        if not len(z):
            return np.zeros((0, n)), np.zeros((0, n, z.shape[1]))
        both = np.array(motion.map(len(z))(z.T)).reshape(n, len(z), -1).swapaxes(0, 1)
        return both[:, :, 0], both[:, :, 1:]

    for _ in range(NEWTON):
        residual, slopes = evaluated(z)
        matrix = (slopes - np.eye(n, z.shape[1])) * weight
        usable = np.isfinite(matrix).all(axis=(1, 2)) & np.isfinite(residual).all(axis=1)
        z, matrix, residual = z[usable], matrix[usable], residual[usable]
        step = weight * (np.linalg.pinv(matrix) @ residual[:, :, None])[:, :, 0]
        z = z - step
        z[:, :held] = np.clip(z[:, :held], low, high)
        if np.abs(step).max(initial=0.0) < 1e-13 * np.abs(z).max(initial=1.0):
            break
    residual, slopes = evaluated(z)
    found = np.abs(residual).max(axis=1) < 1e-10 * (1.0 + np.abs(z).max(axis=1))
    z, slopes = z[found], slopes[found]
    return OperatingPoints(z[:, :n], z[:, n:held], z[:, held:], slopes[:, :, :n])


def frozen_gain(
    design: HinfDesign, jacobian: FloatArray, **options: int
) -> tuple[FloatArray, FloatArray, ComplexArray]:
    """Return peak gain, frequency and w (N, n_w) of errors linearised with Jacobians (N, n, n)."""
    gains, C, W = design.gains, design.C, design.W
    kept, seen = np.eye(len(C.T)) - gains.F @ C, gains.H @ C
    loop, output = kept @ jacobian - gains.K @ C, seen @ jacobian + gains.D @ C
    return peak_gain(loop, kept @ W, output, seen @ W, **options)


def search_points(design: HinfDesign, count: int, seed: int) -> OperatingPoints:
    """Find the operating points with the largest frozen gains: samples, then a random ascent."""
    rng, model = np.random.default_rng(seed), design.plant
    boxes = [_finite(model.box(kind)) for kind in ("x", "u")]
    draws = [rng.uniform(b[:, 0], b[:, 1], (count, len(b))) for b in boxes]
    found = hold_points(model, *(np.vstack([d, np.zeros(d.shape[1])]) for d in draws))
    if not len(found.x):
        return found
    gain = frozen_gain(design, found.jacobian, refinements=1)[0]
    for spread in 0.1 * 0.5 ** np.arange(ROUNDS):
        top = np.argsort(-gain, kind="stable")[:KEPT]
        found, gain = found.take(top), gain[top]
        near = []
        for value, b in zip((found.x, found.u), boxes, strict=True):
            noise = rng.standard_normal((NEAR * len(value), len(b)))
            moved = np.repeat(value, NEAR, axis=0) + spread * (b[:, 1] - b[:, 0]) * noise
            near.append(np.clip(moved, b[:, 0], b[:, 1]))
        more = hold_points(model, *near)
        found = found.joined(more)
        gain = np.concatenate([gain, frozen_gain(design, more.jacobian, refinements=1)[0]])
    return found.take(np.argsort(-gain, kind="stable")[:KEPT])


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
    if not len(candidates.x):
        raise ObsynthError(
            f"{design.plant.name} cannot be held anywhere in the ranges of its states by faults "
            "and inputs; widen the ranges"
        )
    chunk = loop_of(observer)
    limits, frequencies, directions = frozen_gain(design, candidates.jacobian)
    found: list[WorstCase] = []
    length = min(CHUNK, steps)
    while True:
        for k in range(len(limits)):
            w = half_sine(length, frequencies[k], directions[k], amplitude)
            point = candidates.take(np.array([k]))
            found.append(excite(observer, chunk, point, w, limits[k], frequencies[k]))
        best = max(found, key=lambda case: case.gain)
        if length >= steps or best.gain >= CLOSE * float(limits.max()):
            return best
        length = min(4 * length, steps)


def half_sine(
    length: int, frequency: float, direction: ComplexArray, amplitude: float
) -> FloatArray:
    """Return a disturbance in a direction at a frequency, over half a sine, (length, n_w)."""
    k = np.arange(length)
    window = amplitude * np.sin(np.pi * (k + 0.5) / length)
    carried = np.exp(1j * frequency * k)[:, None] * direction
    if frequency < 1e-9 or np.pi - frequency < 1e-9:
        # A real transfer matrix has real singular vectors, up to a common phase.
        carried = carried * np.exp(-1j * np.angle(direction[np.argmax(np.abs(direction))]))
    return np.asarray(window[:, None] * carried.real)


def loop_of(observer: Observer) -> ca.Function:
    """Return plant and observer as one function over `CHUNK` samples: states, faults, estimates."""
    model: Plant = observer.certificate.design.plant
    n, n_u, n_f, n_d = (len(model.names(kind)) for kind in ("x", "u", "f", "d"))
    x, memory = ca.SX.sym("x", n), ca.SX.sym("memory", observer.step.size_in(0)[0])
    u, w, at = ca.SX.sym("u", n_u), ca.SX.sym("w", len(model.w)), ca.SX.sym("at", n)
    v, feedback = ca.SX.sym("v", n_f + n_d), ca.SX.sym("feedback", n_f + n_d, n)
    held = v + feedback @ (x - at)
    noise = w + ca.DM(noise_centre(model))
    moved = model.function()(x=x, u=u, d=held[n_f:], f=held[:n_f], w=noise)
    outputs = observer.step(memory, u, moved["y"])
    loop = ca.Function(
        "loop",
        [ca.vertcat(x, memory), w, u, v, at, feedback],
        [ca.vertcat(moved["rhs"], outputs[0]), held[:n_f], outputs[2]],
    )
    return loop.mapaccum("chunk", CHUNK)


def excite(
    observer: Observer,
    chunk: ca.Function,
    point: OperatingPoints,
    w: FloatArray,
    limit: float,
    frequency: float,
) -> WorstCase:
    """Simulate one disturbance at one operating point; one sample more shows the last fault."""
    design: HinfDesign = observer.certificate.design
    x, u, v, jacobian = (part[0] for part in point)
    feedback = np.tile(holding_gain(jacobian, design.L), CHUNK)
    fixed = [*(np.repeat(part[:, None], CHUNK, axis=1) for part in (u, v, x)), feedback]
    padded = np.zeros((-(-(len(w) + 1) // CHUNK) * CHUNK, w.shape[1]))
    padded[: len(w)] = w
    state = np.concatenate([x, observer.memory0(x)])
    rows: list[tuple[FloatArray, ...]] = []
    for piece in np.split(padded, len(padded) // CHUNK):
        states, *seen = (np.array(part).T for part in chunk(state, piece.T, *fixed))
        state = states[-1]
        rows.append((states[:, : len(x)], *seen))
    path, faults, estimates = map(np.vstack, zip(*rows, strict=True))
    error = (faults[:-1] - estimates[1:])[: len(w)]
    gain = float(np.linalg.norm(error) / np.linalg.norm(w))
    low, high = design.plant.box("x").T
    # Outside its domain the guarantee says nothing, so nothing found there counts.
    inside = np.all(path[: len(w)] >= low) and np.all(path[: len(w)] <= high)
    counted, level = gain if np.isfinite(gain) and inside else 0.0, float(design.bound.mu)
    return WorstCase(counted, float(limit), x, u, v, float(frequency), w, error, level)


def holding_gain(jacobian: FloatArray, L: FloatArray) -> FloatArray:
    """Return a feedback from x to faults that keeps the plant near a point; zero where it stays."""
    if np.abs(np.linalg.eigvals(jacobian)).max() < 1.0 - 1e-3:
        return np.zeros((L.shape[1], len(L)))
    from scipy.linalg import solve_discrete_are

    weight = 1e-6 * np.eye(L.shape[1])
    try:
        P = solve_discrete_are(jacobian, L, np.eye(len(L)), weight)
    except (np.linalg.LinAlgError, ValueError):  # no fault reaches what grows
        return np.zeros((L.shape[1], len(L)))
    return np.asarray(-np.linalg.solve(L.T @ P @ L + weight, L.T @ P @ jacobian))
