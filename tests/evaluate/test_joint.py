"""Plant and observer as one differential equation: exact solutions, feedback, what is refused."""

import time
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm

from obsynth.evaluate import SimulationError, joint, simulate
from obsynth.symbolic import Plant, Scenario

TS = 0.5
A = np.array([[0.0, 1.0], [-2.0, -0.6]])
B = np.array([[0.0], [1.0]])
L = np.array([[1.1], [0.4]])
CLAIMS = ["xhat", "fhat", "x_lower", "x_upper", "f_lower", "f_upper", "status"]
OMEGA = 0.7


def linear_plant(stiffness=2):
    """A damped oscillator with a fault on its input, a disturbance in y and a schedule in x'."""
    plant = Plant("oscillator")
    a, b = plant.states("a b", range=(-9, 9))
    (v,) = plant.inputs("v", range=(-5, 5))
    plant.actuator_faults("f", of=v, range=(-2, 2))
    (w,) = plant.disturbances("w", bound=1)
    (r,) = plant.scheduling("r", range=(-3, 3))
    plant.dynamics([b, -stiffness * a - 0.6 * b + v + r])
    plant.outputs([a + w])
    return plant


@dataclass(frozen=True, eq=False)
class Luenberger:
    """xhat' = A xhat + B (u + theta) + L (y - xhat_1); the memory's third number is a flag."""

    model: Plant
    ode: ca.Function | None
    step: ca.Function
    step_covered: bool = False
    fault_delay: int = 0
    half_widths: Any = None
    method: str = "luenberger"

    def memory0(self, guess, x_range=None, f_range=None, y0=None):
        return np.array([y0[0], guess[1], 1.0])


def luenberger(plant, Ts=TS, scheduled=True, **changes):
    m, u, y = ca.SX.sym("m", 3), ca.SX.sym("u"), ca.SX.sym("y")
    theta = ca.SX.sym("theta", 1)
    known = u + theta if scheduled else u
    rate = ca.vertcat(A @ m[:2] + B @ known + L @ (y - m[0]), 0)
    inputs = [m, u, y, theta] if scheduled else [m, u, y]
    names = ["memory", "u", "y", "theta"][: len(inputs)]
    wide = ca.SX.inf(2)
    claims = [m[:2], ca.vertcat(y - m[0]), -wide, wide, -ca.SX.inf(1), ca.SX.inf(1), 2 * known]
    fields = {
        "model": plant.discretise("rk4", Ts),
        "ode": ca.Function("ode", inputs, [rate], names, ["dmemory"]),
        "step": ca.Function("step", inputs, [m + 100, *claims], names, ["next", *CLAIMS]),
    }
    return Luenberger(**{**fields, **changes})


def sine(phase):
    return lambda k: [np.sin(OMEGA * k * TS + phase)]


def scenario(steps=12, **changes):
    fields = {
        "name": "sines",
        "steps": steps,
        "x0": [1.0, -0.5],
        "guess": [0.0, 0.0],
        "inputs": sine(0.0),
        "faults": sine(1.0),
        "disturbances": sine(2.0),
        "scheduling": sine(3.0),
        "f_range": [(-1, 1)],
    }
    return Scenario(**{**fields, **changes})


def exact(times, z0, gain, held):
    """z' = F z + G v(t) with v = (u, f, w, r), by one matrix exponential.

    `gain` is that of an input u + gain y; `held`: v is constant over each sample.
    """
    F = np.zeros((4, 4))
    F[:2, :2] = A + gain * B @ np.array([[1.0, 0.0]])
    F[2:, :2] = L @ np.array([[1.0, 0.0]]) + gain * B @ np.array([[1.0, 0.0]])
    F[2:, 2:] = A - L @ np.array([[1.0, 0.0]])
    G = np.zeros((4, 4))
    G[:2] = np.hstack([B, B, gain * B, B])
    G[2:] = np.hstack([B, 0 * B, L + gain * B, B])
    phases = np.arange(4.0)
    if not held:
        # v_i = sin(omega t + i) = c_i s(t) + s_i c(t), with (s, c) as two more states
        mix = np.column_stack([np.cos(phases), np.sin(phases)])
        big = np.zeros((6, 6))
        big[:4, :4], big[:4, 4:] = F, G @ mix
        big[4, 5], big[5, 4] = OMEGA, -OMEGA
        start = np.concatenate([z0, [0.0, 1.0]])
        return np.array([(expm(big * t) @ start)[:4] for t in times])
    big = np.zeros((8, 8))
    big[:4, :4], big[:4, 4:] = F, G
    flow = expm(big * TS)
    rows = [np.asarray(z0, dtype=float)]
    for t in times[:-1]:
        rows.append((flow @ np.concatenate([rows[-1], np.sin(OMEGA * t + phases)]))[:4])
    return np.array(rows)


def together(run):
    return np.hstack([run.x, run.xhat])


def errors(plant, given, gain=0.0, held=False, observer=None):
    """Largest deviation from the exact solution for 4, 8, 16 and 32 steps per sample."""
    observer = luenberger(plant) if observer is None else observer
    result = []
    for substeps in (4, 8, 16, 32):
        run = simulate(plant, observer, given, engine="joint", substeps=substeps)
        truth = exact(run.t, together(run)[0], gain, held)
        result.append(np.abs(together(run) - truth).max())
    return np.array(result)


def order(values):
    return np.log2(values[:-1] / values[1:])


def as_arrays(given):
    k = np.arange(given.steps + 1)
    names = {"u": "inputs", "f": "faults", "w": "disturbances", "rho": "scheduling"}
    return {names[key]: np.array([f(i) for i in k]) for key, f in given.functions.items()}


def feedback(k, y):
    return [np.sin(OMEGA * k * TS) - 0.4 * y[0]]


CASES = {
    "functions": ({}, 0.0, False),
    "feedback": ({"inputs": feedback}, -0.4, False),
}


@pytest.mark.parametrize("case", CASES)
def test_the_error_falls_with_the_fourth_power_of_the_step(case):
    changes, gain, held = CASES[case]
    found = errors(linear_plant(), scenario(**changes), gain, held)
    assert found[-1] < 1e-7
    np.testing.assert_allclose(order(found), 4.0, atol=0.1)


def test_arrays_are_held_and_functions_are_not():
    plant, given = linear_plant(), scenario()
    held = scenario(**as_arrays(given))
    found = errors(plant, held, held=True)
    np.testing.assert_allclose(order(found), 4.0, atol=0.1)
    assert found[-1] < 1e-7
    other = errors(plant, held, held=False)
    assert other.min() > 0.1, "samples that are held are far from the functions"


@pytest.mark.parametrize("key", ["inputs", "faults", "disturbances", "scheduling"])
def test_each_signal_may_be_held_by_itself(key):
    plant, given = linear_plant(), scenario()
    mixed = scenario(**{key: as_arrays(given)[key]})
    run, smooth, held = (
        simulate(plant, luenberger(plant), s, engine="joint", substeps=8)
        for s in (mixed, given, scenario(**as_arrays(given)))
    )
    assert np.abs(together(run) - together(smooth)).max() > 1e-3
    assert np.abs(together(run) - together(held)).max() > 1e-3
    np.testing.assert_array_equal(run.t, smooth.t)


def mutant_stages(change):
    original = joint._stages

    def stages(*args):
        for begin, end, (first, middle, last) in original(*args):
            yield begin, end, change(first, middle, last)

    return stages


MUTANTS = {
    "middle held": lambda a, b, c: (a, a, c),
    "end held": lambda a, b, c: (a, b, a),
    "one late": lambda a, b, c: tuple(np.roll(v, 1, axis=0) for v in (a, b, c)),
    "swapped": lambda a, b, c: (c, b, a),
}


@pytest.mark.parametrize("mutant", MUTANTS)
@pytest.mark.parametrize("case", CASES)
def test_the_order_sees_wrong_stages(case, mutant, monkeypatch):
    changes, gain, held = CASES[case]
    monkeypatch.setattr(joint, "_stages", mutant_stages(MUTANTS[mutant]))
    found = errors(linear_plant(), scenario(**changes), gain, held)
    assert order(found)[-1] < 2.5


def test_a_feedback_that_sees_the_sampled_output_only_is_another_run():
    plant = linear_plant()
    seen = {}

    def sampled(k, y):
        if k == int(k) and k not in seen:
            seen[k] = y[0]
        return [np.sin(OMEGA * k * TS) - 0.4 * seen[int(k)]]

    with pytest.raises(AssertionError):
        np.testing.assert_allclose(
            order(errors(plant, scenario(inputs=sampled), -0.4)), 4.0, atol=0.1
        )


def test_what_the_run_holds_belongs_to_its_instant():
    plant = linear_plant()
    run = simulate(plant, luenberger(plant), scenario(inputs=feedback), engine="joint", substeps=4)
    k = np.arange(13)
    np.testing.assert_array_equal(run.w[:, 0], np.sin(OMEGA * k * TS + 2.0))
    np.testing.assert_array_equal(run.y[:, 0], run.x[:, 0] + run.w[:, 0])
    np.testing.assert_allclose(run.u[:, 0], np.sin(OMEGA * k * TS) - 0.4 * run.y[:, 0], atol=1e-15)
    # The step is read at the memory of the instant, with u, y and theta of that instant; what it
    # returns as memory (here 100 more) is not used.
    np.testing.assert_array_equal(run.fhat[:, 0], run.y[:, 0] - run.xhat[:, 0])
    assert run.xhat[0, 0] == run.y[0, 0]
    assert np.abs(run.xhat).max() < 5
    assert np.all(run.x_lower == -np.inf)


def test_chunks_do_not_show(monkeypatch):
    plant = linear_plant()
    for inputs in (sine(0.0), feedback):
        given = scenario(steps=30, inputs=inputs)
        whole = simulate(plant, luenberger(plant), given, engine="joint", substeps=3)
        monkeypatch.setattr(joint, "_CHUNK", 7)
        parts = simulate(plant, luenberger(plant), given, engine="joint", substeps=3)
        monkeypatch.undo()
        for key in ("x", "y", "u", "xhat", "fhat", "status"):
            np.testing.assert_array_equal(getattr(parts, key), getattr(whole, key), err_msg=key)


def test_samplers_of_disturbances_stay_per_sample():
    plant = linear_plant()
    calls = []

    def sampler(rng, k):
        calls.append(k)
        return rng.uniform(-1, 1, 1)

    run = simulate(
        plant, luenberger(plant), scenario(disturbances=sampler), 5, engine="joint", substeps=4
    )
    assert calls == list(range(13))
    again = simulate(
        plant, luenberger(plant), scenario(disturbances=run.w), engine="joint", substeps=4
    )
    np.testing.assert_array_equal(run.x, again.x)


def test_an_observer_need_not_read_the_schedule():
    plant = linear_plant()
    run = simulate(plant, luenberger(plant, scheduled=False), scenario(), engine="joint")
    full = simulate(plant, luenberger(plant), scenario(), engine="joint")
    np.testing.assert_array_equal(run.x, full.x)
    assert np.abs(run.xhat - full.xhat).max() > 0.1


def test_the_run_says_what_was_integrated_and_what_the_guarantee_leaves_out():
    plant = linear_plant()
    observer = luenberger(plant)
    run = simulate(plant, observer, scenario(), engine="joint", substeps=5)
    assert "steps of 0.1 s (5 per sample)" in run.truth
    assert "inputs, faults, disturbances, scheduling at the stages" in run.truth
    assert run.outside == ()
    assert simulate(observer.model, observer, scenario(), engine="joint").outside == ()
    stiffer = linear_plant(3)
    assert "not the plant" in simulate(stiffer, observer, scenario(), engine="joint").outside[0]

    sampled = simulate(plant, observer, scenario(), substeps=5)
    assert ["sampled step" in text for text in sampled.outside] == [True]
    covered = simulate(plant, luenberger(plant, step_covered=True), scenario(), substeps=5)
    assert covered.outside == ()
    own = simulate(observer.model, luenberger(plant, step_covered=True), scenario())
    assert ["speaks of the differential equation" in text for text in own.outside] == [True]


def test_refusals():
    plant = linear_plant()
    observer = luenberger(plant)
    with pytest.raises(SimulationError, match=r"needs a continuous-time method; luenberger is"):
        simulate(plant, luenberger(plant, ode=None), scenario(), engine="joint")
    discrete = Plant("discrete")
    (a,) = discrete.states("a", range=(-1, 1))
    discrete.dynamics([a / 2], Ts=TS)
    discrete.outputs([a])
    lost = luenberger(plant, model=discrete)
    with pytest.raises(SimulationError, match="'discrete' was declared in discrete time"):
        simulate(
            discrete,
            lost,
            Scenario("s", 2, x0=[1], guess=[0, 0][:1], inputs=np.zeros((3, 0))),
            engine="joint",
        )
    with pytest.raises(SimulationError, match=r"substeps=0 is not a positive whole number"):
        simulate(plant, observer, scenario(), engine="joint", substeps=0)
    m, u, y = ca.SX.sym("m", 3), ca.SX.sym("u"), ca.SX.sym("y")
    short = ca.Function("ode", [m, u, y], [m[:2]], ["memory", "u", "y"], ["dmemory"])
    with pytest.raises(SimulationError, match="takes 3 numbers as memory and returns 2"):
        simulate(plant, luenberger(plant, ode=short), scenario(), engine="joint")
    unnamed = ca.Function("ode", [m, u, y], [m])
    with pytest.raises(SimulationError, match=r"ode takes \(i0: \d, i1: 1, i2: 1\)"):
        simulate(plant, luenberger(plant, ode=unnamed), scenario(), engine="joint")


def test_functions_that_give_nonsense_between_the_samples_are_refused():
    plant = linear_plant()
    observer = luenberger(plant)

    def late(k):
        return [0.0 if k < 3.4 or k == int(k) else np.nan]

    with pytest.raises(SimulationError, match=r"faults at k = 3\.5: f is nan"):
        simulate(plant, observer, scenario(faults=late), engine="joint")

    def growing(k):
        return [0.0] * (1 if k == int(k) else 2)

    with pytest.raises(SimulationError, match=r"inputs at k = 0\.5 has shape \(2,\)"):
        simulate(plant, observer, scenario(inputs=growing), engine="joint")
    with pytest.raises(SimulationError, match=r"inputs at k = 2\.5.*v is nan"):
        simulate(
            plant,
            observer,
            scenario(inputs=lambda k, y: [np.nan if k == 2.5 else 0.0]),
            engine="joint",
        )


def test_the_step_engine_takes_functions_at_whole_numbers():
    plant = linear_plant()
    observer = luenberger(plant)
    given = scenario()
    held = scenario(**as_arrays(given))
    for substeps in (None, 3):
        model = observer.model if substeps is None else plant
        first, second = (simulate(model, observer, s, substeps=substeps) for s in (given, held))
        np.testing.assert_array_equal(first.x, second.x)


def test_a_hundred_thousand_steps_take_a_moment():
    plant = linear_plant()
    observer = luenberger(plant, Ts=0.01)
    k = np.arange(20_001) * 0.01
    given = Scenario(
        "long",
        20_000,
        x0=[1, 0],
        guess=[0, 0],
        inputs=np.sin(k)[:, None],
        disturbances=np.cos(k)[:, None],
    )
    start = time.perf_counter()
    run = simulate(plant, observer, given, engine="joint", substeps=5)
    assert time.perf_counter() - start < 3.0
    assert np.abs(run.x[-1]).max() < 2.0
