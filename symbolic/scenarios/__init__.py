"""Scenarios beside the plants they belong to, one file each, and one for any plant."""

from obsynth.symbolic.scenarios.gentle import gentle
from obsynth.symbolic.scenarios.hinf_example import hinf_example
from obsynth.symbolic.scenarios.interval_example import interval_example
from obsynth.symbolic.scenarios.qpv_example import qpv_example
from obsynth.symbolic.scenarios.quadruple_tank import quadruple_tank
from obsynth.symbolic.scenarios.three_tanks import three_tanks

__all__ = [
    "gentle",
    "hinf_example",
    "interval_example",
    "qpv_example",
    "quadruple_tank",
    "three_tanks",
]
