"""What follows from a plant, with proof."""

from obsynth.derive.constants.lipschitz import lipschitz as lipschitz
from obsynth.derive.constants.majorant import Majorant as Majorant
from obsynth.derive.constants.majorant import majorant as majorant
from obsynth.derive.equilibrium import Equilibrium as Equilibrium
from obsynth.derive.equilibrium import equilibrium as equilibrium
from obsynth.derive.errors import DerivationError as DerivationError
from obsynth.derive.errors import StructureError as StructureError
from obsynth.derive.errors import UnboundedError as UnboundedError
from obsynth.derive.forms.qpv.build import qpv as qpv
from obsynth.derive.forms.qpv.form import QPV as QPV
from obsynth.derive.forms.quasi_lpv.form import QuasiLPV as QuasiLPV
from obsynth.derive.forms.quasi_lpv.form import quasi_lpv as quasi_lpv
from obsynth.derive.intervals.ranges import Status as Status
from obsynth.derive.jacobian.bounds import JacobianBounds as JacobianBounds
from obsynth.derive.jacobian.bounds import jacobian_bounds as jacobian_bounds
from obsynth.derive.jacobian.family import AffineFamily as AffineFamily
from obsynth.derive.mismatch import mismatch as mismatch
from obsynth.derive.polytopes.polytope import polytope_from_halfspaces as polytope_from_halfspaces
from obsynth.derive.polytopes.polytope import polytope_from_vertices as polytope_from_vertices
from obsynth.derive.remainder.certify import discretisation_remainder as discretisation_remainder
from obsynth.derive.remainder.enclosure import enclose_remainder as enclose_remainder
from obsynth.derive.split import Split as Split
from obsynth.derive.split import split as split
from obsynth.derive.structure.excitation import excitation as excitation
from obsynth.derive.structure.isolability import fault_isolability as fault_isolability
from obsynth.derive.structure.report import analyse as analyse
