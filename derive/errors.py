"""Refusals of this room: a condition that fails, or a bound that does not exist."""

from obsynth.symbolic.errors import ObsynthError


class DerivationError(ObsynthError):
    """A derivation that cannot be carried out for the plant as given."""


class StructureError(ObsynthError):
    """A structural condition of the plant that fails, with the symbol it concerns.

    Attributes
    ----------
    facts : dict
        What failed as data: ``condition``, ``symbol``, ``row``, ``rank`` and the like.
    """


class UnboundedError(ObsynthError):
    """A range over a box for which no finite bound exists or could be found.

    Attributes
    ----------
    entries : tuple of str
        Names of the expressions concerned.
    operation : str
        The first operation without a finite result.
    sub_box : dict of str to (float, float)
        Where in the box that happens, by symbol.
    """
