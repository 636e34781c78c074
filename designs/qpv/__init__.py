"""Observer of states and process faults by quadratic parameter-varying forms (Rotondo et al.)."""

from obsynth.designs.qpv.method import QPVObserver
from obsynth.designs.qpv.region import Ellipsoid

__all__ = ["Ellipsoid", "QPVObserver"]
