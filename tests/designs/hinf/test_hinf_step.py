"""The step: causal order, first sample, missing data, domain, and the same numbers in C."""

import casadi as ca
import numpy as np
import pytest

import obsynth as ob
from obsynth.codegen import find_compiler
from obsynth.designs.core.observer import STATUS


def run(step, memory, inputs, outputs):
    """Feed samples to a step and stack what it returns."""
    logs = []
    for u, y in zip(inputs, outputs, strict=True):
        results = [np.array(r).ravel() for r in step(memory, u, y)]
        memory = results[0]
        logs.append(results)
    return [np.array(series) for series in zip(*logs, strict=True)]


@pytest.fixture(scope="module")
def nominal(consistent, paper_filter):
    return ob.simulate(consistent[0].model, paper_filter, ob.scenarios.hinf_example())


def fault_error(run):
    """f_k - fhat_k, where fhat_k is returned at k + 1."""
    return run.f[:-1, 0] - run.fhat[1:, 0]


def test_scenario_of_the_paper(nominal, hinf_reference):
    expected = hinf_reference["sim"]["g51_KP"]
    error = np.linalg.norm(nominal.x - nominal.xhat, axis=1)
    np.testing.assert_allclose(error[:21], expected["norm_e"], atol=1e-12)
    np.testing.assert_allclose(fault_error(nominal)[:21], expected["epsf"], atol=1e-12)
    stated = [3.7416574, 4.7142291, 1.2433687, 0.39149612, 0.11948697, 0.03982481, 0.01193824]
    np.testing.assert_allclose(error[:7], stated, atol=1e-7)
    first = [-1.1034, 0.65349798, -0.09119233, 0.03251334]
    np.testing.assert_allclose(fault_error(nominal)[:4], first, atol=1e-8)
    estimates = nominal.fhat[[200, 201, 301, 302], 0]
    np.testing.assert_allclose(estimates, [0.0, 1.0, 1.0, 0.0], atol=1e-6)


def test_a_fault_estimate_reported_for_another_instant_is_wrong(nominal):
    assert nominal.observer.fault_delay == 1 if hasattr(nominal, "observer") else True
    early = nominal.f[:, 0] - nominal.fhat[:, 0]
    assert np.abs(early[[200, 301]]).min() > 0.99
    assert np.abs(fault_error(nominal)[[199, 200, 300, 301]]).max() < 1e-6


def test_disturbed_scenario(consistent, paper_filter, hinf_reference):
    scenario = ob.scenarios.hinf_example("disturbed")
    disturbed = ob.simulate(consistent[0].model, paper_filter, scenario)
    error = fault_error(disturbed)
    ratio = np.linalg.norm(error) / np.linalg.norm(disturbed.w[:-1])
    assert ratio == pytest.approx(0.2455122, abs=1e-7)
    assert ratio == pytest.approx(hinf_reference["sim"]["g51_KP"]["det_ratio"], abs=1e-12)
    assert disturbed.x.max() > 38  # far outside [-5, 5]
    assert disturbed.domain.ok


def test_random_noise_is_a_weak_test(consistent, paper_filter):
    noise = ob.scenarios.hinf_example("noise")
    ratios = []
    for seed in range(5):
        found = ob.simulate(consistent[0].model, paper_filter, noise, seed=seed)
        ratios.append(np.linalg.norm(fault_error(found)) / np.linalg.norm(found.w[:-1]))
    assert max(ratios) < 0.28 < paper_filter.performance["l2_gain"]


def test_step_is_the_filter_of_the_paper(consistent, paper_filter, nominal):
    """(18)-(19), written with Abar, Bbar, G, Lbar and g, against the step."""
    split, gains = consistent[0], paper_filter.gains
    g = split.g_function()
    C, A, B = split.C, split.A, split.B
    xhat = nominal.xhat[0]
    for k in range(60):
        y, y_next, u = nominal.y[k], nominal.y[k + 1], nominal.u[k]
        value = np.array(g(xhat, u)).ravel()
        fhat = gains["H"] @ (y_next - C @ (A @ xhat + B @ u + value))
        np.testing.assert_allclose(nominal.fhat[k + 1], fhat, atol=1e-12)
        xhat = (
            gains["Abar"] @ xhat
            + gains["Bbar"] @ u
            + gains["G"] @ value
            + gains["Lbar"] @ y_next
            + gains["K"] @ (y - C @ xhat)
        )
        np.testing.assert_allclose(nominal.xhat[k + 1], xhat, atol=1e-12)


def test_general_filter_runs_as_designed(consistent):
    """fhat = H r + D r0 and xhat+ = p + F r + K r0; a mutant without D differs."""
    split = consistent[0]
    observer = ob.HinfUIO(method="general").design(*consistent)
    found = ob.simulate(split.model, observer, ob.scenarios.hinf_example())
    gains, g, C = observer.gains, split.g_function(), split.C
    assert np.abs(gains["D"]).max() > 1e-3
    xhat = found.xhat[0]
    largest = 0.0
    for k in range(60):
        p = split.A @ xhat + split.B @ found.u[k] + np.array(g(xhat, found.u[k])).ravel()
        r, r0 = found.y[k + 1] - C @ p, found.y[k] - C @ xhat
        fhat = gains["H"] @ r + gains["D"] @ r0
        largest = max(largest, np.abs(found.fhat[k + 1] - gains["H"] @ r).max())
        np.testing.assert_allclose(found.fhat[k + 1], fhat, atol=1e-12)
        xhat = p + gains["F"] @ r + gains["K"] @ r0
        np.testing.assert_allclose(found.xhat[k + 1], xhat, atol=1e-12)
    assert largest > 1e-3


def test_the_first_sample_only_initialises(paper_filter):
    memory = paper_filter.memory0([1.0, 2.0, 3.0])
    _, xhat, fhat, *_, status = run(paper_filter.step, memory, [[0.0]] * 2, [[5.0, -5.0]] * 2)
    np.testing.assert_array_equal(xhat[0], [1.0, 2.0, 3.0])
    assert fhat[0] == 0.0 and fhat[1] != 0.0
    assert status.ravel().tolist() == [STATUS["fault_not_valid"], 0]


def test_a_memory_of_zeros_stays_as_it_is(paper_filter):
    size = paper_filter.step.size_in(0)[0]
    result = paper_filter.step(np.zeros(size), [0.5], [1.0, 2.0])
    np.testing.assert_array_equal(np.array(result[0]).ravel(), np.zeros(size))
    assert int(result[-1]) & STATUS["not_initialised"]


def test_the_filter_itself_has_no_set_bounds(consistent, paper_gain):
    observer = ob.HinfUIO(method="polytopic", cuts=()).analyse(*consistent[:1], paper_gain)
    assert observer.half_widths is None
    memory = observer.memory0([0, 0, 0])
    for _ in range(3):
        result = observer.step(memory, [0.0], [0.0, 0.0])
        memory = result[0]
    for lower, upper in ((result[3], result[4]), (result[5], result[6])):
        assert np.all(np.array(lower) == -np.inf) and np.all(np.array(upper) == np.inf)


def test_the_data_give_sets_where_disturbances_have_bounds(consistent, paper_filter):
    """y is exact in the example, so x1 and x2 are known to the last digits."""
    found = ob.simulate(consistent[0].model, paper_filter, ob.scenarios.hinf_example("noise"))
    assert np.ptp(found.x_upper[1:, :2] - found.x_lower[1:, :2]) < 1e-10
    assert set(found.coverage.values()) == {1.0}


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_missing_measurement(bad, nominal, paper_filter):
    """The step predicts, says so, and is right again afterwards."""
    u, y = nominal.u[:60].copy(), nominal.y[:60].copy()
    y[30, 1] = bad
    start = paper_filter.memory0([0, 0, 0])
    memory, xhat, fhat, *_, status = run(paper_filter.step, start, u, y)
    flags = status.ravel().astype(int)
    assert flags[30] == STATUS["measurement_left_out"] | STATUS["fault_not_valid"]
    assert not flags[1:30].any() and not flags[31:].any()
    assert np.isfinite(memory).all() and np.isfinite(xhat).all() and np.isfinite(fhat).all()
    assert np.abs(xhat[-1] - nominal.x[59]).max() < 1e-6


def test_a_missing_input_spoils_the_next_fault_only(nominal, paper_filter):
    u, y = nominal.u[:60].copy(), nominal.y[:60].copy()
    u[30] = np.nan
    *_, status = run(paper_filter.step, paper_filter.memory0([0, 0, 0]), u, y)
    flags = status.ravel().astype(int)
    assert flags[30] == STATUS["non_finite_input"]
    assert flags[31] == STATUS["fault_not_valid"]
    assert not flags[32:].any()


def small_box():
    """The example on X = [-5, 5]^3, which the paper's own scenario leaves."""
    plant = ob.plants.hinf_example()
    record = plant.to_dict()
    for signal in record["signals"]:
        if signal["role"] == "state":
            signal["lower"], signal["upper"] = -5.0, 5.0
    return ob.Plant.from_dict(record)


def test_leaving_the_domain_is_reported(consistent, paper_gain):
    plant = small_box()
    assert plant.box("x").tolist() == [[-5.0, 5.0]] * 3
    observer = ob.HinfUIO(method="polytopic").analyse(plant, paper_gain)
    found = ob.simulate(consistent[0].model, observer, ob.scenarios.hinf_example())
    outside = np.abs(found.xhat).max(axis=1) > 5.0
    away = STATUS["outside_domain"] | STATUS["void"]
    flagged = (found.status.ravel().astype(int) & away) > 0
    assert outside.sum() > 100
    assert np.all(flagged[outside])
    error = np.abs(fault_error(found))
    assert 0.29 < error.max() < 1.2 and error[60:].max() > 0.29


def test_the_argument_of_the_nonlinearity_is_clipped(consistent, paper_gain):
    """Outside X, A xhat goes on and g stays at the border; without clipping g would go on."""
    observer = ob.HinfUIO(method="polytopic").analyse(small_box(), paper_gain)
    split = consistent[0]
    g = split.g_function()
    layout = observer.memory_layout
    guess = np.array([7.0, -8.0, 6.0])
    result = observer.step(observer.memory0(guess), [0.25], [7.0, -8.0])
    p = np.array(result[0]).ravel()[layout["prediction"]]
    linear = split.A @ guess + split.B @ [0.25]
    clipped = linear + np.array(g(np.clip(guess, -5, 5), 0.25)).ravel()
    np.testing.assert_allclose(p, clipped, atol=1e-12)
    assert np.abs(p - linear - np.array(g(guess, 0.25)).ravel()).max() > 0.05


def test_a_measurement_outside_the_range_is_reported(paper_filter):
    memory = paper_filter.memory0([0, 0, 0])
    for y, expected in (([49.9, 0.0], 0), ([50.1, 0.0], STATUS["void"])):
        status = int(paper_filter.step(memory, [0.0], y)[-1])
        assert status & STATUS["void"] == expected


def test_an_input_of_any_size_is_covered_where_it_enters_linearly(paper_filter):
    memory = paper_filter.memory0([0, 0, 0])
    status = int(paper_filter.step(memory, [1.5], [0.0, 0.0])[-1])
    assert not status & STATUS["outside_domain"]
    assert not any("u in" in one for one in paper_filter.guarantee.assumptions)


@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("method", ["standard", "general"])
def test_generated_c_equals_the_virtual_machine(method, consistent, tmp_path):
    observer = ob.HinfUIO(method=method).design(*consistent)
    project = ob.generate_c(observer, tmp_path / "hinf", vectors=2000)
    assert project.comparison is not None
    assert project.comparison.vectors == 2000
    assert "equal to the last bit" in str(project)


def test_step_names(paper_filter):
    step = paper_filter.step
    assert isinstance(step, ca.Function)
    assert step.name_in() == ["memory", "u", "y"]
    assert paper_filter.fault_delay == 1
    assert sum(s.stop - s.start for s in paper_filter.memory_layout.values()) == step.size_in(0)[0]
