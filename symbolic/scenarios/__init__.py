"""Scenarios beside the plants they belong to, one file each."""

from obsynth.symbolic.scenarios.hinf_example import hinf_example
from obsynth.symbolic.scenarios.quadruple_tank import quadruple_tank

__all__ = ["hinf_example", "quadruple_tank"]
