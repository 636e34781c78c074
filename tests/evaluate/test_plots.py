"""Plots return what they drew, draw what the run holds, and never open a window."""

import dataclasses

import numpy as np
import pytest

from obsynth.evaluate import (
    ReportError,
    plot_alarms,
    plot_errors,
    plot_run,
    plot_signal,
    plot_widths,
)
from obsynth.evaluate.plotting.layout import thin
from obsynth.symbolic import ObsynthError, RecordError
from obsynth.symbolic.records import three_tank_leak

pytestmark = pytest.mark.usefixtures("no_window")


def lines(ax):
    return {line.get_label(): line for line in ax.get_lines()}


def test_a_signal_is_drawn_with_estimate_interval_and_two_zooms(toy_run):
    main, convergence, inclusion = plot_signal(toy_run, "a")
    drawn = lines(main)
    assert {"truth", "estimate", "interval"} <= set(drawn)
    np.testing.assert_array_equal(drawn["truth"].get_ydata(), toy_run.x[:, 0])
    np.testing.assert_array_equal(drawn["estimate"].get_ydata(), toy_run.xhat[:, 0])
    assert main.get_ylabel() == "a [cm]"
    assert convergence.get_xlim()[0] == 0.0
    assert convergence.get_xlim()[1] < toy_run.t[-1] / 2
    moving = toy_run.t[np.flatnonzero(np.diff(toy_run.f[:, 0]))]
    start, stop = inclusion.get_xlim()
    assert ((moving >= start) & (moving <= stop)).any()


def test_an_axes_that_is_given_is_drawn_into_with_insets(toy_run):
    import matplotlib.pyplot as plt

    _, ax = plt.subplots()
    assert plot_signal(toy_run, "b", ax=ax) is ax
    assert len(ax.child_axes) == 2
    _, plain = plt.subplots()
    plot_signal(toy_run, "b", ax=plain, zooms=(), legend=False)
    assert plain.child_axes == []
    assert plain.get_legend() is None


def test_zooms_of_the_users_choice_are_checked(toy_run):
    axes = plot_signal(toy_run, "f", zooms=[(10.0, 20.0)])
    assert len(axes) == 2
    assert axes[1].get_xlim() == (10.0, 20.0)
    with pytest.raises(ReportError, match=r"zoom \(90, 200\) is not inside the run, 0 to 100 s"):
        plot_signal(toy_run, "f", zooms=[(90.0, 200.0)])


def test_signals_without_estimate_are_drawn_alone(toy_run):
    (main,) = plot_signal(toy_run, "v")
    assert list(lines(main)) == ["truth"]


def test_the_grid_shows_every_estimated_signal(toy_run):
    axes = toy_run.plot()
    assert [ax.get_ylabel() for ax in axes] == ["a [cm]", "b", "f [V]"]
    chosen = plot_run(toy_run, "b", window=(5.0, 15.0))
    assert chosen[0].get_xlim() == (5.0, 15.0)
    with pytest.raises(ReportError, match="2 axes were given for 3 signals"):
        plot_run(toy_run, ax=axes[:2])


def test_errors_are_drawn_between_their_bounds(toy_run):
    axes = plot_errors(toy_run, window=(0.0, 100.0))
    drawn = lines(axes[0])
    np.testing.assert_allclose(drawn["error"].get_ydata(), -toy_run.w[:, 0], atol=1e-12)
    np.testing.assert_allclose(drawn["bounds"].get_ydata(), 0.1, atol=1e-12)
    both = plot_errors({"one": toy_run, "two": dataclasses.replace(toy_run, seed=9)})
    assert {"one: bounds", "one: error", "two: bounds", "two: error"} <= set(lines(both[1]))
    with pytest.raises(ReportError, match="no run"):
        plot_errors({})


def test_half_widths_are_bars_with_their_numbers(toy_run):
    ax = plot_widths({"wide": [1.0, 2.0, np.inf], "narrow": [0.5, 0.25, 1.0]}, ["a", "b", "f"])
    heights = [bar.get_height() for bar in ax.patches]
    assert heights == [1.0, 2.0, 0.0, 0.5, 0.25, 1.0]
    assert {"∞", "0.25"} <= {text.get_text() for text in ax.texts}
    assert [t.get_text() for t in ax.get_xticklabels()] == ["a", "b", "f"]
    several = plot_widths({"one": [1.0, 2.0, 3.0]}, ["a", "f", "b"], ["cm", "V", "cm"])
    assert [[bar.get_height() for bar in axes.patches] for axes in several] == [[1.0, 3.0], [2.0]]
    assert [t.get_text() for t in several[1].get_xticklabels()] == ["f\n[V]"]
    assert {mark.get_rotation() for mark in ax.texts} == {0.0}
    crowd = plot_widths({str(k): np.full(6, 1.25) for k in range(3)}, "abcdef")
    assert {mark.get_rotation() for mark in crowd.texts} == {90.0}, "numbers stand over each other"
    with pytest.raises(ReportError, match="'wide' has half widths of shape"):
        plot_widths({"wide": [1.0]}, ["a", "b"])


def test_observers_bring_their_names_and_units_and_numbers_do_not(toy, toy_run):
    observer = toy.observer(toy.plant)
    drawn = plot_widths({"toy": observer, "twice": 2 * observer.half_widths})
    assert [[t.get_text() for t in axes.get_xticklabels()] for axes in drawn] == [
        ["a\n[cm]"],
        ["b"],
        ["f\n[V]"],
    ]
    assert [bar.get_height() for bar in drawn[0].patches] == [0.1, 0.2]
    for wrong in ({"toy": [1.0, 2.0, 3.0]}, {}):
        with pytest.raises(ReportError, match=r"takes observers, or half widths .* names=\[...\]"):
            plot_widths(wrong)
    for wrong, kind in ((toy_run, "a Run"), ([1.0], "a list of float"), (None, "None")):
        with pytest.raises(ObsynthError, match=f"plot_widths takes half_widths as .* given {kind}"):
            plot_widths(wrong)


@pytest.mark.parametrize("plot", [plot_alarms, plot_errors, plot_run, plot_signal])
def test_what_is_no_run_is_refused(plot, toy, toy_run):
    """Mutants: None, and results of obsynth's own, pass."""
    rest = ("a",) if plot is plot_signal else ()
    for wrong in (toy.plant, [toy_run], None, toy_run["a"], toy_run.summary(), np.zeros(3)):
        with pytest.raises(ObsynthError, match=r"takes runs? as a Run .what ob\.simulate"):
            plot(wrong, *rest)


def heights(figure):
    """Letters of a figure in pixels where it is 400 pixels wide, by what they say."""
    figure.draw_without_rendering()
    shown = figure.findobj(lambda part: hasattr(part, "get_fontsize") and part.get_visible())
    scale = 400.0 / 72.0 / figure.get_figwidth()
    return {part.get_text(): scale * part.get_fontsize() for part in shown if part.get_text()}


def test_letters_are_nine_pixels_high_on_a_page_of_400(toy_run):
    """Mutants: a wider figure, smaller letters."""
    widths = {"wide": [1.0, 2.0, 3.0], "narrow": [0.5, 0.25, 1.0]}
    drawn = [
        toy_run.plot(),
        three_tank_leak().plot(),
        plot_errors({"one": toy_run, "two": toy_run}),
        plot_signal(toy_run, "a"),
        plot_alarms(toy_run, toy_run.f > 0.5),
        plot_widths(widths, ["a", "b", "f"], ["cm", "", "V"]),
    ]
    for axes in drawn:
        figure = np.atleast_1d(axes)[0].figure
        found = heights(figure)
        assert len(found) > 5 and min(found.values()) >= 9.0, found
        edges = figure.get_tightbbox()
        assert edges.x0 >= -0.02 and edges.x1 <= figure.get_figwidth() + 0.02


def test_a_record_is_drawn_into_the_axes_that_are_given(toy_run):
    record, axes = three_tank_leak(), toy_run.plot()
    (ax,) = record.plot("y1", ax=axes[0])
    assert ax is axes[0] and np.array_equal(ax.get_lines()[-1].get_ydata(), record["y1"])
    with pytest.raises(RecordError, match="3 axes were given for 2 channels"):
        record.plot(["y1", "y2"], ax=axes)


def test_the_settings_of_the_user_stay_untouched(toy_run):
    import matplotlib as mpl

    before = dict(mpl.rcParams)
    toy_run.plot()
    assert dict(mpl.rcParams) == before


def test_what_pyplot_sets_on_its_first_import_is_kept():
    import matplotlib as mpl

    from obsynth.evaluate.plotting.layout import style

    interactive = mpl.rcParams["interactive"]
    with style():
        mpl.rcParams["interactive"] = not interactive
    assert mpl.rcParams["interactive"] is not interactive
    mpl.rcParams["interactive"] = interactive


def test_thinning_keeps_every_extreme_and_the_order():
    rng = np.random.default_rng(0)
    t = np.arange(20_000.0)
    values = rng.normal(size=t.size)
    few_t, few = thin(t, values, columns=100)
    assert len(few) <= 400
    assert few.max() == values.max()
    assert few.min() == values.min()
    assert (np.diff(few_t) > 0).all()
    for start in range(0, 20_000, 200):
        part = (few_t >= start) & (few_t < start + 200)
        assert few[part].max() == values[start : start + 200].max()
    short = thin(t[:50], values[:50])
    np.testing.assert_array_equal(short[1], values[:50])


@pytest.mark.parametrize("steps", [1, 2, 38, 39, 45, 99])
def test_short_runs_are_drawn_too(toy, steps):
    from obsynth.evaluate import simulate

    scenario = toy.scenario(steps=steps, x0=[0.9, 0.4])
    run = simulate(toy.plant, toy.observer(toy.plant), scenario)
    assert len(plot_signal(run, "a")) == (3 if steps >= 39 else 1)
    assert len(plot_errors(run)) == 3
    assert len(run.plot()) == 3


def test_long_runs_are_drawn_with_few_points(toy):
    from obsynth.evaluate import simulate

    run = simulate(toy.plant, toy.observer(toy.plant), toy.scenario(steps=5000))
    axes = run.plot()
    assert max(len(line.get_xdata()) for ax in axes for line in ax.get_lines()) <= 2000
