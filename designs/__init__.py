"""What estimates: LMIs, certificates and observers."""

from obsynth.designs.bounded_error.method import BoundedErrorUIO
from obsynth.designs.core.certificate import Certificate, Claim, Guarantee
from obsynth.designs.core.errors import (
    CertificateError,
    DetectorError,
    InfeasibleDesign,
    SolverTrouble,
)
from obsynth.designs.core.files import save
from obsynth.designs.core.loading import load
from obsynth.designs.core.observer import STATUS, Observer
from obsynth.designs.detection.comparison import Detection, FaultEvent
from obsynth.designs.detection.detector import FaultDetector
from obsynth.designs.filter_bank.method import FilterBank
from obsynth.designs.hinf.method import HinfUIO
from obsynth.designs.hinf.worst_case import WorstCase, worst_case
from obsynth.designs.interval.method import IntervalObserver
from obsynth.designs.qpv.method import QPVObserver
from obsynth.designs.qpv.region import Ellipsoid
from obsynth.designs.set_adaptive.method import SetAdaptiveObserver

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
    "FilterBank",
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
