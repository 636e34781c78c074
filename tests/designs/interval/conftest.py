"""The paper's example: its reference numbers, designs, and many trajectories at once."""

import json
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
import sympy as sp

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


def march(observer, x0, w, f, rho, feedback, x_range=None, step=None, d=None):
    """Run S trajectories side by side: x0 (S, n); w, f, rho, d (N+1, S, .), feedback(k, y)."""
    plant = observer.model
    step = step or observer.step
    samples, many = w.shape[:2]
    nothing = np.zeros((0, many))
    truth = plant.function()
    memory = np.repeat(observer.memory0(x0[0], x_range=x_range)[:, None], many, axis=1)
    x, logs = x0.T.copy(), {name: [] for name in Trajectories.__dataclass_fields__}
    quiet = np.zeros((len(plant.u), many))
    for k in range(samples):
        rest = (
            nothing if d is None else d[k].T,
            f[k].T,
            w[k].T,
            nothing,
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


def make_two_faults():
    """Five states, a fault and an unknown input that mix, noise boxes to one side, B(rho), o(rho).

    One disturbance enters dynamics and output; K0 R0^-1 has a negative entry.
    """
    R = sp.Rational
    p = ob.Plant("two faults")
    x = p.states("x1:6", range=(-6, 6))
    u = p.inputs("u1:3", range=(-2, 2))
    rho = p.scheduling("rho1:3", range=[(-1, R(1, 2)), (0, 1)], measured=False)
    (d,) = p.unknown_inputs("d")
    (f,) = p.faults("f")
    w = p.disturbances("w1:4", range=[(R(-2, 100), R(1, 200)), (0, R(3, 100)), (R(-1, 50), 0)])
    v = p.disturbances(
        "v1:4", range=[(R(-1, 100), R(1, 400)), (R(-1, 1000), R(1, 50)), (0, R(1, 100))]
    )
    A = sp.Matrix(
        [
            [R(1, 2) + rho[0] / 10, R(1, 5), 0, R(1, 10), 0],
            [R(-1, 10), R(3, 5), R(1, 5), 0, rho[1] / 5],
            [R(1, 10), 0, R(2, 5), R(1, 5) + rho[0] / 20, 0],
            [0, R(1, 10), R(-1, 5), R(1, 2), R(1, 10)],
            [R(1, 5), 0, rho[1] / 10, R(-1, 10), R(2, 5)],
        ]
    )
    B = sp.Matrix([[1, 0], [rho[0] / 4, 1], [0, R(1, 2)], [R(1, 3), 0], [0, R(1, 5)]])
    F = sp.Matrix([[R(-1, 2), R(3, 10)], [1, R(1, 5)], [R(-1, 3), -1], [R(1, 4), 0], [0, R(1, 7)]])
    E = sp.Matrix([[1, 0, 0], [0, 1, 0], [0, 0, 1], [R(1, 2), R(-1, 2), 0], [0, R(1, 3), R(1, 3)]])
    offset = sp.Matrix([rho[1] / 100, 0, R(1, 50), 0, 0])
    moved = A * sp.Matrix(x) + B * sp.Matrix(u) + F * sp.Matrix([f, d]) + E * sp.Matrix(w) + offset
    p.dynamics(moved, Ts=1)
    C = sp.Matrix([[1, 0, R(1, 2), 0, 0], [0, 1, 0, R(-1, 3), 0], [0, 0, 1, 0, R(1, 2)]])
    p.outputs(C * sp.Matrix(x) + sp.Matrix([v[0], v[1] - w[0], v[2]]))
    return p


def make_tight():
    """A plant whose bounds are attained: constant matrices, noise to one side."""
    p = ob.Plant("tight")
    x = p.states("x1:3", range=(-9, 9))
    (f,) = p.faults("f")
    w = p.disturbances("w1:3", range=[(-0.02, 0.005), (0, 0.03)])
    (v,) = p.disturbances("v", range=(-0.01, 0.0025))
    p.dynamics([x[0] / 2 - x[1] / 4 - 2 * f + w[0], x[1] / 2 + w[1]], Ts=1)
    p.outputs([x[0] + v])
    return p


_BINARY = {
    ca.OP_ADD: np.add,
    ca.OP_SUB: np.subtract,
    ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.divide,
    ca.OP_EQ: np.equal,
    ca.OP_NE: np.not_equal,
    ca.OP_FMIN: np.minimum,
    ca.OP_FMAX: np.maximum,
    ca.OP_LE: np.less_equal,
    ca.OP_LT: np.less,
    ca.OP_AND: np.logical_and,
    ca.OP_OR: np.logical_or,
    ca.OP_IF_ELSE_ZERO: lambda condition, value: np.where(condition != 0, value, 0),
}
_UNARY = {
    ca.OP_NEG: np.negative,
    ca.OP_FABS: np.abs,
    ca.OP_NOT: np.logical_not,
    ca.OP_TWICE: lambda a: a + a,
    ca.OP_SQ: lambda a: a * a,
    ca.OP_ASSIGN: lambda a: a,
}


def in_numpy(function, kind=np.float32):
    """The same function, instruction by instruction, in a NumPy precision and vectorised."""
    program = []
    for i in range(function.n_instructions()):
        code = function.instruction_id(i)
        constant = function.instruction_constant(i) if code == ca.OP_CONST else None
        program.append(
            (code, function.instruction_input(i), function.instruction_output(i), constant)
        )
    sizes = [function.size1_out(i) for i in range(function.n_out())]

    def call(*arguments):
        many = np.shape(arguments[0])[1]
        inputs = [np.asarray(a).astype(kind) for a in arguments]
        outputs = [np.zeros((size, many), dtype=kind) for size in sizes]
        work = {}
        for code, source, target, constant in program:
            if code == ca.OP_CONST:
                work[target[0]] = kind(min(max(constant, -3e38), 3e38))
            elif code == ca.OP_INPUT:
                work[target[0]] = inputs[source[0]][source[1]]
            elif code == ca.OP_OUTPUT:
                outputs[target[0]][target[1]] = work[source[0]]
            elif code in _UNARY:
                work[target[0]] = np.asarray(_UNARY[code](work[source[0]])).astype(kind)
            else:
                value = _BINARY[code](work[source[0]], work[source[1]])
                work[target[0]] = np.asarray(value).astype(kind)
        return outputs

    return call


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
    """The method's own sets, which the reference numbers speak of."""
    own = {"cuts": (), "horizon": 10**9}
    return {
        name: ob.IntervalObserver(**case, **own).design(example) for name, case in CASES.items()
    }


@pytest.fixture(scope="session")
def two_faults():
    return make_two_faults()


@pytest.fixture(scope="session")
def tight_plant():
    return make_tight()


@pytest.fixture(scope="session")
def numpy_step():
    return in_numpy


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
