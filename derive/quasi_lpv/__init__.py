"""Quasi-LPV forms: matrices that depend on scheduling variables, equal to the plant."""

from obsynth.derive.quasi_lpv.build import quasi_lpv
from obsynth.derive.quasi_lpv.elementwise import ElementBounds, bound_elements
from obsynth.derive.quasi_lpv.form import UNMEASURED_NOTE, QuasiLPV
from obsynth.derive.quasi_lpv.interval_form import IntervalForm
from obsynth.derive.quasi_lpv.known import Known, read_measured
from obsynth.derive.quasi_lpv.layout import BLOCKS, Layout
from obsynth.derive.quasi_lpv.measured import Reading, known_signals, readings
from obsynth.derive.quasi_lpv.polytopic import CentredForm, PolytopicForm
from obsynth.derive.quasi_lpv.ranking import Alternative, RowRanking
from obsynth.derive.quasi_lpv.scheduling import AffineSchedule, SchedulingVariable

__all__ = [
    "BLOCKS",
    "UNMEASURED_NOTE",
    "AffineSchedule",
    "Alternative",
    "CentredForm",
    "ElementBounds",
    "IntervalForm",
    "Known",
    "Layout",
    "PolytopicForm",
    "QuasiLPV",
    "Reading",
    "RowRanking",
    "SchedulingVariable",
    "bound_elements",
    "known_signals",
    "quasi_lpv",
    "read_measured",
    "readings",
]
