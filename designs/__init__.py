"""What estimates: LMIs, certificates and observers."""

from obsynth.designs.bounded_error import BoundedErrorUIO
from obsynth.designs.certificate import Certificate, Claim, Guarantee
from obsynth.designs.detection import Detection, FaultEvent
from obsynth.designs.errors import (
    CertificateError,
    DetectorError,
    InfeasibleDesign,
    SolverTrouble,
)
from obsynth.designs.fault_detector import FaultDetector
from obsynth.designs.hinf import HinfUIO, WorstCase, worst_case
from obsynth.designs.interval import IntervalObserver
from obsynth.designs.observer import STATUS, Observer
from obsynth.designs.qpv import Ellipsoid, QPVObserver
from obsynth.designs.set_adaptive import SetAdaptiveObserver
from obsynth.designs.storage import load, save

__all__ = [
    "STATUS",
    "BoundedErrorUIO",
    "Certificate",
    "CertificateError",
    "Claim",
    "Detection",
    "DetectorError",
    "Ellipsoid",
    "FaultDetector",
    "FaultEvent",
    "Guarantee",
    "HinfUIO",
    "InfeasibleDesign",
    "IntervalObserver",
    "Observer",
    "QPVObserver",
    "SetAdaptiveObserver",
    "SolverTrouble",
    "WorstCase",
    "load",
    "save",
    "worst_case",
]
