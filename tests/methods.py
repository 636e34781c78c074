"""The table of methods: with one entry, tests/designs/test_contract.py holds a method to all."""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import sympy as sp

import obsynth as ob
from luenberger.method import Luenberger
from obsynth.designs.general.method import GeneralUIO

# Gains of the last row of the comparison in the peak-bound analysis, exact decimals.
SINGLE = ", single"
"""Behind the name of a method: designed for single precision."""
PEAK_GAINS = {
    "K": np.array([[0.3279, 0.0012, 0], [0.0023, 0.2659, 0], [0, 0, 0], [0.2222, 0.0008, 0]]),
    "F": np.array([[0.6766, 0.0023, 0], [-0.0042, 0.6263, 0]]),
}


@dataclass(frozen=True)
class Entry:
    """A method with a plant of its class, and what its tests need to know.

    scenario: within the assumptions of the guarantee, with states that move
    outside: a plant that is not of the class
    option: an option with a value that is refused
    spoilt: path of a number in the record, what it is multiplied by, the claim that falls
    gains: those of `Observer.gains` that `analyse` takes, by its name for them
    detects: whether a fault detector can stand on it
    module: what another process has to import before it can load a design
    """

    method: Any
    plant: Callable[[], ob.Plant]
    scenario: Callable[[], ob.Scenario]
    outside: Callable[[], ob.Plant]
    spoilt: tuple[tuple[str | int, ...], float, str]
    option: Mapping[str, Any] | None = None
    gains: tuple[str, ...] = ()
    detects: bool = True
    module: str = "obsynth"


def tank() -> ob.Plant:
    return ob.plants.quadruple_tank().discretise("euler", Ts=1.0)


def two_tanks() -> ob.Plant:
    """Two tanks in a row, the second level measured."""
    plant = ob.Plant("two tanks")
    h1, h2 = plant.states("h1 h2", range=(4, 40), nominal=[9, 9], unit="cm")
    (v,) = plant.inputs("v", range=(0, 10), nominal=3, unit="V")
    w1, w2 = plant.disturbances("w1 w2", bound=[0.02, 0.05])
    quarter = sp.Rational(1, 4)
    plant.dynamics(
        [quarter * (v - sp.sqrt(h1)) + w1, quarter * (sp.sqrt(h1) - sp.sqrt(h2))],
    )
    plant.outputs([h2 + w2])
    return plant.discretise("euler", Ts=1.0)


def two_tanks_filling() -> ob.Scenario:
    return ob.Scenario(
        name="filling",
        steps=120,
        x0=[16, 12],
        guess=[12, 14],
        inputs=lambda k: [4 + np.sin(k / 20)],
        x_range=[(8, 20), (8, 20)],
    )


def sound_tanks() -> ob.Scenario:
    return ob.scenarios.three_tanks("fault free", end=20.0, noise=None)


def vessel() -> ob.Plant:
    """One state whose outflow is scheduled and has a process fault, in continuous time."""
    plant = ob.Plant("vessel")
    (x,) = plant.states("x", range=(3, 7), nominal=5)
    (u,) = plant.inputs("u", range=(0, 20), nominal=7)
    (theta,) = plant.scheduling("theta", range=(0, 1))
    (f,) = plant.process_faults("f", range=(-0.3, 0.3))
    (w,) = plant.disturbances("w", bound=0.01)
    plant.dynamics([-(1 + theta) * x + f * x + u + w])
    plant.outputs([x + w])
    return plant


def vessel_moving() -> ob.Scenario:
    def theta(k: float) -> float:
        return 0.5 + 0.5 * float(np.sin(0.01 * k))

    return ob.Scenario(
        name="moving",
        steps=600,
        x0=[5.03],
        guess=[5.0],
        inputs=lambda k: [5 * (1 + theta(k)) + 1.2 * np.sin(0.03 * k)],
        scheduling=lambda k: [theta(k)],
        faults=np.full((601, 1), 0.03),
        disturbances=np.random.default_rng(1).uniform(-0.01, 0.01, (601, 1)),
        x_range=[(4.95, 5.05)],
        f_range=[(-0.05, 0.05)],
    )


def oscillator() -> ob.Plant:
    return ob.plants.forced_oscillator().discretise("euler", Ts=sp.Rational(1, 100))


def motor() -> ob.Plant:
    """A motor outside of the papers' class.

    The gain of its fault varies, its friction is known to an interval, its load to nothing, and a
    third reading is nonlinear.
    """
    plant = ob.Plant("motor")
    i, w = plant.states("i omega", range=[(-8, 8), (-40, 40)], nominal=0)
    (u,) = plant.inputs("u", range=(-12, 12), nominal=2)
    (f,) = plant.process_faults("f", range=(-4, 4), rate=8)
    (b,) = plant.params("b", tolerance=0.1, value=0.1)
    (load,) = plant.unknown_inputs("load")
    n = plant.disturbances("n1:4", bound=[0.02, 0.05, 0.05])
    gain = 1 + w / 200
    plant.dynamics([2 * (gain * (u + f) - i - w / 100), 100 * (i / 100 - b * w / 10 - load)])
    plant.outputs([i + n[0], w + n[1], i * w / 20 + n[2]])
    return plant.discretise("euler", Ts=sp.Rational(1, 100))


def motor_turning() -> ob.Scenario:
    return ob.Scenario(
        name="turning",
        steps=150,
        x0=[0.3, 1.0],
        guess=[0.0, 0.0],
        inputs=lambda k: [3 + 2 * np.sin(k / 15)],
        faults=np.clip(0.04 * np.arange(151) - 2.0, 0.0, 2.0)[:, None],
        unknown_inputs=lambda k: [0.02 * np.sin(k)],
        x_range=[(-1, 1), (-2, 2)],
    )


# Further ways of a method stand behind a point.
METHODS = {
    "bounded_error_uio": Entry(
        ob.BoundedErrorUIO(gamma=0.005),
        tank,
        lambda: ob.scenarios.quadruple_tank("FS1"),
        outside=ob.plants.quadruple_tank,
        spoilt=(("bound", "gamma", 0), 2.0, "lmi"),
        option={"gamma": 1.5},
        gains=("K", "F"),
    ),
    "general_uio": Entry(
        GeneralUIO(),
        motor,
        motor_turning,
        outside=ob.plants.quadruple_tank,
        spoilt=(("bound", "b", 3), 0.9, "peak"),
        option={"weights": -1.0},
        gains=("L",),
    ),
    "general_uio.ellipsoid": Entry(
        GeneralUIO(bounds="ellipsoid"),
        motor,
        motor_turning,
        outside=ob.plants.quadruple_tank,
        spoilt=(("bound", "tau", 0), 0.5, "lmi"),
        option={"gamma": 1.5},
        gains=("L",),
    ),
    "general_uio.l2": Entry(
        GeneralUIO(bounds="l2"),
        motor,
        motor_turning,
        outside=ob.plants.quadruple_tank,
        spoilt=(("bound", "mu"), 0.99, "lmi"),
        option={"bounds": "none"},
        gains=("L",),
    ),
    "hinf_uio": Entry(
        ob.HinfUIO(method="general", multipliers="per_row", decay=0.6),
        ob.plants.hinf_example,
        lambda: ob.scenarios.hinf_example("noise"),
        outside=ob.plants.quadruple_tank,
        spoilt=(("bound", "mu"), 0.999, "lmi"),
        option={"mu": 0.0},
        gains=("K", "F", "H", "D"),
        detects=False,
    ),
    "interval_observer": Entry(
        ob.IntervalObserver(),
        ob.plants.interval_example,
        lambda: replace(ob.scenarios.interval_example(seed=1), f_range=[(-1, 1)]),
        outside=ob.plants.quadruple_tank,
        spoilt=(("width", 0), 0.9, "stability"),
        option={"precision": "half"},
        gains=("P", "L"),
    ),
    "filter_bank": Entry(
        ob.FilterBank(),
        ob.plants.three_tanks,
        sound_tanks,
        outside=ob.plants.quadruple_tank,
        spoilt=(("gain", 0), -1.0, "filters"),
        option={"Ts": -1.0},
    ),
    "set_adaptive_observer": Entry(
        ob.SetAdaptiveObserver(gain_cap=0.5),
        ob.plants.three_tanks,
        sound_tanks,
        outside=ob.plants.quadruple_tank,
        spoilt=(("alpha",), 1.01, "decay"),
        option={"gain_cap": 0.0},
        gains=("L",),
    ),
    "set_membership": Entry(
        ob.SetMembershipObserver(),
        oscillator,
        lambda: ob.scenarios.gentle(oscillator(), steps=150),
        outside=ob.plants.quadruple_tank,
        spoilt=(("size", 1, 1), 0.5, "frame"),
        option={"columns": 0},
        gains=("L",),
    ),
    "qpv_observer": Entry(
        ob.QPVObserver(
            region=ob.Ellipsoid([1.5, 0.09], [5, 0]),
            initial_error=[0.05, 0.05],
            E_x=[0.3],
            alpha_q=1.0,
            gain_cap=50.0,
            Ts=0.01,
        ),
        vessel,
        vessel_moving,
        outside=tank,
        spoilt=(("inverse_diagonal", 1), 0.999, "bounds"),
        option={"eta": 1.5},
        gains=("L1", "L2"),
    ),
    "luenberger": Entry(
        Luenberger(),
        two_tanks,
        two_tanks_filling,
        outside=ob.plants.quadruple_tank,
        spoilt=(("b", 1), 0.5, "peak"),
        gains=("L",),
        detects=False,
        module="luenberger.method",
    ),
}


@functools.cache
def observer_of(name: str) -> ob.Observer:
    """The design of a method's entry, made once; in the precision that stands behind its name."""
    entry = METHODS[name.removesuffix(SINGLE)]
    method: Any = entry.method
    if name.endswith(SINGLE):
        method = replace(method, precision="single")
    return method.design(entry.plant())


@functools.cache
def run_of(name: str) -> ob.Run:
    """The scenario of a method's entry, simulated once."""
    return simulated(METHODS[name], observer_of(name))


def simulated(entry: Entry, observer: Any) -> ob.Run:
    """Run the scenario; an observer whose step is not covered together with its plant."""
    options: dict[str, Any] = {}
    if observer.ode is not None:
        options = {"substeps": 4} if observer.step_covered else {"engine": "joint"}
    return ob.simulate(entry.plant(), observer, entry.scenario(), seed=1, **options)
