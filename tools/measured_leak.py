"""Draw the picture of README's first screen: a measured leak between guaranteed bounds.

python tools/measured_leak.py docs/pictures/measured_leak.png
"""

import sys
from pathlib import Path

import numpy as np

import obsynth as ob
from obsynth.evaluate.plotting.layout import ESTIMATE, INK, SMALL, name_lines, new_figure, style

VOLTS_A_PULSE = 0.000968
"""Least squares of the middles of one-step intervals, see notebooks/measured_leak.ipynb."""
WINDOW = 5
RANGES = {"a1": (0.005, 0.05), "a3": (0.005, 0.05), "b1": (0.02, 0.06), "b3": (0.02, 0.06)}


def draw(path: Path) -> None:
    """Fit bounds to the record, run a detector over it, draw what it tells beside the meter."""
    record = ob.records.three_tank_leak()
    fit = ob.least_bounds(ob.plants.leaking_tanks(), record, {**RANGES, "leak": None})
    observer = ob.SetMembershipObserver().design(fit.plant)
    told = ob.estimate(ob.FaultDetector(observer, window=WINDOW), record)
    known, one, time = told.mean_status == 0, told["leak"], record.time
    mean = VOLTS_A_PULSE / WINDOW * (record["pulses"][WINDOW:] - record["pulses"][:-WINDOW])
    low, high = told.mean_lower[known, 0], told.mean_upper[known, 0]
    with style():
        ax = new_figure(3.4).subplots()
        ax.fill_between(one.t, one.lower, one.upper, color="#0072b222", label="guaranteed, a step")
        label = f"guaranteed, mean of {WINDOW} s"
        ax.fill_between(time[known], low, high, color="#0072b277", label=label)
        ax.plot(time[WINDOW:], mean, color=INK, label="flow meter, read by nobody")
        ax.axvline(60, color=ESTIMATE, linewidth=0.8)
        place = {"xytext": (4, 0), "textcoords": "offset points"}
        ax.annotate("leak opened", (60, -0.024), color="#a34700", fontsize=SMALL, **place)
        ax.set_xlim(time[0], time[-1])
        ax.set_ylim(-0.03, 0.055)
        ax.set_xlabel("time [s]")
        ax.set_ylabel("leak [V/s]")
        name_lines([ax], ax)
    ax.figure.savefig(path, dpi=150, metadata={"Software": None})
    inside = (low <= mean[known[WINDOW:]]) & (mean[known[WINDOW:]] <= high)
    since = time[known][np.flatnonzero(low > 0)[0]]
    print(f"{inside.mean():.0%} of the meter inside, certain at {since:g} s")


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
