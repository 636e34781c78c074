"""The widths of everything that was tried, as dots along one scale."""

from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.evaluate.plotting.layout import BARS, INK, SOFT, new_figure, style

if TYPE_CHECKING:
    from obsynth.evaluate.choosing.choice import Choice


def plot_choice(choice: "Choice", ax: Any = None) -> Any:
    """Draw a row for every signal: dots in the run, rings guaranteed, crosses for the filter."""
    rows = np.arange(len(choice.names))
    with style():
        if ax is None:
            ax = new_figure((7.2, 1.2 + 0.4 * len(rows))).subplots()
        for i, one in enumerate(choice.made):
            at, color = rows + 0.5 * (i + 1) / (len(choice.made) + 1) - 0.25, BARS[i % len(BARS)]
            label = f"{one.name} (recommended)" if one is choice.best else one.name
            ax.plot(choice.online(one), at, "o", color=color, markersize=4, label=label)
            ax.plot(choice.guaranteed(one), at, "o", color=color, fillstyle="none")
        ax.plot(choice.online(choice.kalman), rows, "x", color=INK, label="Kalman, no guarantee")
        ax.axvline(1.0, color=SOFT, linewidth=0.8)
        ax.set_xscale("log")
        ax.set_yticks(rows, choice.names)
        ax.invert_yaxis()
        ax.set_xlabel("half width / half range; dots: in the run, rings: guaranteed")
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return ax
