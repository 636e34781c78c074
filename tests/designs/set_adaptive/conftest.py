"""The three tanks, their observers, and plant and observer integrated together, made once."""

import json
from pathlib import Path

import numpy as np
import pytest

import obsynth as ob
from obsynth.designs.set_adaptive import SetAdaptiveObserver
from obsynth.designs.set_adaptive.structure import read_structure

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
    return read_structure(tanks, noise=False)


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
    return SetAdaptiveObserver(gain_cap=0.5).design(tanks)


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


@pytest.fixture(scope="session")
def integrate():
    return Together


@pytest.fixture(scope="session")
def paper_gain():
    return PAPER_GAIN
