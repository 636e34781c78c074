"""Figures, panels and legends of the plots."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from obsynth.evaluate.errors import ReportError

_ORDER = {"truth": 0, "estimate": 1, "interval": 2, "alarm": 3}


def new_figure(size: tuple[float, float]) -> Any:
    """Make a figure that pyplot shows in notebooks and that scripts may save."""
    import matplotlib.pyplot as plt

    return plt.figure(figsize=size)


def grid(count: int, axes: Any) -> Any:
    """Return the axes that were given, one for each of `count` signals, or make them."""
    if axes is not None:
        flat = np.atleast_1d(np.asarray(axes, dtype=object)).ravel()
        if len(flat) != count:
            raise ReportError(f"{len(flat)} axes were given for {count} signals.", given=len(flat))
        return flat
    rows = (count + 1) // 2
    return panels(new_figure((7.2, 0.6 + 1.5 * rows)), count)


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
    engine = figure.get_layout_engine()
    own = len(figure.axes) == len(axes) and not figure.legends
    if own and engine is not None and _constrained(engine):
        figure.legend(*entries, loc="outside upper right", ncols=min(len(words), 4))
    else:
        place = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.1}
        source.legend(*entries, **place, ncols=min(len(words), 4))


def _constrained(engine: Any) -> bool:
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    return isinstance(engine, ConstrainedLayoutEngine)
