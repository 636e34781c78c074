"""Refusals of the code generator: what cannot be generated, built or shown to be equal."""

from obsynth.symbolic.errors import ObsynthError


class CodegenError(ObsynthError):
    """A project that cannot be generated or put where it was asked for.

    Examples
    --------
    >>> CodegenError("precision 'single' is not available", available=("double",)).available
    ('double',)
    """


class FolderError(CodegenError):
    """A folder that holds what is not ours to replace; ``folder`` and ``files`` as attributes."""


class BuildError(CodegenError):
    """Generated C that a compiler rejects, or a program that cannot be run.

    Parameters
    ----------
    message : str
        Which step failed and the first lines of what the compiler said.
    **facts
        ``command`` and ``output`` as attributes.
    """


class ComparisonError(CodegenError):
    """The compiled step differs from the CasADi function it was made from.

    Parameters
    ----------
    message : str
        The first difference: vector, output, both values in hexadecimal.
    **facts
        ``vector``, ``line``, ``output``, ``expected``, ``computed`` (bit patterns as text),
        ``differing`` and ``vectors`` (counts) as attributes.
    """
