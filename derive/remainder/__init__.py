"""What a discretisation leaves out over one step, as certified intervals."""

from obsynth.derive.remainder.certify import discretisation_remainder
from obsynth.derive.remainder.flow import FlowError, flow_box
from obsynth.derive.remainder.result import Remainder

__all__ = ["FlowError", "Remainder", "discretisation_remainder", "flow_box"]
