"""Refusals of the evaluation room."""

from obsynth.symbolic.errors import ObsynthError


class SimulationError(ObsynthError):
    """A simulation that cannot be started or whose truth is no number any more."""


class ReportError(ObsynthError):
    """A table, plot or page that cannot be made from what was given."""


class BoundsError(ObsynthError):
    """A record that cannot be asked for bounds, or that no trajectory of the plant explains."""
