"""Refusals of the design methods: what fails, where, with which number, what would fix it."""

from collections.abc import Iterable
from typing import Any

from obsynth.symbolic.errors import ObsynthError


class _Refusal(ObsynthError):
    """A headline, and one indented line per detail."""

    def __init__(self, headline: str, details: Iterable[str] = (), **facts: Any) -> None:
        lines = tuple(details)
        super().__init__("\n  ".join((headline, *lines)), headline=headline, details=lines, **facts)


class InfeasibleDesign(_Refusal):
    """No observer with the required property exists, or none was found with a margin.

    Parameters
    ----------
    headline : str
        Which design, and which condition fails.
    details : iterable of str
        One line each: margin, binding blocks, the smallest change that helps.
    **facts
        The same as attributes, for example ``margin``, ``blocks``, ``certificate``.

    Examples
    --------
    >>> print(InfeasibleDesign("gamma = 0.01 is infeasible", ["largest feasible: 0.009"]))
    gamma = 0.01 is infeasible
      largest feasible: 0.009
    """


class CertificateError(_Refusal):
    """A claim could not be proved for the gains as they are stored.

    Parameters
    ----------
    headline : str
        Which claim fails.
    details : iterable of str
        The blocks and vertices without proof, with their margins.
    **facts
        The same as attributes.

    Examples
    --------
    >>> CertificateError("decay is not proved", vertex=3).vertex
    3
    """


class DetectorError(ObsynthError):
    """A fault detector that cannot be built over this observer, or a run that is not its own."""


class SolverTrouble(_Refusal):
    """The solver neither solved the problem nor showed that it is infeasible.

    Parameters
    ----------
    headline : str
        Which problem and which status.
    details : iterable of str
        What was tried.
    **facts
        ``status``, ``solver`` and the like as attributes.

    Examples
    --------
    >>> SolverTrouble("decay: AlmostSolved", status="AlmostSolved").status
    'AlmostSolved'
    """
