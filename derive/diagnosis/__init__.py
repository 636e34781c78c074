"""What can be known about faults: zeros, isolability, excitation, detectability of a family."""

from obsynth.derive.diagnosis.excitation import Excitation, FaultEffect, excitation
from obsynth.derive.diagnosis.isolability import FaultIsolability, fault_isolability
from obsynth.derive.diagnosis.polytope import WeakestMember, pair_margin, weakest_member
from obsynth.derive.diagnosis.zeros import PolytopeZeros, system_zeros, zeros_over_polytope

__all__ = [
    "Excitation",
    "FaultEffect",
    "FaultIsolability",
    "PolytopeZeros",
    "WeakestMember",
    "excitation",
    "fault_isolability",
    "pair_margin",
    "system_zeros",
    "weakest_member",
    "zeros_over_polytope",
]
