"""Half widths of several designs beside each other, and the alarms of a fault detector."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from obsynth.designs.detection.comparison import RECOVERING, VOID
from obsynth.evaluate.errors import ReportError
from obsynth.evaluate.plotting.layout import BARS, ESTIMATE, INK, SOFT, new_figure, style
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.taking import takes

if TYPE_CHECKING:
    from obsynth.evaluate.run import Run


def plot_widths(
    half_widths: Mapping[str, ArrayLike],
    names: Sequence[str],
    units: Sequence[str] | None = None,
    ax: Any = None,
    title: str = "Guaranteed half widths",
) -> Any:
    """Compare half widths of several designs as bars.

    Parameters
    ----------
    half_widths : mapping of label to (n,)
        For instance ``{"ellipsoid": ..., "peak": ...}``, widest first.
    names : sequence of str
        The n signals.
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
        If a design has not one half width for each name.
    """
    table = {label: np.asarray(values, dtype=float) for label, values in half_widths.items()}
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
            figure = new_figure((7.2, 2.9)) if ax is None else ax
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
            drawn[-1].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(table))
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
        ax.bar_label(bars, marks, fontsize=8.0, color=INK, padding=1.5)
    marked = zip(names, units, strict=True)
    ax.set_xticks(places, [f"{name}\n[{unit}]" if unit else name for name, unit in marked])
    ax.grid(visible=False, axis="x")
    ax.tick_params(axis="x", length=0)
    ax.margins(y=0.12)


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
            ax = new_figure((7.2, 0.9 + 0.45 * len(names))).subplots()
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
        place = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.1}
        ax.legend(**place, ncols=4)
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
