"""Refusals of the code generator: what cannot be generated, built or shown to be equal."""

from obsynth.symbolic.errors import ObsynthError


class CodegenError(ObsynthError):
    """A project that cannot be generated or put where it was asked for."""


class FolderError(CodegenError):
    """A folder that holds what is not ours to replace; ``folder`` and ``files`` as attributes."""


class BuildError(CodegenError):
    """Generated C that a compiler rejects, or a program that cannot be run: `command`, `output`."""


class ComparisonError(CodegenError):
    """The compiled step differs from the CasADi function it was made from, first told in full.

    `vector`, `line`, `output`, `expected`, `computed` (bit patterns), `differing`, `vectors`.
    """
