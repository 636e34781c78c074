"""Guaranteed ranges: outward-rounded interval programs with branch and bound."""

from obsynth.derive.intervals.evaluate import evaluate
from obsynth.derive.intervals.program import Program
from obsynth.derive.intervals.quotients import Quotients
from obsynth.derive.intervals.ranges import Failure, Ranges, Status, bound_ranges

__all__ = ["Failure", "Program", "Quotients", "Ranges", "Status", "bound_ranges", "evaluate"]
