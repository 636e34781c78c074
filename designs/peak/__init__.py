"""Guaranteed peak (l1) bounds of the errors of an unknown input observer, and gains for them."""

from obsynth.designs.peak.attained import Attained, attained
from obsynth.designs.peak.bound import PeakBound, PeakProof, peak_bound, prove_peak
from obsynth.designs.peak.gain import PeakGain, peak_gain
from obsynth.designs.peak.system import PeakSystem, peak_system, projected_gains
from obsynth.designs.peak.transient import Transient, transient

__all__ = [
    "Attained",
    "PeakBound",
    "PeakGain",
    "PeakProof",
    "PeakSystem",
    "Transient",
    "attained",
    "peak_bound",
    "peak_gain",
    "peak_system",
    "projected_gains",
    "prove_peak",
    "transient",
]
