"""Plots of runs: truth, estimate and interval, as in the figures of the papers.

Every function draws into ``ax=`` when given, returns the axes it drew and never
shows a window. matplotlib is imported on first use.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.designs.detection.comparison import VOID
from obsynth.evaluate.errors import ReportError
from obsynth.evaluate.plotting.alarms import shade, shade_status
from obsynth.evaluate.plotting.layout import (
    BARS,
    ESTIMATE,
    INK,
    INTERVAL,
    INTERVAL_FILL,
    SOFT,
    grid,
    name_lines,
    new_figure,
    style,
    thin,
)
from obsynth.evaluate.trace import Trace
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.taking import takes

if TYPE_CHECKING:
    from obsynth.evaluate.data.estimated import Estimate
    from obsynth.evaluate.run import Run

Window = tuple[float, float]


@takes(run="Run Estimate")
def plot_signal(
    run: "Run | Estimate",
    name: str,
    ax: Any = None,
    zooms: Sequence[Window] | None = None,
    legend: bool = True,
) -> Any:
    """Plot one signal with its estimate and interval, and zooms into it.

    The counterpart of figures 2 to 13 of Buciakowski et al.: truth black,
    estimate red, interval green.

    Parameters
    ----------
    run : Run or Estimate
        Of an estimate no truth is drawn.
    name : str
        A state, a fault, or any other signal of the run.
    ax : matplotlib Axes, optional
        Where to draw; zooms are then insets. Without it a figure is made with
        the zooms in panels below.
    zooms : sequence of (start, stop), optional
        Windows in seconds. By default two for signals with an estimate: the
        convergence after the start, and the inclusion where the fault moves or
        in the middle of the run. An empty sequence draws none.
    legend : bool
        Whether the lines are named.

    Returns
    -------
    Axes or ndarray of Axes
        The axes given, or all axes of the new figure, the main one first.

    Examples
    --------
    >>> axes = plot_signal(run, "h1")      # doctest: +SKIP
    """
    trace = run[name]
    windows = _windows(run, trace) if zooms is None else list(zooms)
    for start, stop in windows:
        if not trace.t[0] <= start < stop <= trace.t[-1]:
            raise ReportError(
                f"the zoom ({start:g}, {stop:g}) is not inside the run, "
                f"{trace.t[0]:g} to {trace.t[-1]:g} s.",
                window=(start, stop),
            )
    with style():
        main, below = ax, []
        if ax is None:
            figure = new_figure(4.2 if windows else 2.2)
            heights = (1.35, 1.0)[: 2 if windows else 1]
            grid = figure.add_gridspec(len(heights), max(len(windows), 1), height_ratios=heights)
            main = figure.add_subplot(grid[0, :])
            below = [figure.add_subplot(grid[1, i]) for i in range(len(windows))]
        _draw(main, trace)
        _labels(main, trace)
        for i, (panel, window) in enumerate(zip(below, windows, strict=False)):
            _draw(panel, trace, window)
            _labels(panel, trace, title=_window_title(i, window, zooms is None))
            main.axvspan(*window, color=SOFT, alpha=0.18, linewidth=0)
        if legend:
            name_lines([main, *below], main)
        if ax is None:
            return np.array([main, *below])
        if windows:
            low, high = ax.get_ylim()
            ax.set_ylim(low, high + 0.8 * (high - low))
        for i, window in enumerate(windows):
            inset = ax.inset_axes((0.13 + 0.47 * i, 0.66, 0.37, 0.3))
            _draw(inset, trace, window)
            inset.locator_params(nbins=3)
        return ax


@takes(run="Run Estimate")
def plot_run(
    run: "Run | Estimate",
    signals: str | Sequence[str] | None = None,
    ax: Any = None,
    window: Window | None = None,
) -> Any:
    """Plot all estimated signals of a run in a grid.

    Parameters
    ----------
    run : Run or Estimate
    signals : str or sequence of str, optional
        Which signals; all states and faults by default.
    ax : Axes or array of Axes, optional
        One for each signal; a new figure with two columns by default.
    window : (start, stop), optional
        Seconds to show; the whole run by default.

    Returns
    -------
    ndarray of Axes, one for each signal

    Notes
    -----
    Of signals without bounds truth and estimate are drawn; where a fault detector ran, its
    alarms shade the panels of the faults. Void and recovering instants are shaded everywhere.
    """
    names = _chosen(run, signals)
    with style():
        flat = grid(len(names), ax)
        for panel, name in zip(flat, names, strict=True):
            _draw(panel, run[name], window)
            _labels(panel, run[name])
        name_lines(flat, flat[0])
        return flat


@takes(runs="Run dict")
def plot_errors(
    runs: "Run | Mapping[str, Run]",
    signals: str | Sequence[str] | None = None,
    ax: Any = None,
    window: Window | None = None,
) -> Any:
    """Plot errors between the bounds that each run promised for them.

    Parameters
    ----------
    runs : Run or mapping of label to Run
        Several runs share the axes, for instance wide and narrow bounds.
    signals : str or sequence of str, optional
        Which signals; all states and faults by default.
    ax : Axes or array of Axes, optional
        One for each signal.
    window : (start, stop), optional
        Seconds to show; by default from where all intervals have come close to
        their final width, as the transient would set the scale.

    Returns
    -------
    ndarray of Axes, one for each signal
    """
    labelled = dict(runs) if isinstance(runs, Mapping) else {"": runs}
    if not labelled:
        raise ReportError("there is no run to plot.")
    first = next(iter(labelled.values()))
    names = _chosen(first, signals)
    start = max(_settled(run) for run in labelled.values())
    shown = (float(first.t[start]), float(first.t[-1])) if window is None else window
    with style():
        flat = grid(len(names), ax)
        for panel, name in zip(flat, names, strict=True):
            panel.axhline(0.0, color=SOFT, linewidth=0.7)
            for j, (label, run) in enumerate(labelled.items()):
                color = (INTERVAL, BARS[5], BARS[4])[j % 3]
                trace = run[name]
                estimate = np.zeros(0) if trace.estimate is None else trace.estimate
                t, error = _cut(trace.t, trace.error, shown)
                prefix = f"{label}: " if label else ""
                for bound, word in ((trace.upper, f"{prefix}bounds"), (trace.lower, None)):
                    if bound is not None and trace.bounded:
                        at, line = _cut(trace.t, _finite(bound) - estimate, shown)
                        panel.plot(*thin(at, line), color=color, linewidth=1.3, label=word)
                panel.plot(
                    *thin(t, error),
                    color=INK if len(labelled) == 1 else color,
                    linewidth=0.7,
                    alpha=0.9,
                    label=f"{prefix}error",
                )
            panel.set_xlim(*shown)
            _labels(panel, first[name])
            panel.set_ylabel(f"error of {first[name].label}")
        name_lines(flat, flat[0])
        return flat


def _chosen(run: Any, signals: str | Sequence[str] | None) -> tuple[str, ...]:
    """Return the signals asked for, all that are estimated by default."""
    return run.estimated if signals is None else tuple(np.atleast_1d(signals).tolist())


def _finite(bound: FloatArray) -> FloatArray:
    """Leave a gap where a bound is infinite."""
    return np.where(np.isinf(bound), np.nan, bound)


def _cut(t: FloatArray, values: FloatArray, window: Window | None) -> tuple[FloatArray, FloatArray]:
    if window is None:
        return t, values
    inside = (t >= window[0]) & (t <= window[1])
    return t[inside], values[inside]


def _draw(ax: Any, trace: Trace, window: Window | None = None) -> None:
    """Interval as a band with edges, truth as a strong line, the estimate fine on top of it."""
    if trace.alarm is not None:
        shade(ax, trace.t, trace.alarm, ESTIMATE, "alarm")
    if trace.status is not None:
        shade_status(ax, trace.t, trace.status)
    if trace.lower is not None and trace.upper is not None and trace.bounded:
        t, lower = _cut(trace.t, _finite(trace.lower), window)
        _, upper = _cut(trace.t, _finite(trace.upper), window)
        low, high = thin(t, lower), thin(t, upper)
        if len(low[0]) == len(t):
            ax.fill_between(t, lower, upper, color=INTERVAL_FILL, linewidth=0)
        else:
            band = np.unique(np.concatenate([low[0], high[0]]))
            ax.fill_between(
                band,
                np.interp(band, *low),
                np.interp(band, *high),
                color=INTERVAL_FILL,
                linewidth=0,
            )
        ax.plot(*low, color=INTERVAL, linewidth=0.8, label="interval")
        ax.plot(*high, color=INTERVAL, linewidth=0.8)
    t, true = _cut(trace.t, trace.true, window)
    if np.isfinite(true).any():
        ax.plot(*thin(t, true), color=INK, linewidth=1.5, label="truth")
    if trace.estimate is not None:
        t, estimate = _cut(trace.t, trace.estimate, window)
        ax.plot(*thin(t, estimate), color=ESTIMATE, linewidth=0.8, label="estimate")
    if window is None:
        _limits(ax, trace)
    if len(t) > 1:
        ax.set_xlim(t[0], t[-1])


def _limits(ax: Any, trace: Trace) -> None:
    """Let truth, estimate and settled interval set the scale, not the first wide intervals."""
    settled = np.arange(len(trace.t)) >= len(trace.t) // 10
    if trace.status is not None:
        settled &= (trace.status & VOID) == 0
    series = [trace.true]
    if trace.estimate is not None:
        series.append(trace.estimate)
    series += [bound[settled] for bound in (trace.lower, trace.upper) if bound is not None]
    values = np.concatenate([s[np.isfinite(s)] for s in series])
    if values.size:
        low, high = float(values.min()), float(values.max())
        pad = 0.06 * (high - low) or 1.0
        ax.set_ylim(low - pad, high + pad)


def _labels(ax: Any, trace: Trace, title: str | None = None) -> None:
    ax.set_ylabel(trace.label)
    ax.set_xlabel("time [s]")
    if title is not None:
        ax.set_title(title)


def _window_title(i: int, window: Window, automatic: bool) -> str:
    words = ("convergence", "inclusion") if automatic else ("", "")
    word = words[i] if i < len(words) else ""
    return word or f"{window[0]:g} s to {window[1]:g} s"


def _settled(run: "Run") -> int:
    """Find the first instant from which no interval is much wider than at the end."""
    start = len(run.t) // 100
    for width in run.widths.values():
        wide = np.flatnonzero(~(width <= 1.6 * width[-1]))
        if np.isfinite(width[-1]) and wide.size:
            start = max(start, int(wide[-1]) + 1)
    return min(start, len(run.t) // 2)


def _windows(run: Any, trace: Trace) -> list[Window]:
    """Choose the start until the estimate has settled, and a stretch around a moving fault."""
    n = len(trace.t)
    if trace.estimate is None or n < 40 or np.isnan(trace.true).all():
        return []
    error = np.abs(trace.error)
    usual = 1.5 * float(np.nanquantile(error[n // 2 :], 0.99))
    strays = np.flatnonzero(~(error[: n // 4] <= usual))
    # The transient ends before the first long stretch without a stray error.
    ends = strays[np.diff(strays, append=n) > min(50, n // 10)]
    settled = int(ends[0]) + 1 if ends.size else 1
    stop = min(max(2 * settled, 20), n // 10)
    length = max(n // 50, 20)
    moved = np.flatnonzero(np.abs(np.diff(run.f, axis=0)).max(axis=1, initial=0.0) > 0)
    centre = int(moved[len(moved) // 4]) if moved.size else n // 2
    begin = min(max(centre - length // 2, 0), n - 1 - length)
    return [
        (float(trace.t[0]), float(trace.t[stop])),
        (float(trace.t[begin]), float(trace.t[begin + length])),
    ]
