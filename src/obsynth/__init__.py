"""obsynth: from a plant's equations to a proven fault-estimating observer in C.

By convention ``import obsynth as ob``. The public names are loaded on first
use, so that importing the package costs next to nothing.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from obsynth.codegen import CProject as CProject
    from obsynth.codegen import generate_c as generate_c
    from obsynth.derive import Equilibrium as Equilibrium
    from obsynth.derive import JacobianBounds as JacobianBounds
    from obsynth.derive import Split as Split
    from obsynth.derive import StructureError as StructureError
    from obsynth.derive import UnboundedError as UnboundedError
    from obsynth.derive import analyse as analyse
    from obsynth.derive import discretisation_remainder as discretisation_remainder
    from obsynth.derive import equilibrium as equilibrium
    from obsynth.derive import excitation as excitation
    from obsynth.derive import fault_isolability as fault_isolability
    from obsynth.derive import jacobian_bounds as jacobian_bounds
    from obsynth.derive import lipschitz as lipschitz
    from obsynth.derive import majorant as majorant
    from obsynth.derive import qpv as qpv
    from obsynth.derive import quasi_lpv as quasi_lpv
    from obsynth.derive import split as split
    from obsynth.designs import BoundedErrorUIO as BoundedErrorUIO
    from obsynth.designs import Certificate as Certificate
    from obsynth.designs import CertificateError as CertificateError
    from obsynth.designs import Ellipsoid as Ellipsoid
    from obsynth.designs import FaultDetector as FaultDetector
    from obsynth.designs import HinfUIO as HinfUIO
    from obsynth.designs import InfeasibleDesign as InfeasibleDesign
    from obsynth.designs import IntervalObserver as IntervalObserver
    from obsynth.designs import Observer as Observer
    from obsynth.designs import QPVObserver as QPVObserver
    from obsynth.designs import SetAdaptiveObserver as SetAdaptiveObserver
    from obsynth.designs import load as load
    from obsynth.designs import worst_case as worst_case
    from obsynth.evaluate import Run as Run
    from obsynth.evaluate import SimulationError as SimulationError
    from obsynth.evaluate import Table as Table
    from obsynth.evaluate import coverage_table as coverage_table
    from obsynth.evaluate import plot_alarms as plot_alarms
    from obsynth.evaluate import plot_errors as plot_errors
    from obsynth.evaluate import plot_run as plot_run
    from obsynth.evaluate import plot_signal as plot_signal
    from obsynth.evaluate import plot_widths as plot_widths
    from obsynth.evaluate import report as report
    from obsynth.evaluate import simulate as simulate
    from obsynth.symbolic import ObsynthError as ObsynthError
    from obsynth.symbolic import Plant as Plant
    from obsynth.symbolic import PlantError as PlantError
    from obsynth.symbolic import Scenario as Scenario
    from obsynth.symbolic import plants, scenarios

__version__ = "0.1.0"

__all__ = [
    "BoundedErrorUIO",
    "CProject",
    "Certificate",
    "CertificateError",
    "Ellipsoid",
    "Equilibrium",
    "FaultDetector",
    "HinfUIO",
    "InfeasibleDesign",
    "IntervalObserver",
    "JacobianBounds",
    "Observer",
    "ObsynthError",
    "Plant",
    "PlantError",
    "QPVObserver",
    "Run",
    "Scenario",
    "SetAdaptiveObserver",
    "SimulationError",
    "Split",
    "StructureError",
    "Table",
    "UnboundedError",
    "__version__",
    "analyse",
    "coverage_table",
    "discretisation_remainder",
    "equilibrium",
    "excitation",
    "fault_isolability",
    "generate_c",
    "jacobian_bounds",
    "lipschitz",
    "load",
    "majorant",
    "plants",
    "plot_alarms",
    "plot_errors",
    "plot_run",
    "plot_signal",
    "plot_widths",
    "qpv",
    "quasi_lpv",
    "report",
    "scenarios",
    "simulate",
    "split",
    "worst_case",
]

_ROOMS = {
    "symbolic": ("ObsynthError", "Plant", "PlantError", "Scenario"),
    "derive": (
        "Equilibrium",
        "JacobianBounds",
        "Split",
        "StructureError",
        "UnboundedError",
        "analyse",
        "discretisation_remainder",
        "equilibrium",
        "excitation",
        "fault_isolability",
        "jacobian_bounds",
        "lipschitz",
        "majorant",
        "qpv",
        "quasi_lpv",
        "split",
    ),
    "designs": (
        "BoundedErrorUIO",
        "Certificate",
        "CertificateError",
        "Ellipsoid",
        "FaultDetector",
        "HinfUIO",
        "InfeasibleDesign",
        "IntervalObserver",
        "Observer",
        "QPVObserver",
        "SetAdaptiveObserver",
        "load",
        "worst_case",
    ),
    "codegen": ("CProject", "generate_c"),
    "evaluate": (
        "Run",
        "SimulationError",
        "Table",
        "coverage_table",
        "plot_alarms",
        "plot_errors",
        "plot_run",
        "plot_signal",
        "plot_widths",
        "report",
        "simulate",
    ),
}
_HOME = {name: f"obsynth.{room}" for room, names in _ROOMS.items() for name in names}
_MODULES = {name: f"obsynth.symbolic.{name}" for name in ("plants", "scenarios")}


def __getattr__(name: str) -> Any:
    """Load a public name from its room on first use (PEP 562)."""
    if name in _MODULES:
        value = importlib.import_module(_MODULES[name])
    elif name in _HOME:
        value = getattr(importlib.import_module(_HOME[name]), name)
    else:
        raise AttributeError(f"module 'obsynth' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))
