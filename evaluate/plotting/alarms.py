"""Half widths of several designs beside each other, and the alarms of a fault detector."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from obsynth.designs.detection.comparison import RECOVERING, VOID
from obsynth.evaluate.errors import ReportError
from obsynth.evaluate.plotting.layout import (
    BARS,
    ESTIMATE,
    INK,
    SMALL,
    SOFT,
    inches,
    name_lines,
    new_figure,
    style,
)
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.taking import takes

if TYPE_CHECKING:
    from obsynth.designs.core.observer import Observer
    from obsynth.designs.detection.detector import FaultDetector
    from obsynth.evaluate.run import Run


@takes(half_widths="Observer FaultDetector dict")
def plot_widths(
    half_widths: Observer | FaultDetector | Mapping[str, ArrayLike | Observer | FaultDetector],
    names: Sequence[str] | None = None,
    units: Sequence[str] | None = None,
    ax: Any = None,
    title: str = "Guaranteed half widths",
) -> Any:
    """Compare half widths of several designs as bars.

    Parameters
    ----------
    half_widths : Observer or FaultDetector, or mapping of label to them or to (n,)
        For instance ``{"ellipsoid": ..., "peak": ...}``, widest first.
    names : sequence of str, optional
        The n signals; by default those of an observer, states and faults.
    units : sequence of str, optional
        Their units. Signals of different units get axes of their own, one beside the other.
    ax : matplotlib Axes or SubFigure or Figure, optional
        Axes hold all signals on one scale; a figure is divided by units.
    title : str
        Title of the plot.

    Returns
    -------
    Axes, or ndarray of Axes where there are several units

    Raises
    ------
    ReportError
        If a design has not one half width for each name, or there are no names.
    """
    given: Any = half_widths
    designs = dict(given) if isinstance(given, Mapping) else {given.method: given}
    models = [one.model for one in designs.values() if hasattr(one, "model")]
    if names is None and not models:
        raise ReportError(
            "plot_widths takes observers, or half widths as numbers with the names of their "
            "signals: names=[...]"
        )
    if names is None:
        signals = (*models[0].x, *models[0].f)
        names, units = [s.name for s in signals], units or [s.unit for s in signals]
    table = {
        label: np.asarray(getattr(values, "half_widths", values), dtype=float)
        for label, values in designs.items()
    }
    for label, values in table.items():
        if values.shape != (len(names),):
            raise ReportError(
                f"{label!r} has half widths of shape {values.shape} for {len(names)} signals.",
                label=label,
            )
    marked = list(units or [""] * len(names))
    with style():
        if ax is not None and hasattr(ax, "bar"):
            _draw(ax, table, names, marked)
            drawn = [ax]
        else:
            figure = new_figure(2.7) if ax is None else ax
            groups = {unit: [i for i, u in enumerate(marked) if u == unit] for unit in marked}
            shares = [len(group) for group in groups.values()]
            drawn = list(
                figure.subplots(1, len(groups), squeeze=False, width_ratios=shares).ravel()
            )
            for axes, group in zip(drawn, groups.values(), strict=True):
                part = {label: values[group] for label, values in table.items()}
                _draw(axes, part, [names[i] for i in group], [marked[i] for i in group])
        drawn[0].set_title(title)
        if len(table) > 1:
            name_lines(drawn, drawn[-1])
        return drawn[0] if len(drawn) == 1 else np.array(drawn, dtype=object)


def _draw(
    ax: Any, table: Mapping[str, FloatArray], names: Sequence[str], units: Sequence[str]
) -> None:
    count = max(len(table), 1)
    step = 0.84 / count
    places = np.arange(len(names), dtype=float)
    for i, (label, values) in enumerate(table.items()):
        at = places + (i - 0.5 * (count - 1)) * step
        finite = np.where(np.isfinite(values), values, 0.0)
        bars = ax.bar(at, finite, 0.92 * step, color=BARS[i % len(BARS)], label=label, linewidth=0)
        marks = [f"{v:.3g}" if np.isfinite(v) else "∞" for v in values]
        ax.bar_label(bars, marks, fontsize=SMALL, color=INK, padding=1.5)
    turned = not _fit(ax, [mark.get_text() for mark in ax.texts], len(names) / step)
    for mark in ax.texts if turned else ():
        mark.set_rotation(90)
    marked = zip(names, units, strict=True)
    words = [f"{name}\n[{unit}]" if unit else name for name, unit in marked]
    ax.set_xticks(places, words, rotation=0 if _fit(ax, names, len(names)) else 90)
    ax.grid(visible=False, axis="x")
    ax.tick_params(axis="x", length=0)
    ax.margins(y=0.25 if turned else 0.12)


def _fit(ax: Any, words: Sequence[str], count: float) -> bool:
    """Tell whether the longest of some words fits into one of `count` parts of the width."""
    width = 72.0 * ax.get_position().width * inches(ax.figure)
    return bool(0.62 * SMALL * max(map(len, words), default=0) <= width / count)


BoolArray = NDArray[np.bool_]


@takes(run="Run Estimate")
def plot_alarms(
    run: Run, alarm: BoolArray | None = None, ax: Any = None, threshold: float = 0.0
) -> Any:
    """Plot when each fault was there and when its alarm was raised, one row per fault.

    Void and recovering instants are shaded.

    Parameters
    ----------
    run : Run
    alarm : (N + 1, n_f) bool, optional
        ``Detection.alarm``; by default what the fault detector said in the run.
    ax : matplotlib Axes, optional
        Where to draw.
    threshold : float
        Magnitude up to which a fault counts as not there.

    Returns
    -------
    Axes

    Raises
    ------
    ReportError
        The run is of an observer without a fault detector and no alarms are given, or
        they are not shaped like its faults.

    Examples
    --------
    >>> ax = plot_alarms(run, detector.detect(run).alarm)      # doctest: +SKIP
    """
    shown = run.alarm if alarm is None else np.asarray(alarm, dtype=bool)
    names = run.names["f"]
    if shown is None:
        raise ReportError(
            f"the run of {run.method} has no alarms: simulate a FaultDetector over the observer, "
            "or give alarm=detector.detect(run).alarm."
        )
    if shown.shape != run.f.shape:
        raise ReportError(
            f"the alarms have shape {shown.shape}; the run has {run.f.shape[0]} instants of "
            f"{len(names)} faults.",
            shape=shown.shape,
        )
    there = np.abs(run.f) > threshold
    with style():
        if ax is None:
            ax = new_figure(0.9 + 0.45 * len(names)).subplots()
        for i in range(len(names)):
            row = len(names) - 1 - i
            kinds = ((there, SOFT, 0.02, "fault"), (shown, ESTIMATE, -0.34, "alarm"))
            for values, color, low, word in kinds:
                bars = _bars(run.t, values[:, i])
                label = None if i else word
                ax.broken_barh(bars, (row + low, 0.32), color=color, linewidth=0, label=label)
        shade_status(ax, run.t, run.status)
        ax.set_yticks(np.arange(len(names))[::-1], names)
        ax.set_ylim(-0.6, len(names) - 0.4)
        ax.set_xlim(run.t[0], run.t[-1])
        ax.grid(visible=False, axis="y")
        ax.set_xlabel("time [s]")
        name_lines([ax], ax)
        return ax


def shade(
    ax: Any, t: FloatArray, there: BoolArray, color: str, word: str, alpha: float = 0.1
) -> None:
    """Shade where something is true over the whole height of a panel; strong shades have an edge.

    The edge keeps single samples visible.
    """
    bars = _bars(t, there)
    if bars:
        ax.broken_barh(
            bars,
            (0.0, 1.0),
            transform=ax.get_xaxis_transform(),
            color=color,
            alpha=alpha,
            linewidth=1.4 if alpha > 0.2 else 0.0,
            label=word,
        )


def shade_status(ax: Any, t: FloatArray, status: NDArray[np.int64]) -> None:
    """Shade where the step was recovering, and over it where it was void."""
    void = (status & VOID) != 0
    shade(ax, t, ~void & ((status & RECOVERING) != 0), BARS[1], "recovering", 0.15)
    shade(ax, t, void, BARS[4], "void", 0.4)


def _bars(t: FloatArray, there: BoolArray) -> list[tuple[float, float]]:
    """Return start and length of every stretch in time; a sample lasts until the next one."""
    edges = np.diff(np.concatenate([[0], there.astype(np.int8), [0]]))
    starts, stops = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    stops = np.minimum(stops, len(t) - 1)
    return [(float(t[a]), float(t[b] - t[a])) for a, b in zip(starts, stops, strict=True)]
