"""How bad can it get: disturbances and operating points that make the fault error large."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from obsynth.designs.core.observer import Observer
from obsynth.designs.core.signals import noise_centre
from obsynth.designs.hinf.method import HinfUIO
from obsynth.designs.hinf.operating_points import OperatingPoints, frozen_gain, search_points
from obsynth.designs.hinf.record import HinfDesign
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

CHUNK = 500
# A longer disturbance is tried until the gain is this close to that of the linearisation.
CLOSE = 1.0 - 1e-6


@dataclass(frozen=True, eq=False)
class WorstCase:
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
    """Return a feedback from x to the faults that keeps the plant near an operating point.

    Zero where the plant stays there by itself, else that of a Riccati equation.
    """
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
