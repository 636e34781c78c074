"""The discrete step: exact exponential, inclusion at every sample, missing data, starting again."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

import obsynth as ob
from obsynth.designs.set_adaptive import step as step_module
from obsynth.designs.set_adaptive.method import SetAdaptiveObserver
from obsynth.designs.set_adaptive.transition import LARGEST_PRODUCT, apply, uniformisation

BOUND = 4.5e-3
LEVELS = np.array([(0.44, 0.56), (0.04, 0.16), (0.24, 0.36)])


# -- the exponential -----------------------------------------------------------------


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.integers(1, 4), st.floats(0.001, 8.0), st.integers(0, 2**32 - 1))
def test_uniformisation_is_the_exponential(n, h, seed):
    rng = np.random.default_rng(seed)
    M = rng.uniform(0, 1, (n, n))
    np.fill_diagonal(M, -rng.uniform(0.1, 4, n))
    mu = float((-np.diag(M)).max())
    weights = uniformisation(h, mu)
    state, drive = rng.normal(size=(n, 2)), rng.normal(size=(n, 2))
    found = np.array(ca.DM(ca.evalf(apply(weights, ca.SX(M), ca.SX(state), ca.SX(drive)))))
    block = np.block([[M, np.eye(n)], [np.zeros((n, 2 * n))]])
    whole = expm(h * block)
    expected = whole[:n, :n] @ state + whole[:n, n:] @ drive
    size = np.abs(whole[:n, :n]) @ np.abs(state) + np.abs(whole[:n, n:]) @ np.abs(drive)
    assert (np.abs(found - expected) <= 1e-12 * size + 1e-300).all()


def test_all_terms_are_nonnegative_and_none_is_missing():
    for product in (1e-6, 0.03, 3.0, LARGEST_PRODUCT):
        weights = uniformisation(1.0, product)
        assert (weights.state >= 0.0).all()
        assert (weights.drive >= 0.0).all()
        assert weights.state.sum() == pytest.approx(1.0, abs=1e-14)
        assert weights.drive.sum() == pytest.approx(1.0, rel=1e-13)
    with pytest.raises(ob.ObsynthError, match="too long") as refusal:
        uniformisation(1.0, 1.01 * LARGEST_PRODUCT)
    assert refusal.value.largest < 1.0


def test_explicit_euler_loses_the_sign_just_beyond_its_longest_step(printed, hull, structure):
    M = hull[0] - printed.gains["L"] @ structure.C
    longest = printed.performance["euler_step"]
    assert (np.eye(3) + 0.999999 * longest * M >= 0.0).all()
    assert (np.eye(3) + 1.000001 * longest * M).min() < 0.0
    assert (expm(100 * longest * M) >= 0.0).all()


def test_a_step_far_beyond_eulers_keeps_the_order(tanks):
    observer = SetAdaptiveObserver(Ts=5.0, gain_cap=0.5).design(tanks)
    assert observer.performance["euler_step"] < 2.0 < observer.model.Ts
    narrow = np.array([(0.499, 0.501), (0.099, 0.101), (0.299, 0.301)])
    memory = observer.memory0([0.5, 0.1, 0.3], x_range=narrow, f_range=np.zeros((2, 2)))
    x, u = np.array([0.5, 0.1, 0.3]), [5.8e-5, 3.5e-6]
    fine = tanks.discretise("rk4", 0.05).function()
    for _ in range(20):
        memory, *_, low, high, _, _, status = observer.step(memory, u, x[:2])
        assert int(status) == 0
        assert (np.array(low).ravel() <= x).all()
        assert (x <= np.array(high).ravel()).all()
        for _ in range(100):
            x = np.array(fine(x, u, [], [0, 0], [0, 0], [], [])[0]).ravel()


# -- inclusion -----------------------------------------------------------------------


def hard_run(loop, seed, steps=400, bound=BOUND, size=6e-5):
    """Bang-bang or asymmetric noise, starts near corners, constant faults up to their ends."""
    rng = np.random.default_rng(seed)
    w = bound * (1 - 1e-12) * rng.choice([-1.0, 1.0], (steps, 2))
    if seed % 3 == 0:
        w = np.tile(bound * (1 - 1e-12) * rng.choice([-1.0, 1.0], 2), (steps, 1))
    if seed % 3 == 1:
        w = np.abs(w)
    theta = size * rng.choice([-1.0, 0.0, 1.0], 2)
    inner = LEVELS.mean(axis=1)[:, None] + 0.4 * (LEVELS - LEVELS.mean(axis=1)[:, None])
    x0 = inner[np.arange(3), rng.integers(0, 2, 3)]
    f_range = np.column_stack([np.minimum(theta, 0.0), np.maximum(theta, 0.0)])
    run = loop(w, np.tile(theta, (steps, 1)), None, x0=x0, f_range=f_range)
    inside = ((run["x"] >= LEVELS[:, 0]) & (run["x"] <= LEVELS[:, 1])).all(axis=1)
    return {**run, "theta": theta, "inside": np.minimum.accumulate(inside)}


def violations(run):
    """States and faults outside of their sets, or a status, while the plant is in its ranges."""
    states = (run["x_lower"] > run["x"]) | (run["x"] > run["x_upper"])
    faults = (run["f_lower"] > run["theta"]) | (run["theta"] > run["f_upper"])
    told = (run["status"] != 0)[:, None]
    return int((states | told | np.c_[faults, faults[:, 0]])[run["inside"]].sum())


@pytest.fixture(scope="module")
def loop(cooperative, closed_loop):
    return closed_loop(cooperative)


@pytest.mark.parametrize("seed", range(50))
def test_inclusion_in_hard_runs(loop, seed):
    run = hard_run(loop, seed)
    assert run["inside"].sum() > 100
    assert violations(run) == 0
    assert set(run["status"][run["inside"]]) == {0}


@pytest.mark.long
def test_inclusion_in_a_thousand_hard_runs(loop):
    assert sum(violations(hard_run(loop, seed)) for seed in range(1000)) == 0


@pytest.fixture(scope="module")
def exact_observer(tanks):
    return SetAdaptiveObserver(noise=False, gain_cap=0.5, Ts=0.05).design(tanks)


def exact_violations(loop):
    """With exact outputs the sets are narrower than what the state moves in one step."""
    total = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        theta = 4e-5 * rng.choice([-1.0, 1.0], 2)
        run = loop(
            np.zeros((1500, 2)),
            np.tile(theta, (1500, 1)),
            None,
            f_range=np.sort(np.column_stack([theta, np.zeros(2)]), axis=1),
        )
        run["theta"] = theta
        run["inside"] = np.minimum.accumulate(
            ((run["x"] >= LEVELS[:, 0]) & (run["x"] <= LEVELS[:, 1])).all(axis=1)
        )
        total += violations(run)
    return total


def test_inclusion_with_exact_outputs(exact_observer, closed_loop):
    assert exact_violations(closed_loop(exact_observer)) == 0


@pytest.mark.parametrize(
    "mutant",
    ["sign of theta", "swapped bounds", "late by one", "sign of G", "less noise"],
)
def test_inclusion_sees_a_mutant(
    cooperative, exact_observer, closed_loop, certify, monkeypatch, mutant
):
    healthy = cooperative if mutant == "less noise" else exact_observer
    record, late = dict(healthy.record), 0
    if mutant == "sign of theta":
        right = step_module._adapt
        monkeypatch.setattr(
            step_module, "_adapt", lambda *given: tuple(-part for part in right(*given)[::-1])
        )
    elif mutant == "swapped bounds":
        bounds = dict(record["bounds"])
        bounds["lower"], bounds["upper"] = bounds["upper"], bounds["lower"]
        record["bounds"] = bounds
    elif mutant == "late by one":
        late = 1
    elif mutant == "sign of G":
        right_predict = step_module._predict

        def wrong(design, memory, lower, upper, smallest, largest):
            return right_predict(design, memory, lower, upper, -smallest, -largest)

        monkeypatch.setattr(step_module, "_predict", wrong)
    else:
        record["w_radius"] = (0.9 * np.array(record["w_radius"])).tolist()
    if mutant == "less noise":
        with pytest.raises(ob.CertificateError, match="disturbances"):
            certify(record).observer()
    unproved = {"claims": lambda design: ()} if mutant == "less noise" else {}
    broken = certify(record, **unproved).observer()
    loop = closed_loop(broken, late=late)
    if mutant == "less noise":
        assert sum(violations(hard_run(loop, seed)) for seed in range(12)) > 0
    else:
        assert exact_violations(loop) > 0


def one_level():
    """A level whose A = -x is known up to what it moves within a step."""
    plant = ob.Plant("one level")
    (x,) = plant.states("x", range=(0.1, 3.0))
    (u,) = plant.inputs("u", range=(0.0, 4.0))
    plant.actuator_faults("f", of=u, range=(-0.2, 0.2))
    plant.dynamics([-(x**2) + u])
    plant.outputs([x])
    return plant


def count_one_level(observer):
    rng = np.random.default_rng(4)
    fine = one_level().discretise("rk4", observer.model.Ts / 20).function()
    x, total = np.array([1.0]), 0
    memory = observer.memory0(x, x_range=[(1.0, 1.0)])
    for _ in range(60):
        u = rng.uniform(0.5, 4.0, 1)
        memory, *_, f_low, f_high, status = observer.step(memory, u, x)
        total += int(float(f_low) > 0.1 or float(f_high) < 0.1 or int(status) != 0)
        for _ in range(20):
            x = np.array(fine(x, u, [], [0.1], [], [], [])[0]).ravel()
    return total


def test_what_moves_within_a_step_is_included(certify):
    observer = SetAdaptiveObserver(Ts=0.2, Gamma=10.0).design(one_level())
    assert count_one_level(observer) == 0
    record = dict(observer.record)
    record["rate"], record["input_rate"] = [[0.0, 0.0]], [[0.0]]
    standing = certify(record).observer()
    assert count_one_level(standing) > 0
    with pytest.raises(ob.CertificateError, match="outputs move"):
        standing.certificate.check()


# -- what is missing, what is outside ------------------------------------------------


def test_a_missing_measurement_keeps_the_guarantee(cooperative, tanks):
    F = cooperative.model.function()
    x, u = np.array([0.5, 0.1, 0.3]), [5.8e-5, 3.5e-6]
    memory = cooperative.memory0(x, f_range=np.zeros((2, 2)))
    rng = np.random.default_rng(1)
    for k in range(300):
        y = x[:2] + rng.choice([-BOUND, BOUND], 2) * (1 - 1e-12)
        if k % 10 == 5:
            y[k % 2] = np.nan
        memory, *_, low, high, _, _, status = cooperative.step(memory, u, y)
        assert int(status) == (32 if k % 10 == 5 else 0)
        assert (np.array(low).ravel() <= x).all()
        assert (x <= np.array(high).ravel()).all()
        x = np.array(F(x, u, [], [0, 0], [0, 0], [], [])[0]).ravel()
    assert np.isfinite(np.array(memory)).all()


def test_after_an_unknown_input_it_starts_again(cooperative):
    u, y = [5.8e-5, 3.5e-6], [0.5, 0.1]
    memory = cooperative.memory0(
        [0.5, 0.1, 0.3],
        x_range=0.25 * LEVELS + 0.75 * LEVELS[:, ::-1] * 0 + 0.75 * LEVELS.mean(axis=1)[:, None],
        f_range=np.zeros((2, 2)),
    )
    blind = cooperative.step(memory, [np.inf, 0.0], y)
    assert int(blind[7]) == 2
    assert np.isfinite(np.array(blind[0])).all()
    again = cooperative.step(blind[0], u, y)
    assert int(again[7]) == 0
    assert np.array(again[3])[2] == LEVELS[2, 0]
    assert np.array(again[6]).ravel() == pytest.approx([2e-4, 2e-4])


def test_an_output_outside_of_its_range_is_reported(cooperative):
    u = [5.8e-5, 3.5e-6]
    memory = cooperative.memory0([0.5, 0.1, 0.3], f_range=np.zeros((2, 2)))
    edge = cooperative.step(memory, u, [0.56 + BOUND, 0.1])
    assert int(edge[7]) == 0
    outside = cooperative.step(memory, u, [0.36, 0.1])
    assert int(outside[7]) == 8 + 32
    assert np.isfinite(np.array(outside[0])).all()
    still = cooperative.step(outside[0], u, [0.57, 0.1])
    assert int(still[7]) == 8 + 32
    back = cooperative.step(still[0], u, [0.5, 0.1])
    assert int(back[7]) == 64
    assert np.array(back[3])[2] == LEVELS[2, 0]
    assert np.array(back[6]).ravel() == pytest.approx([2e-4, 2e-4])


def test_zeros_are_not_initialised(cooperative):
    n = cooperative.step.numel_in(0)
    results = cooperative.step(np.zeros(n), [0, 0], [0.5, 0.1])
    assert int(results[7]) & 1
    assert np.array(results[0]).ravel().tolist() == [0.0] * n
    assert np.isinf(np.array(results[4])).all()


def test_the_step_tends_to_the_continuous_form(tanks):
    observer = SetAdaptiveObserver(gain_cap=0.5, Ts=1e-5, window=30.0).design(tanks)
    rng = np.random.default_rng(2)
    memory = observer.memory0([0.5, 0.1, 0.3])
    layout = observer.memory_layout
    for name in ("Omega_m", "Omega_M"):
        memory[layout[name]] = memory[layout[f"{name}_2"]] = -rng.uniform(0, 20, 6)
    for name in ("R_m", "R_M", "b_m", "b_M", "weight"):
        part = layout[name]
        memory[part] = rng.uniform(0, 5, part.stop - part.start)
    u, y = np.array([5.8e-5, 3.5e-6]), np.array([0.5, 0.1])
    slope = (np.array(observer.step(memory, u, y)[0]).ravel() - memory) / 1e-5
    rates = np.array(observer.ode(memory, u, y)).ravel()
    for name in set(layout) - {"age"}:
        part = layout[name]
        np.testing.assert_allclose(slope[part], rates[part], rtol=1e-3, atol=2e-6, err_msg=name)


def test_the_window_of_the_monitors(tanks):
    from obsynth.designs.set_adaptive.indicators import monitors

    observer = SetAdaptiveObserver(gain_cap=0.5, window=5.0, Ts=0.2).design(tanks)
    memory = observer.memory0([0.5, 0.1, 0.3])
    with pytest.raises(ob.ObsynthError, match="no window"):
        monitors(observer, memory)
    for _ in range(2000):
        memory = observer.step(memory, [5.8e-5, 3.5e-6], [0.5, 0.1])[0]
    found = monitors(observer, np.array(memory).ravel())
    assert found.weight == pytest.approx(5.0, rel=0.03)
    assert found.excitation > 1.0
    # in steady state the mean over the window is the present value
    layout = observer.memory_layout
    N = -np.array(memory).ravel()[layout["Omega_m"]].reshape(3, 2)[:2]
    assert found.R_m == pytest.approx(N.T @ N, rel=1e-3)
