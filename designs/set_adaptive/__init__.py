"""The set adaptive observer for quasi-LPV plants, and its robust bank."""

from obsynth.designs.set_adaptive.method import SetAdaptiveObserver

__all__ = ["SetAdaptiveObserver"]
