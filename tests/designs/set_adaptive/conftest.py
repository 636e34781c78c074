"""The three tanks, their observers, and plant and observer integrated together, made once."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import obsynth as ob
from obsynth.designs.core.loading import contract_of
from obsynth.designs.set_adaptive.method import SetAdaptiveObserver
from obsynth.designs.set_adaptive.model import read

PAPER_GAIN = {"L": 3.0 * np.eye(3, 2)}
A13 = A32 = 1.329e-4
A20, S_C, K = 1.772e-4, 0.0154, 1.329e-3
# theta, reference and duration of the four pieces, each smooth
PIECES = ((100.0, 0.0, (0, 0)), (200.0, 1.0, (0, 0)), (300.0, 0.0, (1, 0)), (310.0, 1.0, (1, 1)))


@pytest.fixture(scope="session")
def numbers():
    path = Path(__file__).parents[2] / "reference" / "set_adaptive.json"
    return json.loads(path.read_text())


@pytest.fixture(scope="session")
def tanks():
    return ob.plants.three_tanks()


@pytest.fixture(scope="session")
def structure(tanks):
    return read(tanks, noise=False)


@pytest.fixture(scope="session")
def hull(structure):
    """Least A_m and largest A_M over the range of exact outputs."""
    return structure.bounds.extremes(0.0)


@pytest.fixture(scope="session")
def printed(tanks):
    """The paper's observer: gain 3, bounds as functions of y, averaging law."""
    return SetAdaptiveObserver(form="printed").analyse(tanks, PAPER_GAIN)


@pytest.fixture(scope="session")
def cooperative(tanks):
    return SetAdaptiveObserver(gain_cap=0.5, Ts=0.05).design(tanks)


def root(z):
    return np.sign(z) * np.sqrt(np.abs(z))


def flows(x, raised):
    wanted = (0.5 * (1 + 0.07 * raised), 0.1 * (1 + 0.5 * raised))
    return (
        max(0.0, -K * root(x[0] - wanted[0])),
        max(0.0, -K * root(x[1] - wanted[1]) + A20 * root(x[1])),
    )


def plant_rates(x, u, theta, sign=1.0):
    one, two = A13 * root(x[0] - x[2]), A32 * root(x[2] - x[1])
    return np.array(
        [
            (-one + u[0] + theta[0]) / S_C,
            (sign * two - A20 * root(x[1]) + u[1] + theta[1]) / S_C,
            (one - two) / S_C,
        ]
    )


class Together:
    """Plant, control and observer as one differential equation, DOP853, restarted at the steps."""

    def __init__(self, observer, theta, f_range=(-1e-4, 1e-4), rtol=1e-10, sign=1.0, pieces=PIECES):
        from scipy.integrate import solve_ivp

        self.observer, self.layout = observer, observer.memory_layout
        start = observer.memory0([0.5, 0.1, 0.3], f_range=[f_range] * 2)
        state = np.concatenate([[0.5, 0.1, 0.3], start])
        self.solutions, begin = [], 0.0
        for end, raised, which in pieces:
            fault = np.array(theta) * which

            def rates(_, z, raised=raised, fault=fault):
                u = flows(z[:3], raised)
                memory = np.array(observer.ode(z[3:], u, z[:2])).ravel()
                return np.concatenate([plant_rates(z[:3], u, fault, sign), memory])

            found = solve_ivp(
                rates,
                (begin, end),
                state,
                method="DOP853",
                rtol=rtol,
                atol=1e-12,
                dense_output=True,
            )
            self.solutions.append((begin, end, found.sol))
            begin, state = end, found.y[:, -1]

    def at(self, t):
        for begin, end, solution in self.solutions:
            if begin <= t <= end:
                return solution(t)
        raise ValueError(t)

    def part(self, t, name):
        if name == "x":
            return self.at(t)[:3]
        return self.at(t)[3:][self.layout[name]]

    def first(self, function, begin, end, grid=4001):
        """First zero of a function of t that is negative before."""
        from scipy.optimize import brentq

        times = np.linspace(begin, end, grid)
        values = np.array([function(t) for t in times])
        above = np.flatnonzero(values > 0.0)
        if not above.size:
            return None
        k = int(above[0])
        assert k > 0
        return brentq(function, times[k - 1], times[k], xtol=1e-10)


@pytest.fixture(scope="session")
def together(printed):
    """The noise-free reference run, Gamma = .01."""
    return Together(printed, (8e-5, 6e-5))


class ClosedLoop:
    """Plant (Runge-Kutta, inputs held), control from the noisy outputs and step, all compiled.

    Calling it returns arrays by name, one row for each sample; the memory is the one that the step
    at that sample was called with.
    """

    chunk = 500

    def __init__(self, observer, plant=None, late=0):
        self.observer, self.names = observer, [s.name for s in observer.model.f]
        memory = ca.SX.sym("memory", observer.step.numel_in(0))
        x, w, f = ca.SX.sym("x", 3), ca.SX.sym("w", 2), ca.SX.sym("f", 2)
        raised, last = ca.SX.sym("raised"), ca.SX.sym("last", 2)
        y = x[:2] + w
        wanted = ca.vertcat(0.5 * (1 + 0.07 * raised), 0.1 * (1 + 0.5 * raised))
        u = ca.vertcat(
            ca.fmax(0, -K * root_sx(y[0] - wanted[0])),
            ca.fmax(0, -K * root_sx(y[1] - wanted[1]) + A20 * root_sx(y[1])),
        )
        results = observer.step(memory, u, last if late else y)
        rk4 = (plant or observer.model).function()
        following = rk4(x, u, [], f, w, [], [])[0]
        state = ca.vertcat(x, memory, y)
        moved = ca.vertcat(following, results[0], y)
        self.n = memory.numel()
        start = ca.SX.sym("state", 5 + self.n)
        table = [x, memory, last]
        parts = [start[:3], start[3 : 3 + self.n], start[3 + self.n :]]
        outputs = ca.vertcat(state[: 3 + self.n], y, *results[1:])
        moved, outputs = ca.substitute([moved, outputs], table, parts)
        step = ca.Function("loop", [start, w, f, raised], [moved, outputs])
        self.sizes = [3, self.n, 2, 3, 2, 3, 3, 2, 2, 1]
        self.loop = step.mapaccum("loops", self.chunk)

    def __call__(self, w, f=None, raised=None, x0=(0.5, 0.1, 0.3), **start):
        count = len(w)
        f = np.zeros((count, 2)) if f is None else f
        raised = np.zeros(count) if raised is None else raised
        memory = self.observer.memory0(list(x0), **start)
        state = np.concatenate([x0, memory, np.asarray(x0[:2]) + w[0]])
        rows = []
        for begin in range(0, count, self.chunk):
            piece = slice(begin, begin + self.chunk)
            padded = [fill(value[piece], self.chunk).T for value in (w, f, raised[:, None])]
            moved, outputs = self.loop(state, *padded)
            state = np.array(moved)[:, -1]
            rows.append(np.array(outputs).T)
        table = np.vstack(rows)[:count]
        ends = np.cumsum([0, *self.sizes])
        names = ["x", "memory", "y", "xhat", "fhat", "x_lower", "x_upper", "f_lower", "f_upper"]
        parts = [table[:, a:b] for a, b in pairwise(ends)]
        found = dict(zip([*names, "status"], parts, strict=True))
        found["status"] = found["status"][:, 0].astype(int)
        return found


def root_sx(z):
    return ca.sign(z) * ca.sqrt(ca.fabs(z))


def fill(rows, count):
    missing = count - len(rows)
    return np.vstack([rows, np.repeat(rows[-1:], missing, axis=0)]) if missing else rows


def paper_schedule(steps, Ts=0.01, theta=(8e-5, 6e-5)):
    """Faults and raised reference at the samples 0..steps."""
    t = Ts * np.arange(steps + 1)
    f = np.zeros((steps + 1, 2))
    f[t >= 200.0 - 1e-9, 0], f[t >= 300.0 - 1e-9, 1] = theta
    raised = (np.ceil(t / 100.0 - 1e-9) % 2 == 0) & (t > 0)
    return f, raised.astype(float)


def certificate_of(record, level="lmi", **changed):
    """The certificate of a record, valid or not, with parts of its contract changed."""
    contract = replace(contract_of(record), **changed)
    return contract.certify(contract.record.from_record(record), level)


@pytest.fixture(scope="session")
def certify():
    return certificate_of


@pytest.fixture(scope="session")
def schedule():
    return paper_schedule


@pytest.fixture(scope="session")
def closed_loop():
    return ClosedLoop


@pytest.fixture(scope="session")
def integrate():
    return Together


@pytest.fixture(scope="session")
def paper_gain():
    return PAPER_GAIN
