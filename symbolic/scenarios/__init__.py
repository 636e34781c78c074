"""Scenarios beside the plants they belong to, one file each."""

from obsynth.symbolic.scenarios.quadruple_tank import quadruple_tank

__all__ = ["quadruple_tank"]
