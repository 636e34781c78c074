"""Errors of all rooms: what was given, which symbol of the user's, what to do."""

from typing import Any

from obsynth.symbolic.shown import card


class ObsynthWarning(UserWarning):
    """Something worth knowing that is not wrong."""


class ObsynthError(ValueError):
    """Base of every refusal; the facts behind the message are attributes.

    Parameters
    ----------
    message : str
        What was given, which symbol it concerns and what would fix it.
    **facts
        Machine-readable facts, stored as attributes and in ``facts``.

    Examples
    --------
    >>> error = ObsynthError("the box of h3 reaches 0", symbol="h3")
    >>> error.symbol
    'h3'
    """

    def __init__(self, message: str, **facts: Any) -> None:
        super().__init__(message)
        self.facts = facts

    def _repr_html_(self) -> str:
        first, *lines = str(self).splitlines() or [""]
        return card(type(self).__name__, first, [line.strip() for line in lines])

    def __getattr__(self, name: str) -> Any:
        try:
            return self.__dict__["facts"][name]
        except KeyError:
            raise AttributeError(name) from None


class PlantError(ObsynthError):
    """A plant, scenario or expression that cannot be accepted as typed."""


class RecordError(PlantError):
    """A record that does not hold what its plant needs, or not on the plant's grid."""
