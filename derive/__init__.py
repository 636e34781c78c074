"""What follows from a plant, with proof."""

from obsynth.derive.algebra.linear_parts import IdentityProof
from obsynth.derive.constants.eigenvalue_search import Maximum
from obsynth.derive.constants.lipschitz import InnerBound, LipschitzConstants, lipschitz
from obsynth.derive.constants.majorant import Majorant, majorant
from obsynth.derive.constants.majorant_parts import RowMajorant
from obsynth.derive.equilibrium import Equilibrium, equilibrium
from obsynth.derive.errors import DerivationError, StructureError, UnboundedError
from obsynth.derive.forms.qpv.build import qpv
from obsynth.derive.forms.qpv.form import QPV, QPVVertices
from obsynth.derive.forms.quasi_lpv.build import quasi_lpv
from obsynth.derive.forms.quasi_lpv.form import QuasiLPV
from obsynth.derive.forms.quasi_lpv.interval_form import IntervalForm
from obsynth.derive.forms.quasi_lpv.polytopic import CentredForm, PolytopicForm
from obsynth.derive.intervals.ranges import Ranges, Status, bound_ranges
from obsynth.derive.jacobian.bounds import JacobianBounds, jacobian_bounds
from obsynth.derive.jacobian.family import AffineDependence, AffineFamily
from obsynth.derive.polytopes.fewer import principal_family
from obsynth.derive.polytopes.polytope import (
    Polytope,
    polytope_from_halfspaces,
    polytope_from_vertices,
)
from obsynth.derive.polytopes.support import JacobianPolytope, jacobian_polytope
from obsynth.derive.remainder.certify import discretisation_remainder
from obsynth.derive.remainder.flow import FlowError
from obsynth.derive.remainder.result import Remainder
from obsynth.derive.split import Split, split
from obsynth.derive.structure.excitation import Excitation, excitation
from obsynth.derive.structure.isolability import FaultIsolability, fault_isolability
from obsynth.derive.structure.report import Check, StructureReport, analyse

__all__ = [
    "QPV",
    "AffineDependence",
    "AffineFamily",
    "CentredForm",
    "Check",
    "DerivationError",
    "Equilibrium",
    "Excitation",
    "FaultIsolability",
    "FlowError",
    "IdentityProof",
    "InnerBound",
    "IntervalForm",
    "JacobianBounds",
    "JacobianPolytope",
    "LipschitzConstants",
    "Majorant",
    "Maximum",
    "Polytope",
    "PolytopicForm",
    "QPVVertices",
    "QuasiLPV",
    "Ranges",
    "Remainder",
    "RowMajorant",
    "Split",
    "Status",
    "StructureError",
    "StructureReport",
    "UnboundedError",
    "analyse",
    "bound_ranges",
    "discretisation_remainder",
    "equilibrium",
    "excitation",
    "fault_isolability",
    "jacobian_bounds",
    "jacobian_polytope",
    "lipschitz",
    "majorant",
    "polytope_from_halfspaces",
    "polytope_from_vertices",
    "principal_family",
    "qpv",
    "quasi_lpv",
    "split",
]
