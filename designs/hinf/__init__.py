"""H-infinity unknown input observer for fault estimation (Witczak, Korbicz, Jozefowicz)."""

from obsynth.designs.hinf.method import HinfUIO

__all__ = ["HinfUIO"]
