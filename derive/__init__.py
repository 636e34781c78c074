"""What follows from a plant, with proof."""

from obsynth.derive.affine_family import AffineFamily
from obsynth.derive.decoupling import Decoupling, decouple
from obsynth.derive.dependence import AffineDependence
from obsynth.derive.equilibrium import Equilibrium, equilibrium
from obsynth.derive.errors import DerivationError, StructureError, UnboundedError
from obsynth.derive.identity import IdentityProof
from obsynth.derive.intervals import Ranges, Status, bound_ranges
from obsynth.derive.jacobian_bounds import JacobianBounds, jacobian_bounds
from obsynth.derive.qpv import QPV, QPVVertices, qpv
from obsynth.derive.quasi_lpv import CentredForm, IntervalForm, PolytopicForm, QuasiLPV, quasi_lpv
from obsynth.derive.report import Check, StructureReport, analyse
from obsynth.derive.split import Split, split
from obsynth.derive.structure import (
    Detectability,
    augmented_pair,
    detectability,
    unknown_input_condition,
)

__all__ = [
    "QPV",
    "AffineDependence",
    "AffineFamily",
    "CentredForm",
    "Check",
    "Decoupling",
    "DerivationError",
    "Detectability",
    "Equilibrium",
    "IdentityProof",
    "IntervalForm",
    "JacobianBounds",
    "PolytopicForm",
    "QPVVertices",
    "QuasiLPV",
    "Ranges",
    "Split",
    "Status",
    "StructureError",
    "StructureReport",
    "UnboundedError",
    "analyse",
    "augmented_pair",
    "bound_ranges",
    "decouple",
    "detectability",
    "equilibrium",
    "jacobian_bounds",
    "qpv",
    "quasi_lpv",
    "split",
    "unknown_input_condition",
]
