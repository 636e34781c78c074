"""Whole steps by induction: plants in 400 bits beside the observer, no state or fault outside."""

from functools import cache

import numpy as np
import pytest
import sympy as sp
from exactly import FAULT_OPEN, LEFT_OUT, RECOVERING, VOID, Exactly, follow

import obsynth as ob
from obsynth.codegen import find_compiler

R = sp.Rational


def line():
    """Linear: a state without a range, faults with a rate, a constant one, of a sensor; u in y."""
    plant = ob.Plant("line")
    a, b = plant.states("a b", range=(-4, 4))
    (c,) = plant.states("c")
    (u,) = plant.inputs("u", range=(-1, 1))
    plant.actuator_faults("fu", of="u", range=(-1, 1), rate=R(1, 16))
    plant.sensor_faults("fs", of="y2", range=(-1, 1), constant=True)
    s, v1, v2, v3 = plant.disturbances("s v1 v2 v3", bound=[R(1, 8), R(1, 16), R(1, 32), R(1, 16)])
    plant.dynamics([a / 2 + b / 4 + u / 4 + s, b / 2 - a / 4 + v1 / 4, c + a / 4 - s / 2], Ts=1)
    plant.outputs([a + u / 8 + v1, b + v2, c + v3])
    return Exactly(plant, inputs=lambda rng: [float(rng.integers(-8, 9) / 8)])


def tank():
    """A root, a product with a parameter known to an interval, a fault without a rate."""
    plant = ob.Plant("tank")
    (h,) = plant.states("h", range=(R(1, 4), 9))
    (u,) = plant.inputs("u", range=(0, 2))
    (p,) = plant.params("p", range=(R(3, 4), R(5, 4)))
    (leak,) = plant.process_faults("leak", range=(0, R(1, 4)))
    s, v = plant.disturbances("s v", bound=[R(1, 64), R(1, 32)])
    plant.dynamics([h + R(1, 4) * (u - p * sp.sqrt(h) - leak * h / 4) + s], Ts=1)
    plant.outputs([h + v])
    return Exactly(plant, inputs=lambda rng: [float(rng.integers(7, 11) / 8)])


def pendulum():
    """Sine, exponential, quotient, absolute value, a state-dependent gain of a rated fault."""
    plant = ob.Plant("pendulum")
    q, r = plant.states("q r", range=(-3, 3))
    (f,) = plant.process_faults("f", range=(-1, 1), rate=R(1, 10))
    s, v1 = plant.disturbances("s v1", bound=[R(1, 50), R(1, 30)])
    rows = [
        q + R(1, 10) * r,
        R(9, 10) * r
        - R(1, 10) * sp.sin(q)
        - R(1, 20) * sp.Abs(r) * r / (2 + q**2)
        + (1 + q**2 / 20) * f / 10
        + s,
    ]
    plant.dynamics(rows, Ts=R(1, 10))
    plant.outputs([sp.exp(q / 4) + v1])
    return Exactly(plant)


def pushed():
    """An unknown input of any size, and a fault with and one without a rate: a delay of one."""
    plant = ob.Plant("pushed")
    a, b, c = plant.states("a b c", range=(-50, 50))
    (d,) = plant.unknown_inputs("d")
    (free,) = plant.process_faults("free", range=(-2, 2))
    plant.sensor_faults("fs", of="y1", range=(-1, 1), rate=R(1, 8))
    bounds = [R(1, 8), R(1, 16), R(1, 32), R(1, 16), R(1, 64)]
    s, v1, v2, v3, v4 = plant.disturbances("s v1 v2 v3 v4", bound=bounds)
    plant.dynamics([a / 2 + d / 4, b / 2 + a * c / 64 + free + s, c / 2 + b / 8 + d / 8], Ts=1)
    plant.outputs([a + v1, b + v2, c + a / 4 + v3, a + v4])
    return Exactly(plant, unknown=lambda rng: [float(rng.integers(-640, 641) / 16)])


def sensor():
    """A sensor fault without a rate beside a second sensor; hidden scheduling; branches."""
    plant = ob.Plant("sensor")
    a, b = plant.states("a b", range=(-8, 8))
    plant.sensor_faults("fs", of="y2", range=(-3, 3))
    (rho,) = plant.scheduling("rho", range=(-1, 1), measured=False)
    bounds = [R(1, 8), R(1, 4), R(1, 16), R(1, 32)]
    s, g, v1, v2 = plant.disturbances("s g v1 v2", bound=bounds)
    row = b / 2 - sp.atan(a) / 4 + sp.Max(a, b / 2) / 8 + g / 2
    plant.dynamics([a / 2 + b / 4 + rho * b / 8 + s + g, row], Ts=1)
    plant.outputs([a + g + v1, a + b / 4 + v2])
    return Exactly(plant)


def growing(u=0.0):
    """What multiplies a disturbance, and a slow state that is not measured."""
    plant = ob.Plant("growing")
    a, b = plant.states("a b", range=(-4, 4))
    (push,) = plant.inputs("push", range=(-20, 20))
    s, v = plant.disturbances("s v", bound=[R(1, 4), R(1, 64)])
    plant.dynamics([a / 2 + b / 4 + push, R(9, 10) * b + (1 + a / 64) * s], Ts=1)
    plant.outputs([a + v])
    return Exactly(plant, inputs=lambda rng: [u])


def learnt(pushes=(8.0,) * 9 + (0.0,) * 12):
    """A parameter that is seen while an input pushes."""
    plant = ob.Plant("learnt")
    a, b = plant.states("a b", range=(-99, 99))
    (u,) = plant.inputs("u", range=(-9, 9))
    (p,) = plant.params("p", range=(-1, 1))
    s, v = plant.disturbances("s v", bound=[R(1, 64), R(1, 64)])
    plant.dynamics([a / 2 + p * u + s, b / 2 + p], Ts=1)
    plant.outputs([a + v])
    left = list(pushes)
    return Exactly(plant, inputs=lambda rng: [left.pop(0)])


PLANTS = {
    "line": (line, [(-1, 1), (-1, 1), (-2, 2)]),
    "tank": (tank, [(1, 3)]),
    "pendulum": (pendulum, [(-0.5, 0.5)] * 2),
    "pushed": (pushed, [(-1, 1)] * 3),
    "sensor": (sensor, [(-1, 1)] * 2),
}


FEW = {"zonotopes": 1, "restart": 3, "columns": 18, "horizon": 6, "recovery": 2}


@cache
def designed(name, gain=1.0):
    exactly = PLANTS[name][0]()
    return exactly, ob.SetMembershipObserver(gain=gain, **FEW).design(exactly.plant)


def followed(name, seeds, edges=False, gaps=0.0, broken=(), gain=1.0, calls=20):
    """Runs of a plant; nothing outside."""
    exactly, observer = designed(name, gain)
    for seed in seeds:
        rng = np.random.default_rng(seed)
        told = follow(exactly, observer, rng, calls, PLANTS[name][1], edges, gaps, broken)
        assert not told.misses, (seed, told.misses)
        yield {s & ~FAULT_OPEN for s in told.status}, np.array(told.widths)


@pytest.mark.parametrize("edges", [True, False])
@pytest.mark.parametrize("name", PLANTS)
def test_no_truth_is_outside_of_a_set(name, edges):
    """Noise, rates and first sets at their ends or within; horizons change at calls 6, 12, 18.

    Mutants: zonotopes moved over the boxes of this instant; a reading one unit inwards; a fault
    that is told late without its rate; the image of the box before at the first instant; noise
    that is remembered for the next instant; half of the remainder of a product.
    """
    for status, _ in followed(name, range(3), edges):
        assert status == {0}


@pytest.mark.parametrize("name", PLANTS)
def test_no_truth_is_outside_without_readings_or_after_lies(name):
    """A fifth of the readings missing; one call of lies, which is void, and sets begin anew."""
    for status, _ in followed(name, range(2), gaps=0.2):
        assert status == {0, LEFT_OUT}
    for status, _ in followed(name, range(2), True, broken=(7,)):
        assert status & {VOID, VOID | LEFT_OUT} and RECOVERING in {s & RECOVERING for s in status}


def test_a_sensor_fault_without_a_rate_is_what_sensors_differ_by():
    """Known one call late, from the readings of its own instant, which are gone by then.

    Mutant: faults of this instant are begun again from those before and their rates.
    """
    for _, widths in followed("sensor", range(2)):
        assert (widths[2:, 2] <= 1.2).all()


def test_a_parameter_is_remembered_when_nothing_shows_it_any_more():
    """Mutants: parameters that begin from their range at every call."""
    exactly = learnt()
    observer = ob.SetMembershipObserver(gain=1.0, **FEW | {"horizon": 40}).design(exactly.plant)
    told = follow(exactly, observer, np.random.default_rng(0), 21, [(-1, 1)] * 2)
    assert not told.misses and told.widths[-1][1] <= 0.05


def test_peak_bounds_begin_anew_after_a_missing_reading_and_keep_to_their_domain():
    """Mutants: they are moved on as if it had been there; states are not held to their range."""
    exactly = growing()
    observer = ob.SetMembershipObserver(**FEW).design(exactly.plant)
    assert observer.certificate.design.peak is not None
    for seed in range(4):
        told = follow(exactly, observer, np.random.default_rng(seed), 60, [(-1, 1)] * 2, True, 0.7)
        assert not told.misses and set(told.status) == {0, LEFT_OUT}
    away = follow(growing(8.0), observer, np.random.default_rng(0), 9, [(-1, 1)] * 2)
    assert all(status & VOID for status in away.status[1:])


def test_a_zonotope_begins_anew_from_what_is_left():
    """Mutant: from the box before it was cut with the readings."""
    _, observer = designed("line")
    memory = observer.memory0([0] * 3, x_range=[(-1, 1)] * 3)
    for _ in range(5):
        memory, *found = observer.step(memory, [0.0], [0.0] * 3)
    low, high, below, above = (np.array(v).ravel() for v in found[2:6])
    own = [np.array(memory)[observer.memory_layout[name]] for name in ("c1", "G1")]
    reach = np.abs(own[1].reshape(-1, len(own[0]))).sum(axis=0)
    left = 0.5 * np.concatenate([high - low, above - below])
    assert reach == pytest.approx(left, rel=1e-9)


@pytest.mark.long
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("exactly", [tank, learnt])
def test_c_is_equal_to_the_last_bit(exactly, tmp_path):
    """Another plant stands in the contract's tests, the whole gallery in the long ones."""
    method = ob.SetMembershipObserver(gain=1.0, zonotopes=0, columns=8)
    project = ob.generate_c(method.design(exactly().plant), tmp_path / "project", vectors=100)
    assert project.comparison.vectors == 100
