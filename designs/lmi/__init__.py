"""Affine matrix expressions, conic solvers and proofs of definiteness.

Write the LMI once, as a function of its matrices, with ``block`` and ``+ - @ *``: called with
variables it becomes a constraint of a :class:`Problem`, called with :class:`Enclosure` it is
what :func:`prove_positive_definite` decides, called with :class:`ExactMatrix` it is the
independent check by :func:`is_positive_definite`.
"""

from obsynth.designs.lmi.blocks import block, he, symmetric_block
from obsynth.designs.lmi.definite import ProofResult, prove_positive_definite
from obsynth.designs.lmi.enclosure import Enclosure
from obsynth.designs.lmi.exact import ExactMatrix, is_positive_definite
from obsynth.designs.lmi.expression import (
    Affine,
    ExpressionError,
    Inequality,
    constant,
    diagonal,
    full,
    scalar,
    symmetric,
    trace,
)
from obsynth.designs.lmi.problem import Block, Problem
from obsynth.designs.lmi.solution import Solution

__all__ = [
    "Affine",
    "Block",
    "Enclosure",
    "ExactMatrix",
    "ExpressionError",
    "Inequality",
    "Problem",
    "ProofResult",
    "Solution",
    "block",
    "constant",
    "diagonal",
    "full",
    "he",
    "is_positive_definite",
    "prove_positive_definite",
    "scalar",
    "symmetric",
    "symmetric_block",
    "trace",
]
