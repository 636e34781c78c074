"""H-infinity unknown input observer for fault estimation (Witczak, Korbicz, Jozefowicz)."""

from obsynth.designs.hinf.method import HinfUIO
from obsynth.designs.hinf.worst_case import WorstCase, worst_case

__all__ = ["HinfUIO", "WorstCase", "worst_case"]
