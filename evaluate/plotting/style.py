"""Colours and settings of all plots: readable in print, by the colour-blind, and in the dark."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

# The paper draws the truth black, the estimate red and the interval green; these are the black,
# vermilion and bluish green of Okabe and Ito, which stay apart for every kind of colour vision.
INK = "#1b1d21"
ESTIMATE = "#d55e00"
INTERVAL = "#009e73"
INTERVAL_FILL = "#009e7326"
SOFT = "#8a9099"
BARS = ("#8a9099", "#56b4e9", "#009e73", "#d55e00", "#cc79a7", "#0072b2")

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
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "lines.solid_joinstyle": "round",
    "path.simplify": True,
    "text.color": INK,
    "xtick.color": SOFT,
    "xtick.labelcolor": INK,
    "xtick.labelsize": 8.0,
    "ytick.color": SOFT,
    "ytick.labelcolor": INK,
    "ytick.labelsize": 8.0,
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
