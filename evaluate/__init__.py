"""What it is worth: simulation, coverage, plots, report."""

from obsynth.evaluate.coverage import coverage_table
from obsynth.evaluate.domain import Domain, StatusCount
from obsynth.evaluate.errors import ReportError, SimulationError
from obsynth.evaluate.plotting.alarms import plot_alarms
from obsynth.evaluate.plotting.plots import plot_errors, plot_run, plot_signal
from obsynth.evaluate.plotting.width_plot import plot_widths
from obsynth.evaluate.report import report
from obsynth.evaluate.run import Run
from obsynth.evaluate.simulate import simulate
from obsynth.evaluate.table import Table
from obsynth.evaluate.trace import Trace, Violation

__all__ = [
    "Domain",
    "ReportError",
    "Run",
    "SimulationError",
    "StatusCount",
    "Table",
    "Trace",
    "Violation",
    "coverage_table",
    "plot_alarms",
    "plot_errors",
    "plot_run",
    "plot_signal",
    "plot_widths",
    "report",
    "simulate",
]
