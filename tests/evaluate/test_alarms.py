"""Runs of fault detectors, and runs of observers without set bounds: tables and plots."""

import dataclasses

import numpy as np
import pytest

from obsynth.designs import FaultDetector
from obsynth.evaluate import (
    ReportError,
    coverage_table,
    plot_alarms,
    plot_errors,
    plot_run,
    plot_signal,
    report,
    simulate,
)
from obsynth.evaluate.run import Run, coverage_summary
from obsynth.symbolic import Plant, Table

pytestmark = [pytest.mark.usefixtures("no_window"), pytest.mark.filterwarnings("error")]

GROUPS = ("x", "f")


@pytest.fixture(scope="module")
def detected(toy):
    detector = FaultDetector(toy.observer(toy.plant, fault_delay=1), persistence=2)
    return detector, simulate(toy.plant, detector, toy.scenario(), seed=1)


def unbounded(run, groups=GROUPS) -> Run:
    changes = {}
    for group in groups:
        shape = getattr(run, group).shape
        changes[f"{group}_lower"] = np.full(shape, -np.inf)
        changes[f"{group}_upper"] = np.full(shape, np.inf)
    return dataclasses.replace(run, **changes, half_widths=None)


def labels(ax):
    return set(ax.get_legend_handles_labels()[1])


def test_alarms_stand_where_they_were_raised(detected):
    detector, run = detected
    raised = np.flatnonzero(run.alarm[:, 0])
    ax = plot_alarms(run)
    (_, alarms) = ax.collections
    boxes = [path.get_extents() for path in alarms.get_paths()]
    assert boxes[0].x0 == run.t[raised[0]]
    assert boxes[-1].x1 == run.t[-1]
    assert [tick.get_text() for tick in ax.get_yticklabels()] == ["f"]
    there = ax.collections[0].get_paths()[0].get_extents()
    assert there.x0 == run.t[np.flatnonzero(run.f[:, 0])[0]]
    assert boxes[0].x0 > there.x0
    again = plot_alarms(run, detector.detect(run).alarm, ax=ax)
    assert again is ax


def test_alarms_that_are_not_there_are_refused(toy_run):
    with pytest.raises(ReportError, match=r"toy has no alarms.*FaultDetector"):
        plot_alarms(toy_run)
    with pytest.raises(ReportError, match=r"alarms have shape \(3, 1\)"):
        plot_alarms(toy_run, np.zeros((3, 1)))
    calm = plot_alarms(toy_run, np.zeros(toy_run.f.shape))
    assert len(calm.collections[1].get_paths()) == 0


def test_panels_of_faults_are_shaded(detected):
    _, run = detected
    axes = run.plot()
    assert ["alarm" in labels(ax) for ax in axes] == [False, False, True]
    assert "alarm" in {text.get_text() for text in axes[0].figure.legends[0].get_texts()}
    (shade,) = (c for c in axes[2].collections if c.get_label() == "alarm")
    assert shade.get_paths()[0].get_extents().x0 == run.t[np.flatnonzero(run.alarm[:, 0])[0]]
    quiet = dataclasses.replace(run, alarm=None)
    assert "alarm" not in labels(quiet.plot()[2])


def test_a_detector_is_reported_like_its_observer(detected, tmp_path):
    detector, run = detected
    page = report(tmp_path / "page.html", detector, run).read_text()
    assert "truth, estimate, interval and alarms" in page
    assert "an alarm of f proves" in page
    assert "first alarm" not in page


def test_the_summary_names_the_first_alarm(detected):
    _, run = detected
    table = run.summary()
    assert table.columns[-1] == "first alarm [s]"
    assert [row[-1] for row in table.rows] == [
        None,
        None,
        run.t[np.flatnonzero(run.alarm[:, 0])[0]],
    ]


def test_infinite_bounds_are_no_coverage(toy_run):
    run = unbounded(toy_run)
    assert run.bounded == ()
    assert [row[1] for row in run.summary().rows] == ["n/a"] * 3
    assert "without set bounds" in repr(run)
    table = coverage_table({"with": [toy_run], "without": [run]})
    assert [row[3] for row in table.rows] == ["100 %", "n/a"]
    smallest = coverage_summary({"with": [toy_run], "without": [run]})
    assert [row[3] for row in smallest.rows] == ["100 %", "n/a"]
    assert smallest.numeric()[3]
    half = unbounded(toy_run, ("f",))
    assert half.bounded == ("a", "b")
    assert [row[1] for row in half.summary().rows] == ["100 %", "100 %", "n/a"]


def test_a_bound_on_one_side_or_at_one_instant_counts(toy_run):
    run = unbounded(toy_run, ("x",))
    upper, lower = run.x_upper.copy(), run.x_lower.copy()
    upper[:, 0] = 1e3
    lower[7, 1] = np.nan
    run = dataclasses.replace(run, x_upper=upper, x_lower=lower)
    assert run.bounded == ("a", "b", "f")
    assert run.coverage["b"] < 1.0


def test_infinite_bounds_are_not_drawn(toy_run):
    run = unbounded(toy_run)
    for axes in (run.plot(), plot_run(run, window=(5.0, 50.0)), plot_signal(run, "a")):
        assert {label for ax in axes for label in labels(ax)} == {"truth", "estimate"}
        for ax in axes:
            assert np.isfinite(ax.get_ylim()).all()
    for ax in plot_errors(run):
        assert labels(ax) == {"error"}


@pytest.mark.parametrize("steps", [60, 5000])
def test_a_stretch_without_bounds_is_a_gap(toy, steps):
    run = simulate(toy.plant, toy.observer(toy.plant), toy.scenario(steps=steps))
    lower, upper = run.x_lower.copy(), run.x_upper.copy()
    lower[20:30], upper[20:30] = -np.inf, np.inf
    gap = dataclasses.replace(run, x_lower=lower, x_upper=upper)
    for axes in (gap.plot(), plot_errors(gap, window=(0.0, float(run.t[-1])))):
        for ax in axes:
            assert np.isfinite(ax.get_ylim()).all()
            assert np.abs(ax.get_ylim()).max() < 60
    drawn = [line for line in gap.plot()[0].get_lines() if line.get_label() == "interval"]
    assert np.isnan(drawn[0].get_ydata()).any()


@pytest.mark.parametrize("delay", [0, 1])
def test_a_report_of_a_method_without_bounds(toy, delay, tmp_path):
    observer = toy.observer(toy.plant, fault_delay=delay, half_widths=None)
    run = unbounded(simulate(toy.plant, observer, toy.scenario()))
    page = report(tmp_path / "page.html", observer, run).read_text()
    assert "n/a" in page
    assert "truth and estimate" in page
    assert "truth, estimate and interval" not in page
    assert "of all instants inside" not in page
    assert "Half widths in steady state" not in page


def test_half_widths_that_are_partly_infinite(toy, tmp_path):
    observer = toy.observer(toy.plant, half_widths=np.array([0.1, np.inf, 1.0]))
    page = report(tmp_path / "page.html", observer).read_text()
    assert "n/a" in page
    assert ">inf<" not in page


def test_a_report_says_which_equations_the_guarantee_speaks_of(toy, tmp_path):
    plant = Plant("decay")
    (a,) = plant.states("a", range=(-50, 50))
    plant.dynamics([-a])
    plant.outputs([a])
    model = plant.discretise("rk4", Ts=0.5)
    words = {
        "All guarantees speak of the discrete model": {},
        "step is their approximation": {"ode": object(), "step_covered": False},
        "observed at these instants": {"ode": object(), "step_covered": True},
    }
    for expected, facts in words.items():
        observer = toy.observer(model, half_widths=None)
        for name, value in facts.items():
            object.__setattr__(observer, name, value)
        page = report(tmp_path / "page.html", observer).read_text().replace("&#39;", "'")
        assert [word in page for word in words] == [word == expected for word in words]


def test_not_applicable_is_flush_right_among_numbers():
    assert Table("t", ["a", "b"], [["n/a", "n/a"], ["3 %", "text"]]).numeric() == [True, False]
