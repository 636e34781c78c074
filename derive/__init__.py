"""What follows from a plant, with proof."""

from obsynth.derive.affine_family import AffineFamily
from obsynth.derive.decoupling import Decoupling, decouple
from obsynth.derive.dependence import AffineDependence
from obsynth.derive.diagnosis import (
    Excitation,
    FaultIsolability,
    PolytopeZeros,
    WeakestMember,
    excitation,
    fault_isolability,
    system_zeros,
    weakest_member,
    zeros_over_polytope,
)
from obsynth.derive.equilibrium import Equilibrium, equilibrium
from obsynth.derive.errors import DerivationError, StructureError, UnboundedError
from obsynth.derive.identity import IdentityProof
from obsynth.derive.intervals import Ranges, Status, bound_ranges
from obsynth.derive.jacobian_bounds import JacobianBounds, jacobian_bounds
from obsynth.derive.lipschitz import InnerBound, LipschitzConstants, lipschitz
from obsynth.derive.majorant import Majorant, majorant
from obsynth.derive.majorant_parts import RowMajorant
from obsynth.derive.polytopes import (
    JacobianPolytope,
    Polytope,
    drop_scalars,
    jacobian_polytope,
    polytope_from_halfspaces,
    polytope_from_vertices,
    principal_family,
    sampled_hull,
)
from obsynth.derive.qpv import QPV, QPVVertices, qpv
from obsynth.derive.quasi_lpv import CentredForm, IntervalForm, PolytopicForm, QuasiLPV, quasi_lpv
from obsynth.derive.remainder import FlowError, Remainder, discretisation_remainder
from obsynth.derive.report import Check, StructureReport, analyse
from obsynth.derive.spectrum import Maximum
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
    "PolytopeZeros",
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
    "WeakestMember",
    "analyse",
    "augmented_pair",
    "bound_ranges",
    "decouple",
    "detectability",
    "discretisation_remainder",
    "drop_scalars",
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
    "sampled_hull",
    "split",
    "system_zeros",
    "unknown_input_condition",
    "weakest_member",
    "zeros_over_polytope",
]
