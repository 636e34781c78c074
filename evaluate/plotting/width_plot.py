"""Guaranteed half widths of several designs beside each other."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.evaluate.errors import ReportError
from obsynth.evaluate.plotting.layout import new_figure
from obsynth.evaluate.plotting.style import BARS, INK, style
from obsynth.symbolic.arrays import FloatArray


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
        ax.bar_label(bars, marks, fontsize=6.8, color=INK, padding=1.5)
    marked = zip(names, units, strict=True)
    ax.set_xticks(places, [f"{name}\n[{unit}]" if unit else name for name, unit in marked])
    ax.grid(visible=False, axis="x")
    ax.tick_params(axis="x", length=0)
    ax.margins(y=0.12)
