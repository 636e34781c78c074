"""The set adaptive observer for quasi-LPV plants, its indicators, and its robust bank."""

from obsynth.designs.set_adaptive.indicators import (
    Indicators,
    Monitors,
    bank_intervals,
    fault_indicators,
    monitors,
)
from obsynth.designs.set_adaptive.method import SetAdaptiveObserver

__all__ = [
    "Indicators",
    "Monitors",
    "SetAdaptiveObserver",
    "bank_intervals",
    "fault_indicators",
    "monitors",
]
