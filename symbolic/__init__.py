"""What the user says: plants, signals, equations, scenarios."""

from obsynth.symbolic import plants, scenarios
from obsynth.symbolic.convert import nearest_double, to_sx
from obsynth.symbolic.errors import ObsynthError, ObsynthWarning, PlantError
from obsynth.symbolic.functions import phi1, tanhc
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.scenario import Scenario
from obsynth.symbolic.signals import Role, Signal
from obsynth.symbolic.sxmodel import ParityError, SxModel, check_parity
from obsynth.symbolic.tape import from_tape
from obsynth.symbolic.text import TextError, read_text, write_text

__all__ = [
    "ObsynthError",
    "ObsynthWarning",
    "ParityError",
    "Plant",
    "PlantError",
    "Role",
    "Scenario",
    "Signal",
    "SxModel",
    "TextError",
    "check_parity",
    "from_tape",
    "nearest_double",
    "phi1",
    "plants",
    "read_text",
    "scenarios",
    "tanhc",
    "to_sx",
    "write_text",
]
