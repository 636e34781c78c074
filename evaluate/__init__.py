"""What it is worth: simulation, coverage, plots, report."""

from obsynth.evaluate.bounds.identify import Identified as Identified
from obsynth.evaluate.bounds.identify import identify as identify
from obsynth.evaluate.bounds.least_bounds import LeastBounds as LeastBounds
from obsynth.evaluate.bounds.least_bounds import least_bounds as least_bounds
from obsynth.evaluate.choosing.choice import Choice as Choice
from obsynth.evaluate.choosing.choose import choose as choose
from obsynth.evaluate.coverage import coverage_table as coverage_table
from obsynth.evaluate.data.estimate import estimate as estimate
from obsynth.evaluate.data.estimated import Estimate as Estimate
from obsynth.evaluate.domain import Domain as Domain
from obsynth.evaluate.domain import StatusCount as StatusCount
from obsynth.evaluate.errors import BoundsError as BoundsError
from obsynth.evaluate.errors import ReportError as ReportError
from obsynth.evaluate.errors import SimulationError as SimulationError
from obsynth.evaluate.plotting.alarms import plot_alarms as plot_alarms
from obsynth.evaluate.plotting.alarms import plot_widths as plot_widths
from obsynth.evaluate.plotting.plots import plot_errors as plot_errors
from obsynth.evaluate.plotting.plots import plot_run as plot_run
from obsynth.evaluate.plotting.plots import plot_signal as plot_signal
from obsynth.evaluate.report import report as report
from obsynth.evaluate.run import Run as Run
from obsynth.evaluate.simulate import simulate as simulate
from obsynth.evaluate.table import Table as Table
from obsynth.evaluate.trace import Trace as Trace
from obsynth.evaluate.trace import Violation as Violation
