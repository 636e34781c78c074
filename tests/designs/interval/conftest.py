"""The paper's example: its reference numbers, designs, and many trajectories at once."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import obsynth as ob

A_PAPER = np.array([[-1.0, 1, 0], [-1, 0, 0], [0, -1, -1]])
MIRROR = np.diag([1.0, -1.0])
CASES = {
    "b2": {
        "gains": (MIRROR, [0, -1]),
        "bound": "paper",
        "contraction": False,
        "centred": False,
        "nominal": A_PAPER,
    },
    "c2": {"gains": (MIRROR, [0.4, -1]), "bound": "paper", "contraction": False},
    "d0": {"gains": (np.eye(2), [0.4, -1]), "contraction": False},
    "d1": {"gains": (np.eye(2), [0.4, -1])},
}
BOX = np.tile([0.5, 1.5], (3, 1))


@dataclass
class Trajectories:
    """Logs of S runs, arrays (N+1, S, .); `f_lower[k]` belongs to f[k-1]."""

    x: np.ndarray
    y: np.ndarray
    u: np.ndarray
    f: np.ndarray
    x_lower: np.ndarray
    x_upper: np.ndarray
    f_lower: np.ndarray
    f_upper: np.ndarray
    status: np.ndarray
    memory: np.ndarray

    def x_inside(self, tolerance=0.0):
        return (self.x_lower <= self.x + tolerance) & (self.x <= self.x_upper + tolerance)

    def f_inside(self, tolerance=0.0):
        low, high, f = self.f_lower[1:], self.f_upper[1:], self.f[:-1]
        return (low <= f + tolerance) & (f <= high + tolerance)


def _wide(array, many):
    return np.asarray(array, dtype=float).reshape(-1, many)


def march(observer, x0, w, f, rho, feedback, x_range=None, step=None, plant=None):
    """Run S trajectories side by side: x0 (S, n); w, f, rho (N+1, S, .), feedback(k, y)."""
    plant = plant or observer.model
    step = step or observer.step
    samples, many = w.shape[:2]
    n_d, n_p = len(plant.d), len(plant.p)
    nothing = np.zeros((0, many))
    truth = plant.function()
    memory = np.repeat(observer.memory0(x0[0], x_range=x_range)[:, None], many, axis=1)
    x, logs = x0.T.copy(), {name: [] for name in Trajectories.__dataclass_fields__}
    quiet = np.zeros((len(plant.u), many))
    for k in range(samples):
        rest = (
            nothing if not n_d else np.zeros((n_d, many)),
            f[k].T,
            w[k].T,
            nothing if not n_p else np.tile(plant.box("p").mean(axis=1)[:, None], many),
            rho[k].T,
        )
        y = _wide(truth(x, quiet, *rest)[1], many)
        u = feedback(k, y)
        out = [_wide(o, many) for o in step(memory, u, y)]
        names = ("x_lower", "x_upper", "f_lower", "f_upper", "status")
        for name, value in zip(names, out[3:], strict=True):
            logs[name].append(value.T)
        for name, value in (("x", x), ("y", y), ("u", u), ("memory", memory)):
            logs[name].append(value.T.copy())
        memory = out[0]
        x = _wide(truth(x, u, *rest)[0], many)
    logs["f"] = list(f)
    return Trajectories(**{name: np.array(rows) for name, rows in logs.items()})


def law(k, y):
    """The feedback of the example, on the noisy outputs."""
    return 1.5 * y[:1] + 2.0 * y[1:]


@pytest.fixture(scope="session")
def numbers():
    """Reference numbers of the interval observer, all digits."""
    path = Path(__file__).parents[2] / "reference" / "interval_observer.json"
    return json.loads(path.read_text())


@pytest.fixture(scope="session")
def example():
    return ob.plants.interval_example()


@pytest.fixture(scope="session")
def designs(example):
    return {name: ob.IntervalObserver(**case).design(example) for name, case in CASES.items()}


@pytest.fixture(scope="session")
def run_many():
    return march


@pytest.fixture(scope="session")
def feedback():
    return law


@pytest.fixture(scope="session")
def paper_seeds():
    """x0, w, f, rho of the paper's scenario for many seeds, as arrays (N+1, S, .)."""

    def make(seeds, steps=200):
        scenarios = [ob.scenarios.interval_example(seed, steps) for seed in seeds]
        w = np.stack([s.disturbances for s in scenarios], axis=1)
        shape = (steps + 1, len(scenarios))
        f = np.broadcast_to(scenarios[0].faults[:, None], (*shape, 1))
        rho = np.broadcast_to(scenarios[0].scheduling[:, None], (*shape, 2))
        return np.ones((len(scenarios), 3)), w, f, rho

    return make
