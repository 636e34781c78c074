"""Test vectors: what CasADi's virtual machine, or one in single precision, returns, bit by bit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import casadi as ca
import numpy as np

from obsynth.codegen.description import Description, midpoints, nominal_values
from obsynth.codegen.errors import CodegenError
from obsynth.codegen.kernel import DOUBLE, SINGLE, Machine
from obsynth.codegen.recording import Recorder, Vectors
from obsynth.codegen.single import machine_of
from obsynth.symbolic.arrays import FloatArray

MINIMUM = 100
"""Fewest vectors that still hold some of every kind."""

SHARES: Mapping[str, float] = {
    "closed loop": 0.5,
    "closed loop with failing signals": 0.2,
    "random": 0.14,
    "extreme": 0.14,
    "not initialised": 0.02,
}
"""Share of every kind of vectors."""

_KINDS = ("u", "d", "f", "w", "p", "rho")
_HOLD = 20
_SMALL = 0.01
_SEQUENCE = 250
_EXTREMES: Mapping[str, FloatArray] = {
    real.precision: np.array(
        [
            *(0.0, -0.0, float(info.smallest_subnormal), -float(info.tiny), *small, *large),
            *(float(info.max), -float(info.max), np.inf, -np.inf, np.nan),
        ]
    )
    for real, small, large in (
        (DOUBLE, (1e-160, 1e160), (-1e300, 1.0000000000000002e300)),
        (SINGLE, (1e-20, 1e20), (-1e35, 1e35)),
    )
    for info in [np.finfo(real.type)]
}


def make_vectors(description: Description, count: int = 10_000, seed: int = 0) -> Vectors:
    """Run the step on the virtual machine and record every input and result.

    Half of the steps are sequences of 250 along trajectories of the plant, the memory carried
    along by the C program itself; another fifth are such sequences with failing signals. The
    others start from random memories, hold extreme and non-finite numbers anywhere,
    or follow `NAME_init` without an initialised memory.
    """
    if count < MINIMUM:
        raise CodegenError(
            f"vectors={count}; at least {MINIMUM} are needed for some of every kind",
            vectors=count,
        )
    rng = np.random.default_rng(seed)
    recorder = Recorder(description, machine_of(description.observer.step, description.real))
    drive = Drive(description, rng)
    kinds = _quotas(count)
    visited = [description.start]
    for kind, failing in (("closed loop", False), ("closed loop with failing signals", True)):
        for length in _lengths(kinds[kind]):
            _follow(recorder, drive, length, failing)
            visited.append(recorder.memory.astype(float))
    scale = _scale(visited)
    for i in range(kinds["random"]):
        recorder.load(random_memory(rng, visited[i % len(visited)], scale))
        recorder.step(drive.wide())
    for i in range(kinds["extreme"]):
        memory = visited[i % len(visited)].copy()
        inputs = drive.wide()
        if i % 2:
            memory = random_memory(rng, memory, scale)
        # Extremes in the memory would hide those in the inputs: a step must cope with either.
        _spoil(drive, [memory] if i % 3 == 0 else inputs)
        recorder.load(memory)
        recorder.step(inputs)
    for length in _lengths(kinds["not initialised"], 4):
        recorder.forget()
        for _ in range(length):
            recorder.step(drive.wide())
    return recorder.vectors(kinds)


def _quotas(count: int) -> dict[str, int]:
    kinds = {kind: int(share * count) for kind, share in SHARES.items()}
    kinds["closed loop"] += count - sum(kinds.values())
    return kinds


def _lengths(total: int, most: int = _SEQUENCE) -> Iterator[int]:
    for start in range(0, total, most):
        yield min(most, total - start)


def _follow(recorder: Recorder, drive: Drive, length: int, failing: bool) -> None:
    guess = drive.begin(length)
    if guess is None:
        recorder.default()
    else:
        recorder.load(guess)
    for k in range(length):
        inputs = drive.sample(k)
        # Whole stretches fail, so that what follows a failure is tested too.
        if failing and k % 25 in (7, 8, 9, 20):
            _spoil(drive, inputs)
        recorder.step(inputs)


def _spoil(drive: Drive, arrays: list[FloatArray]) -> None:
    """Replace one to three entries by extreme or non-finite numbers, in place."""
    places = [(array, i) for array in arrays for i in range(array.size)]
    rng = drive.rng
    for _ in range(rng.integers(1, 4)):
        array, i = places[rng.integers(len(places))]
        array[i] = rng.choice(_EXTREMES[drive.precision])


def _scale(visited: list[FloatArray]) -> FloatArray:
    stacked = np.abs(np.array(visited))
    stacked[~np.isfinite(stacked)] = 0.0
    largest: FloatArray = stacked.max(axis=0)
    return np.where(largest > 0, largest, 1.0)


# -- signals as a plant would drive the step ---------------------------------------------


def _finite(box: FloatArray, nominal: FloatArray) -> FloatArray:
    """Return a box to draw from: open ends close one unit from the nominal value."""
    lower = np.where(np.isfinite(box[:, 0]), box[:, 0], np.minimum(nominal, box[:, 1]) - 1.0)
    upper = np.where(np.isfinite(box[:, 1]), box[:, 1], np.maximum(nominal, lower) + 1.0)
    return np.column_stack([lower, upper])


class Drive:
    """Inputs, measurements and scheduling along random trajectories of the plant.

    The trajectories serve to reach the memories and branches that a step meets in service.
    Whether they are admissible does not matter: states that leave their declared range
    are put back on its border.
    """

    def __init__(self, description: Description, rng: np.random.Generator) -> None:
        model = description.observer.model
        self.rng, self.precision = rng, description.real.precision
        self._observer = description.observer
        self._plant = Machine(model.function())
        self._slope = Machine(_input_slope(model.function()))
        self._nominal = nominal_values(model, "x")
        self._x_box = _finite(self._box("x"), self._nominal)
        self._boxes = {
            kind: _finite(self._box(kind), midpoints(self._box(kind))) for kind in _KINDS
        }
        self._sequence = 0
        self._rest = False
        self._x = self._nominal
        self._levels = {kind: self._draw(kind) for kind in _KINDS}
        self._scheduling = list(description.scheduling)
        self._u = np.empty((0, len(model.u)))
        self._ramp = np.empty((0, len(model.f)))
        self._measured = self._measure(self._x)

    def _box(self, kind: str) -> FloatArray:
        return np.asarray(self._observer.model.box(kind), dtype=float).reshape(-1, 2)

    def _draw(self, kind: str) -> FloatArray:
        box = self._boxes[kind]
        return self.rng.uniform(box[:, 0], box[:, 1])

    def _measure(self, x: FloatArray) -> FloatArray:
        self._following, y = self._plant(x, *(self._levels[kind] for kind in _KINDS))
        return y

    def begin(self, length: int) -> FloatArray | None:
        """Start a trajectory of `length` samples; return the observer's memory for it.

        None stands for the default memory. Every second trajectory starts from a guess of
        its own, and two thirds of them carry a fault that grows from a random instant. Half of
        them are kept near where they start, with small faults, so that observers whose
        guarantee holds in a small region are seen at work in it.
        """
        rng = self.rng
        self._sequence += 1
        holds = -(-length // _HOLD)
        self._u = np.repeat([self._draw("u") for _ in range(holds)], _HOLD, axis=0)
        onset = int(rng.integers(length))
        ramp = np.clip((np.arange(length) - onset) / (0.5 * length), 0.0, 1.0)
        self._rest = self._sequence % 4 < 2
        target = self._draw("f") * (self._sequence % 3 > 0) * (_SMALL if self._rest else 1.0)
        self._ramp = ramp[:, None] * target
        self._levels["p"] = self._draw("p")
        self._x = rng.uniform(self._x_box[:, 0], self._x_box[:, 1])
        if self._sequence % 2:
            if self._rest:
                self._x = self._nominal
            return None
        return np.array(self._observer.memory0(self._x), dtype=float)

    def sample(self, k: int) -> list[FloatArray]:
        """Return u_k, y_k and, for scheduled observers, theta_k; move the plant on."""
        # Measured scheduling moves slower than a sample, as do the inputs.
        for kind in ("d", "w") if self._scheduling and k % _HOLD else ("d", "w", "rho"):
            self._levels[kind] = self._draw(kind)
        if self._rest and k % _HOLD == 0:
            self._u[k : k + _HOLD] = self._keeping(self._u[k])
        self._levels["u"] = self._u[k]
        self._levels["f"] = self._ramp[k]
        y = self._measure(self._x)
        following = np.clip(self._following, self._x_box[:, 0], self._x_box[:, 1])
        self._x = following if np.isfinite(following).all() else self._nominal
        if np.isfinite(y).all():
            self._measured = y.copy()
        return [self._u[k].copy(), y, *self._theta(self._levels["rho"])]

    def _keeping(self, u: FloatArray) -> FloatArray:
        """Return inputs in their ranges that move the plant as little as inputs can."""
        low, high = self._boxes["u"].T
        for _ in range(2):
            now = [u if kind == "u" else self._levels[kind] for kind in _KINDS]
            moved, slope = self._slope(self._x, *now)
            if not (np.isfinite(moved).all() and np.isfinite(slope).all()):
                break
            matrix = slope.reshape(u.size, self._x.size).T
            u = np.clip(u - np.linalg.lstsq(matrix, moved - self._x)[0], low, high)
        return u

    def wide(self) -> list[FloatArray]:
        """Return inputs and measurements spread around those seen last, over many magnitudes."""
        values = [self._draw("u"), self._measured]
        if self._scheduling:
            values += self._theta(self._draw("rho"))
        return [_spread(self.rng, value) for value in values]

    def _theta(self, rho: FloatArray) -> list[FloatArray]:
        return [rho[self._scheduling]] if self._scheduling else []


def _input_slope(plant: ca.Function) -> ca.Function:
    """Return (x, u, d, f, w, p, rho) -> (next x, its derivative by u, column by column)."""
    ports = [ca.MX.sym(f"i{i}", plant.numel_in(i)) for i in range(plant.n_in())]
    following = plant.call(ports)[0]
    return ca.Function("slope", ports, [following, ca.vec(ca.jacobian(following, ports[1]))])


def _spread(rng: np.random.Generator, values: FloatArray) -> FloatArray:
    size = values.size
    wide: FloatArray = rng.standard_normal(size) * 10.0 ** rng.uniform(-6, 6, size)
    near: FloatArray = values * (1.0 + 0.3 * rng.standard_normal(size))
    return np.where(rng.random(size) < 0.3, wide, near)


def random_memory(rng: np.random.Generator, near: FloatArray, scale: FloatArray) -> FloatArray:
    """Return a memory around one that was visited; some entries far from it.

    Shapes: near (n_memory,), scale (n_memory,).
    """
    size = near.size
    base = np.where(np.isfinite(near), near, scale)
    close: FloatArray = base * (1.0 + 0.2 * rng.standard_normal(size))
    far: FloatArray = scale * rng.standard_normal(size) * 10.0 ** rng.uniform(-3, 3, size)
    choice = rng.random(size)
    kept: FloatArray = np.where(choice < 0.6, close, far)
    # Flags and counters hold whole numbers; kept as they are often enough, they select branches.
    return np.where(rng.random(size) < 0.5, base, kept)
