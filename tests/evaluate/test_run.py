"""Coverage, violations, rms, widths, domain and labels of a run."""

import dataclasses

import numpy as np
import pytest

from obsynth.evaluate import SimulationError, coverage_table, simulate
from obsynth.evaluate.run import coverage_summary, percent


def test_a_sound_observer_covers_every_instant(toy_run, toy):
    assert toy_run.coverage == {"a": 1.0, "b": 1.0, "f": 1.0}
    assert toy_run.violations == ()
    late = simulate(toy.plant, toy.observer(toy.plant, fault_delay=1), toy.scenario(), seed=3)
    assert late.coverage == {"a": 1.0, "b": 1.0, "f": 1.0}


def test_the_mutant_shifted_by_one_step_is_caught(toy):
    run = simulate(toy.plant, toy.observer(toy.plant, shift=1), toy.scenario(), seed=3)
    assert run.coverage["a"] < 0.9
    assert run.coverage["b"] == 1.0
    (violation,) = run.violations
    assert violation.signal == "a"
    assert violation.count == round((1 - run.coverage["a"]) * (toy.N + 1))


def test_a_delayed_fault_is_compared_with_the_fault_it_speaks_of(toy):
    run = simulate(toy.plant, toy.observer(toy.plant, fault_delay=1), toy.scenario(), seed=3)
    trace = run["f"]
    assert len(trace.true) == toy.N
    np.testing.assert_array_equal(trace.true, run.f[:-1, 0])
    np.testing.assert_array_equal(trace.estimate, run.fhat[1:, 0])
    np.testing.assert_array_equal(trace.lower, run.f_lower[1:, 0])
    lagging = dataclasses.replace(run, fault_delay=0)
    assert lagging["f"].error.std() != trace.error.std()


def test_one_violated_sample_is_reported_at_tolerance_zero(toy_run):
    upper = toy_run.x_upper.copy()
    upper[57, 0] = np.nextafter(toy_run.x[57, 0], -np.inf)
    run = dataclasses.replace(toy_run, x_upper=upper)
    n = len(run.t)
    assert run.coverage["a"] == (n - 1) / n
    (violation,) = run.violations
    assert (violation.signal, violation.count, violation.instants) == ("a", 1, (57,))
    assert 0 < violation.worst < 1e-12
    assert violation.worst_at == 57
    assert "k = 57" in str(violation)
    assert percent(run.coverage["a"]) != "100 %"


def test_a_bound_on_the_truth_itself_still_holds(toy_run):
    run = dataclasses.replace(toy_run, x_lower=toy_run.x.copy(), x_upper=toy_run.x.copy())
    assert run.coverage["a"] == 1.0


def test_bounds_that_are_no_numbers_do_not_count_as_inside(toy_run):
    lower = toy_run.x_lower.copy()
    lower[3:8, 1] = np.nan
    run = dataclasses.replace(toy_run, x_lower=lower)
    assert run.coverage["b"] == 1 - 5 / len(run.t)
    assert run.violations[0].worst == np.inf


def test_infinite_bounds_hold_and_have_infinite_width(toy_run):
    run = dataclasses.replace(
        toy_run,
        f_lower=np.full_like(toy_run.f_lower, -np.inf),
        f_upper=np.full_like(toy_run.f_upper, np.inf),
    )
    assert run.coverage["f"] == 1.0
    assert np.isinf(run.widths["f"]).all()
    assert "∞" in run._repr_html_()


def test_rms_is_that_of_the_errors(toy_run):
    expected = np.sqrt(np.mean((toy_run.x[100:, 1] - toy_run.xhat[100:, 1]) ** 2))
    assert toy_run.rms(from_step=100)["b"] == pytest.approx(expected, rel=1e-14)
    assert toy_run.rms()["a"] == pytest.approx(np.sqrt(np.mean(toy_run.w**2)), rel=1e-12)
    for wrong in (-1, len(toy_run.t)):
        with pytest.raises(SimulationError, match="leaves no instant"):
            toy_run.rms(from_step=wrong)


def test_widths_are_half_the_interval(toy_run):
    np.testing.assert_allclose(toy_run.widths["a"], 0.1, atol=1e-12)
    assert toy_run.widths["b"][0] == pytest.approx(0.5)


def test_the_domain_names_who_left_and_when(toy_run):
    assert toy_run.domain.ok
    assert "at all 201 instants" in str(toy_run.domain)
    x = toy_run.x.copy()
    x[[20, 21], 1] = 2.5
    xhat = toy_run.xhat.copy()
    xhat[5, 0] = -51.0
    domain = dataclasses.replace(toy_run, x=x, xhat=xhat).domain
    assert not domain.ok
    assert np.flatnonzero(~domain.x_inside).tolist() == [20, 21]
    assert np.flatnonzero(~domain.xhat_inside).tolist() == [5]
    assert domain.left[0].startswith("b is outside its range [-2, 2] at 2 instants, first k = 20")
    assert domain.left[1].startswith(
        "the estimate of a is outside its range [-50, 50] at 1 instants"
    )


def test_either_of_truth_and_estimate_spoils_the_domain(toy_run):
    """At one instant of one signal, at either end. Mutants: one of both asked, or any instant."""
    for name in ("x", "xhat"):
        for value in (-51.0, 51.0):
            moved = getattr(toy_run, name).copy()
            moved[7, 0] = value
            domain = dataclasses.replace(toy_run, **{name: moved}).domain
            assert not domain.ok
            assert len(domain.left) == 1
            assert domain.left[0].endswith("first k = 7: " + f"{value:g}; at most 1 beyond")


def test_tables_of_coverage_say_whether_the_assumptions_were_kept(toy_run):
    """Of each run, and of all seeds together. Mutants: any of them; what left not asked."""
    x, upper = toy_run.x.copy(), toy_run.x_upper.copy()
    x[7, 0], upper[7, 1] = 51.0, -9.0
    left = dataclasses.replace(toy_run, x=x, seed=1)
    outside = dataclasses.replace(toy_run, outside=("a reason",), x_upper=upper, seed=2)
    runs = {"one": [toy_run, left, outside], "two": [toy_run]}
    rows = coverage_table(runs).rows
    assert [(row[1], row[2], row[-1]) for row in rows] == [
        ("one", 3, True),
        ("one", 1, False),
        ("one", 2, False),
        ("two", 3, True),
    ]
    found = coverage_summary(runs).rows
    assert [(row[1], row[2], row[-1]) for row in found] == [("one", 3, False), ("two", 1, True)]
    # the smallest over the seeds
    assert found[0][4] == percent(1 - 1 / len(toy_run.t)) == "99.50 %"
    assert found[1][4] == "100 %"


def test_status_bits_are_counted_and_explained(toy_run):
    status = np.zeros_like(toy_run.status)
    status[:3] = 4
    status[10] = 2 | 16
    status[50] = 1024
    counts = dataclasses.replace(toy_run, status=status).domain.status
    assert [(c.bit, c.count, c.first) for c in counts] == [
        (2, 1, 10),
        (4, 3, 0),
        (16, 1, 10),
        (1024, 1, 50),
    ]
    assert "scheduling variable was not finite" in counts[0].meaning
    assert "domain of the guarantee" in counts[1].meaning
    assert "fault interval is not valid" in counts[2].meaning
    assert "does not know" in counts[3].meaning


def test_every_bit_of_the_contract_has_a_sentence():
    from obsynth.designs.core.observer import STATUS
    from obsynth.evaluate.domain import count_status

    counts = count_status(np.array([sum(STATUS.values())]))
    assert [c.bit for c in counts] == [1, 2, 4, 8, 16, 32, 64]
    assert all(" " in c.meaning and "not know" not in c.meaning for c in counts)


def test_signals_are_found_by_name(toy_run):
    assert toy_run["v"].estimate is None
    assert toy_run["y1"].label == "y1 [cm]"
    assert toy_run["a"].label == "a [cm]"
    assert toy_run["b"].label == "b"
    with pytest.raises(
        SimulationError, match="no signal is called 'h9'; there are a, b, v, d"
    ) as e:
        toy_run["h9"]
    assert e.value.symbol == "h9"
    with pytest.raises(SimulationError, match="v is not estimated"):
        _ = toy_run["v"].error


def test_a_run_cannot_be_changed(toy_run):
    with pytest.raises(dataclasses.FrozenInstanceError):
        toy_run.seed = 1
    with pytest.raises(ValueError, match="read-only"):
        toy_run.x[0, 0] = 1.0


def test_xarray_carries_labels_and_units(toy_run):
    data = toy_run.to_xarray()
    assert data.x.dims == ("time", "state")
    assert data.x.sel(state="b").values.tolist() == toy_run.x[:, 1].tolist()
    assert data.state_unit.values.tolist() == ["cm", ""]
    assert data.y.sel(output="y1").shape == (len(toy_run.t),)
    assert data.time.values[1] == 0.5
    assert data.attrs["scenario"] == "ramp"
    assert set(data.data_vars) >= {"x", "xhat", "x_lower", "x_upper", "fhat", "status", "d", "w"}


def test_html_is_escaped_and_complete(toy_run):
    run = dataclasses.replace(toy_run, scenario="<b>&", outside=("a < b",))
    page = run._repr_html_()
    assert "<b>&" not in page
    assert "&lt;b&gt;&amp;" in page
    assert "a &lt; b" in page
    assert page.count("100 %") == 3
    assert "inside at 100 %" in repr(toy_run)
