"""Figures, panels and legends of the plots: readable in print, to the colour-blind, in the dark."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

import numpy as np

from obsynth.evaluate.errors import ReportError
from obsynth.symbolic.arrays import FloatArray

# The paper draws the truth black, the estimate red and the interval green; these are the black,
# vermilion and bluish green of Okabe and Ito, which stay apart for every kind of colour vision.
INK = "#1b1d21"
ESTIMATE = "#d55e00"
INTERVAL = "#009e73"
INTERVAL_FILL = "#009e7326"
SOFT = "#8a9099"
BARS = ("#8a9099", "#56b4e9", "#009e73", "#d55e00", "#cc79a7", "#0072b2")

WIDTH = 5.4
"""Of figures, in inches."""
SMALL = 8.8
"""Points of the smallest letters: 9 pixels where a figure is 400 pixels wide."""

_SETTINGS: dict[str, Any] = {
    "axes.edgecolor": SOFT,
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.labelsize": 9.0,
    "axes.linewidth": 0.7,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "figure.constrained_layout.use": True,
    "font.size": 9.0,
    "grid.alpha": 0.35,
    "grid.color": SOFT,
    "grid.linewidth": 0.4,
    "legend.fontsize": SMALL,
    "legend.frameon": False,
    "lines.solid_joinstyle": "round",
    "path.simplify": True,
    "text.color": INK,
    "xtick.color": SOFT,
    "xtick.labelcolor": INK,
    "xtick.labelsize": SMALL,
    "ytick.color": SOFT,
    "ytick.labelcolor": INK,
    "ytick.labelsize": SMALL,
}


@contextmanager
def style() -> Iterator[None]:
    """Draw in the settings of obsynth's plots; only these settings are put back afterwards.

    ``matplotlib.rc_context`` would also put back what pyplot sets when it is first imported
    inside, and notebooks would show no further figure.
    """
    import matplotlib as mpl

    before = {key: mpl.rcParams[key] for key in _SETTINGS}
    mpl.rcParams.update(_SETTINGS)
    try:
        yield
    finally:
        mpl.rcParams.update(before)


_WORDS = ("truth", "estimate", "interval", "alarm", "void", "recovering")
_ORDER = {word: i for i, word in enumerate(_WORDS)}


def new_figure(height: float) -> Any:
    """Make a figure that pyplot shows in notebooks and that scripts may save."""
    import matplotlib.pyplot as plt

    return plt.figure(figsize=(WIDTH, height))


def inches(figure: Any) -> float:
    """Return how wide a figure is, or a part of one."""
    return float(figure.bbox.width / figure.dpi)


def grid(count: int, axes: Any) -> Any:
    """Return the axes that were given, one for each of `count` signals, or make them."""
    if axes is not None:
        flat = np.atleast_1d(np.asarray(axes, dtype=object)).ravel()
        if len(flat) != count:
            raise ReportError(f"{len(flat)} axes were given for {count} signals.", given=len(flat))
        return flat
    rows = (count + 1) // 2
    return panels(new_figure(0.6 + 1.3 * rows), count)


def panels(figure: Any, count: int) -> Any:
    """Divide a figure into `count` panels, two beside each other, with time below only."""
    columns = min(2, count)
    rows = (count + columns - 1) // columns
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True).ravel()
    for unused in axes[count:]:
        unused.remove()
    for i, ax in enumerate(axes[:count]):
        last = i + columns >= count
        ax.tick_params(labelbottom=last)
        ax.xaxis.label.set_visible(last)
    return axes[:count]


def name_lines(axes: Sequence[Any], source: Any) -> None:
    """Name the lines once: above all axes where the layout makes room, else above the first."""
    named: dict[str, Any] = {}
    for ax in (source, *axes):
        for handle, word in zip(*ax.get_legend_handles_labels(), strict=True):
            named.setdefault(word, handle)
    handles, words = list(named.values()), list(named)
    order = sorted(range(len(words)), key=lambda i: _ORDER.get(words[i], len(_ORDER)))
    entries = [handles[i] for i in order], [words[i] for i in order]
    figure = source.figure
    room = int(inches(figure) / (0.55 + 0.07 * max(map(len, words), default=0)))
    rows = -(-len(words) // max(1, room))
    columns = -(-len(words) // max(1, rows))
    engine = figure.get_layout_engine()
    own = len(figure.axes) == len(axes) and not figure.legends
    if own and engine is not None and _constrained(engine):
        figure.legend(*entries, loc="outside upper right", ncols=columns)
    else:
        place = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.1}
        source.legend(*entries, **place, ncols=columns)


def _constrained(engine: Any) -> bool:
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    return isinstance(engine, ConstrainedLayoutEngine)


def thin(t: FloatArray, values: FloatArray, columns: int = 500) -> tuple[FloatArray, FloatArray]:
    """Keep first, smallest, largest and last of each of `columns` slices: the same picture."""
    n = len(t)
    if n <= 4 * columns:
        return t, values
    edges = np.linspace(0, n, columns + 1).astype(int)
    keep = set()
    for start, stop in pairwise(edges):
        part = values[start:stop]
        finite = np.where(np.isfinite(part), part, 0.0)
        keep |= {start, stop - 1, start + int(finite.argmin()), start + int(finite.argmax())}
    index = np.array(sorted(keep))
    return t[index], values[index]
