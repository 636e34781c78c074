"""Interval observer for actuator faults of parameter-varying plants, one concept per module."""

from obsynth.designs.interval.method import IntervalObserver

__all__ = ["IntervalObserver"]
