"""Alarms of a fault detector in plots."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from obsynth.evaluate.errors import ReportError
from obsynth.evaluate.plotting.layout import new_figure
from obsynth.evaluate.plotting.style import ESTIMATE, SOFT, style
from obsynth.symbolic.arrays import FloatArray

if TYPE_CHECKING:
    from obsynth.evaluate.run import Run


BoolArray = NDArray[np.bool_]


def plot_alarms(
    run: "Run", alarm: BoolArray | None = None, ax: Any = None, threshold: float = 0.0
) -> Any:
    """Plot when each fault was there and when its alarm was raised, one row per fault.

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
        ax.set_yticks(np.arange(len(names))[::-1], names)
        ax.set_ylim(-0.6, len(names) - 0.4)
        ax.set_xlim(run.t[0], run.t[-1])
        ax.grid(visible=False, axis="y")
        ax.set_xlabel("time [s]")
        place = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.1}
        ax.legend(**place, ncols=2)
        return ax


def shade(ax: Any, t: FloatArray, alarm: BoolArray) -> None:
    """Shade where an alarm is raised over the whole height of a panel."""
    bars = _bars(t, alarm)
    if bars:
        across = ax.get_xaxis_transform()
        ax.broken_barh(
            bars,
            (0.0, 1.0),
            transform=across,
            color=ESTIMATE,
            alpha=0.10,
            linewidth=0,
            label="alarm",
        )


def _bars(t: FloatArray, there: BoolArray) -> list[tuple[float, float]]:
    """Return start and length of every stretch in time; a sample lasts until the next one."""
    edges = np.diff(np.concatenate([[0], there.astype(np.int8), [0]]))
    starts, stops = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    stops = np.minimum(stops, len(t) - 1)
    return [(float(t[a]), float(t[b] - t[a])) for a, b in zip(starts, stops, strict=True)]
