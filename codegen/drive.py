"""Signals as a plant would drive a step: what leads to the memories that are met in service."""

from __future__ import annotations

import casadi as ca
import numpy as np

from obsynth.codegen.description import Description, midpoints
from obsynth.codegen.kernel import Machine
from obsynth.derive.equilibrium import operating_values
from obsynth.symbolic.arrays import FloatArray

_KINDS = ("u", "d", "f", "w", "p", "rho")
_HOLD = 20
_SMALL = 0.01
_NARROW = 0.01


def _finite(box: FloatArray, nominal: FloatArray) -> FloatArray:
    """Return a box to draw from: open ends close one unit from the nominal value."""
    lower = np.where(np.isfinite(box[:, 0]), box[:, 0], np.minimum(nominal, box[:, 1]) - 1.0)
    upper = np.where(np.isfinite(box[:, 1]), box[:, 1], np.maximum(nominal, lower) + 1.0)
    return np.column_stack([lower, upper])


class Drive:
    """Inputs, measurements and scheduling along random trajectories, kept in the ranges."""

    def __init__(self, description: Description, rng: np.random.Generator) -> None:
        model = description.observer.model
        self.rng, self.precision = rng, description.real.precision
        self._observer = description.observer
        self._plant = Machine(model.function())
        self._slope = Machine(_input_slope(model.function()))
        self._nominal = operating_values(model, "x")
        self._x_box = _finite(self._box("x"), self._nominal)
        self._boxes = {kind: _finite(self._box(kind), midpoints(model, kind)) for kind in _KINDS}
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
        """Start a trajectory of so many samples; return the memory, None for the default.

        Every second one starts from a guess of its own, two thirds carry a growing fault, and half
        of them stay near their start, for observers whose guarantee holds in a small region.
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
        if self._rest and self._sequence % 8 < 6:
            self._x = self._nominal
        if self._sequence % 2:
            return None
        boxes = {}
        if self._sequence % 8 != 2:
            # known well, as methods need it that promise something in a small region only
            width = _NARROW * (self._x_box[:, 1] - self._x_box[:, 0])
            boxes["x_range"] = np.column_stack([self._x - width, self._x + width])
        return np.array(self._observer.memory0(self._x, **boxes), dtype=float)

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
        return [spread(self.rng, value) for value in values]

    def _theta(self, rho: FloatArray) -> list[FloatArray]:
        return [rho[self._scheduling]] if self._scheduling else []


def _input_slope(plant: ca.Function) -> ca.Function:
    """Return (x, u, d, f, w, p, rho) -> (next x, its derivative by u, column by column)."""
    ports = [ca.MX.sym(f"i{i}", plant.numel_in(i)) for i in range(plant.n_in())]
    following = plant.call(ports)[0]
    return ca.Function("slope", ports, [following, ca.vec(ca.jacobian(following, ports[1]))])


def spread(rng: np.random.Generator, values: FloatArray) -> FloatArray:
    """Return numbers (n,) around those given, some of any magnitude."""
    size = values.size
    wide: FloatArray = rng.standard_normal(size) * 10.0 ** rng.uniform(-6, 6, size)
    with np.errstate(over="ignore"):
        near: FloatArray = values * (1.0 + 0.3 * rng.standard_normal(size))
    return np.where(rng.random(size) < 0.3, wide, near)
