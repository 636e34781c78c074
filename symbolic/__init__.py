"""What the user says: plants, signals, equations, scenarios."""

from obsynth.symbolic.errors import ObsynthError, ObsynthWarning, PlantError
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.scenario import Scenario
from obsynth.symbolic.signals import Role, Signal
from obsynth.symbolic.sxmodel import SxModel

__all__ = [
    "ObsynthError",
    "ObsynthWarning",
    "Plant",
    "PlantError",
    "Role",
    "Scenario",
    "Signal",
    "SxModel",
]
