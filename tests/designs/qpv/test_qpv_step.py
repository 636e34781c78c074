"""The step at run time: its differential equation, status bits, time index."""

import numpy as np
import pytest

import obsynth as ob
from obsynth.designs.core.observer import STATUS, STEP_OUTPUTS

U = [1945 / 34, 0.0, 17.5]
CENTRE = np.array([10.0, 10.0, 10.0])
THETA = np.array([0.5, 0.5])
NOISE = 2.5 * np.array([0.025, 0.015, 0.025])


def call(observer, memory, y=CENTRE, theta=THETA, u=U):
    values = observer.step(memory, u, y, theta)
    return dict(zip(STEP_OUTPUTS, (np.array(v).ravel() for v in values), strict=True))


def bits(found):
    word = int(found["status"][0])
    return {name for name, bit in STATUS.items() if word & bit}


def near(observer, reach=0.01):
    box = np.stack([CENTRE - reach, CENTRE + reach], axis=1)
    return observer.memory0(CENTRE, x_range=box, f_range=np.tile([-reach, reach], (3, 1)))


def test_the_step_is_the_runge_kutta_step_of_the_ode(designed):
    observer = designed("noise")
    h = observer.model.Ts
    memory = near(observer)
    memory[:6] += [0.1, -0.2, 0.05, 0.01, 0.02, -0.03]
    y, theta = np.array([10.1, 9.9, 10.2]), np.array([0.3, 0.8])

    def rate(value):
        return np.array(observer.ode(value, U, y, theta)).ravel()

    k1 = rate(memory)
    k2 = rate(memory + h / 2 * k1)
    k3 = rate(memory + h / 2 * k2)
    k4 = rate(memory + h * k3)
    expected = memory + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    found = call(observer, memory, y, theta)["memory_next"]
    np.testing.assert_allclose(found[:6], expected[:6], rtol=1e-13, atol=1e-13)
    # the level in closed form: V' = alpha_q (1 - V)
    level = observer.memory_layout["level"]
    exact = 1 - (1 - memory[level]) * np.exp(-observer.performance["alpha_q"] * h)
    np.testing.assert_allclose(found[level], exact, rtol=1e-12)
    np.testing.assert_allclose(expected[level], exact, rtol=1e-9)
    assert found[-1] == 1.0


def test_the_gain_is_the_bilinear_mix(designed):
    observer = designed("box_tight")
    memory = near(observer)
    t1, t2 = 0.3, 0.8
    mix = {"L1": (1 - t1) * (1 - t2), "L2": (1 - t1) * t2, "L3": t1 * (1 - t2), "L4": t1 * t2}
    L = sum(weight * observer.gains[name] for name, weight in mix.items())
    rates = [
        np.array(observer.ode(memory, U, CENTRE + shift, [t1, t2])).ravel()[:6]
        for shift in (np.zeros(3), np.array([0.0, 1.0, 0.0]))
    ]
    np.testing.assert_allclose(rates[1] - rates[0], L[:, 1], rtol=1e-10, atol=1e-10)


def test_a_memory_of_zeros_is_not_initialised(designed):
    zeros = np.zeros(designed("noise").step.numel_in(0))
    found = call(designed("noise"), zeros)
    assert "not_initialised" in bits(found)
    assert not found["memory_next"].any() and np.isinf(found["f_upper"]).all()
    assert not np.array(designed("noise").ode(zeros, U, CENTRE, THETA)).any()


def test_the_start_is_certified_or_not(designed):
    observer = designed("noise")
    inside = near(observer)
    assert inside[observer.memory_layout["level"]] <= 1.0
    assert "fault_not_valid" not in bits(call(observer, inside))
    far = observer.memory0(CENTRE + 1.5, x_range=np.stack([CENTRE, CENTRE], axis=1))
    assert np.isinf(far[observer.memory_layout["level"]])
    found = call(observer, far)
    assert {"outside_domain", "fault_not_valid"} <= bits(found)
    np.testing.assert_array_equal(found["f_lower"], observer.model.box("f")[:, 0])
    np.testing.assert_allclose(found["x_upper"], CENTRE + NOISE, rtol=1e-12)
    assert np.isfinite(found["fhat"]).all()


@pytest.mark.long
def test_the_paper_starts_outside_its_own_polytope(designed):
    """xhat(0) = (11, 10.5, 12, 0, 0, 0) is not in c + P_e; with sets apart it is certified."""
    guess, truth = [11.0, 10.5, 12.0], np.stack([CENTRE, CENTRE], axis=1)
    for name in ("box_tight", "cross1"):
        observer = designed(name)
        assert "outside_domain" in bits(call(observer, observer.memory0(guess, x_range=truth)))
    apart = designed("apart")
    level = apart.memory0(guess, x_range=truth)[apart.memory_layout["level"]]
    assert level <= 1.0
    assert "fault_not_valid" not in bits(call(apart, apart.memory0(guess, x_range=truth)))


def test_membership_of_the_ellipsoid_is_monitored(designed):
    observer = designed("box_tight")
    memory = near(observer, 1e-3)
    assert "outside_domain" not in bits(call(observer, memory))
    memory[0] += 1.01 * np.sqrt(0.2)
    assert "outside_domain" in bits(call(observer, memory, y=memory[:3]))
    memory = near(observer, 1e-3)
    # one fault alone, and both together, leave it
    memory[3] = 0.8 * np.sqrt(0.1)
    assert "outside_domain" not in bits(call(observer, memory))
    memory[4] = 0.8 * np.sqrt(0.1)
    assert "outside_domain" in bits(call(observer, memory))


def test_scheduling_outside_its_range_is_told(designed):
    observer = designed("noise")
    found = call(observer, near(observer), theta=[1.01, 0.5])
    assert {"outside_domain", "fault_not_valid"} <= bits(found)
    np.testing.assert_allclose(found["x_upper"], CENTRE + NOISE, rtol=1e-12)
    lost = call(designed("box_tight"), near(designed("box_tight"), 1e-3), theta=[0.5, -0.01])
    assert "fault_not_valid" in bits(call(designed("box_tight"), lost["memory_next"]))


def test_an_innovation_that_no_error_in_the_set_explains(designed):
    observer = designed("noise")
    memory = near(observer)
    level = memory[observer.memory_layout["level"]].item()
    P = observer.gains["P"]
    reach = np.sqrt(level * np.linalg.inv(P)[1, 1]) + 0.015 * 2.5
    for share, expected in ((0.999, False), (1.001, True)):
        found = call(observer, memory, y=CENTRE + np.array([0.0, share * reach, 0.0]))
        assert ("void" in bits(found)) is expected


def test_a_bound_begins_anew_after_a_missing_measurement(designed):
    """From the strips and the declared ranges, where these lie in the error set."""
    for name, reach in (("noise", 0.01), ("box_tight", 1e-3)):
        observer = designed(name)
        for bad in (np.nan, np.inf, -np.inf):
            memory = near(observer, reach)
            before = call(observer, memory)
            found = call(observer, memory, y=[10.0, bad, 10.0])
            # of this instant all is known from before
            assert bits(found) == {"measurement_left_out"}
            np.testing.assert_array_equal(found["f_upper"], before["f_upper"])
            assert np.isfinite(found["memory_next"][:6]).all()
            after = call(observer, found["memory_next"])
            assert "measurement_left_out" not in bits(after)
            assert ("fault_not_valid" in bits(after)) is (name == "box_tight")


def test_the_bound_comes_back_where_the_region_lies_in_the_error_set(noiseless):
    memory = noiseless.memory0([5.0])
    assert memory[noiseless.memory_layout["level"]] <= 1.0
    _, *rest = noiseless.step(memory, 5.0, np.nan)
    assert int(rest[-1]) & STATUS["measurement_left_out"]
    memory, *_ = noiseless.step(memory, 5.0, np.nan)
    found = noiseless.step(memory, 5.0, 5.0)
    assert not int(found[-1]) & STATUS["fault_not_valid"]
    assert np.isfinite(np.array(found[6])).all()


def test_every_index_is_contained_and_a_shift_by_one_is_not(noiseless):
    """The set is narrower than one step's motion, so a set reported one step late fails."""
    Ts = noiseless.model.Ts
    steps = round(12.0 / Ts)
    scenario = ob.Scenario(
        "moving",
        steps,
        x0=[5.1],
        guess=[5.0],
        inputs=lambda k: [5.0 + 1.5 * np.sin(3.0 * k * Ts)],
        faults=np.full((steps + 1, 1), 0.02),
        x_range=[(4.8, 5.2)],
        f_range=[(-0.05, 0.05)],
    )
    run = ob.simulate(noiseless.model, noiseless, scenario, engine="joint")
    assert min(run.coverage.values()) == 1.0
    late = run.x[1:] <= run.x_upper[:-1]
    late &= run.x[1:] >= run.x_lower[:-1]
    assert not late.all()
    assert set(run.status[-10:].astype(int).tolist()) == {0}
