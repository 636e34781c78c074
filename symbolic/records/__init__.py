"""Measured records that ship with obsynth, each with its source and licence beside it."""

from obsynth.symbolic.records.three_tank_leak import three_tank_leak

__all__ = ["three_tank_leak"]
