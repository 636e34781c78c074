"""Quadratic parameter-varying forms, with process faults as states."""

from obsynth.derive.qpv.augment import Augmented, augment_plant
from obsynth.derive.qpv.build import qpv
from obsynth.derive.qpv.form import QPV, QPVVertices
from obsynth.derive.qpv.layout import QPVLayout

__all__ = ["QPV", "Augmented", "QPVLayout", "QPVVertices", "augment_plant", "qpv"]
