"""A small plant with an observer whose intervals are right by construction, and tight."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
import sympy as sp

from obsynth.designs.core.certificate import Certificate, Claim, Guarantee
from obsynth.symbolic import Plant, Scenario

N = 200
NAMES_IN = ["memory", "u", "y"]
NAMES_OUT = ["next", "xhat", "fhat", "x_lower", "x_upper", "f_lower", "f_upper", "status"]


def toy_plant() -> Plant:
    """a is measured, b is driven by a bounded unknown input, f slowly adds to v."""
    plant = Plant("toy")
    a, b = plant.states("a b", range=[(-50, 50), (-2, 2)], unit=["cm", ""])
    (v,) = plant.inputs("v", range=(-5, 5), nominal=0, unit="V")
    (d,) = plant.unknown_inputs("d", range=(-0.1, 0.1))
    plant.actuator_faults("f", of=v, range=(-1, 1), rate=0.05)
    (w,) = plant.disturbances("w", bound=0.1)
    plant.dynamics([0.9 * a + 0.1 * sp.sin(b) + v, 0.8 * b + d], Ts=0.5)
    plant.outputs([a + w], unit="cm")
    return plant


@dataclass(frozen=True, eq=False)
class ToyObserver:
    """[y - .1, y + .1] holds a; b and f by propagating what is declared.

    With fault_delay 1 the fault interval is what two consecutive measurements
    say about f_{k-1}; with 0 it is the declared range of f.
    """

    model: Plant
    fault_delay: int = 0
    shift: int = 0
    half_widths: np.ndarray = field(default_factory=lambda: np.array([0.1, 0.5, 1.0]))
    method: str = "toy"
    ode: ca.Function | None = None
    step_covered: bool = False

    @property
    def step(self) -> ca.Function:
        # memory: k, previous y, previous v, b's centre, b's radius, a delayed y (for the mutant)
        m, v, y = ca.SX.sym("m", 6), ca.SX.sym("v"), ca.SX.sym("y")
        k, y0, v0, b, r = (m[i] for i in range(5))
        seen = m[5] if self.shift else y
        xhat = ca.vertcat(seen, b)
        radius = ca.vertcat(0.1, r)
        if self.fault_delay:
            fhat = y - 0.9 * y0 - v0
            f_radius = ca.if_else(k > 0, 0.1 + 0.09 + 0.1 + 1e-12, ca.inf)
        else:
            fhat, f_radius = ca.SX(0), ca.SX(1)
        status = ca.if_else(k > 0, 0, 1 + 16 * self.fault_delay)
        memory = ca.vertcat(k + 1, y, v, 0.8 * b, 0.8 * r + 0.1, y)
        outputs = [memory, xhat, fhat, xhat - radius, xhat + radius]
        outputs += [fhat - f_radius, fhat + f_radius, status]
        return ca.Function("step", [m, v, y], outputs, NAMES_IN, NAMES_OUT)

    @property
    def memory_layout(self):
        return {"past": slice(0, 6)}

    def memory0(self, guess, x_range=None, f_range=None, y0=None):
        radius = 2.0 if x_range is None else 0.5 * (x_range[1][1] - x_range[1][0])
        return np.array([0.0, y0[0], 0.0, guess[1], radius, y0[0]])

    @property
    def gains(self):
        return {"K": np.array([[1.0], [0.0]]), "F": np.array([[1.0]])}

    @property
    def performance(self):
        return {"decay": 0.2}

    figures = performance

    @property
    def certificate(self):
        claim = Claim("interval", "a <= y + 0.1 & a >= y - 0.1", True, 0.25, "by construction")
        return Certificate((claim,), {"format": "toy"}, None)

    @property
    def guarantee(self):
        return Guarantee(("a, b, f inside",), ("|w| <= 0.1 [monitored]", "|d| <= 0.1"))


def toy_scenario(steps=N, **changes) -> Scenario:
    k = np.arange(steps + 1)
    fault = np.clip(0.02 * (k - 60), 0.0, 0.8)[:, None]
    fields = {
        "name": "ramp",
        "steps": steps,
        "x0": [0.3, 0.4],
        "guess": [0.0, 0.0],
        "inputs": np.sin(k / 7.0)[:, None],
        "faults": fault,
        "unknown_inputs": 0.1 * np.cos(k / 5.0)[:, None],
        "x_range": [(-1, 1), (-0.5, 0.5)],
    }
    return Scenario(**{**fields, **changes})


@pytest.fixture(scope="session")
def toy():
    """Plant, observer class and scenario maker."""
    plant = toy_plant()
    return SimpleNamespace(plant=plant, observer=ToyObserver, scenario=toy_scenario, N=N)


@pytest.fixture(scope="session")
def toy_run(toy):
    from obsynth.evaluate import simulate

    return simulate(toy.plant, toy.observer(toy.plant), toy.scenario(), seed=3)


@pytest.fixture
def no_window(monkeypatch):
    """Any attempt to open a window fails; figures are closed afterwards."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    def refuse(*args, **kwargs):
        raise AssertionError("a plot function called show")

    monkeypatch.setattr(plt, "show", refuse)
    monkeypatch.setattr("matplotlib.figure.Figure.show", refuse)
    yield
    plt.close("all")
