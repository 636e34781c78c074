"""Affine matrix expressions, conic solvers and proofs of definiteness.

Write the LMI once, as a function of its matrices, with ``block`` and ``+ - @ *``: called with
variables it becomes a constraint of a :class:`Problem`, called with :class:`Enclosure` it is
what :func:`prove_positive_definite` decides, called with :class:`ExactMatrix` it is the
independent check by :func:`is_positive_definite`.

Examples
--------
An observer x+ = A x with two vertices, its LMI written once, solved, and proved for the gain
as it is stored:

>>> import numpy as np
>>> from obsynth.derive.rigour import Enclosure, prove_positive_definite
>>> A = np.array([[[0.9, 0.2], [0.0, 0.7]], [[0.8, 0.3], [0.1, 0.9]]])
>>> C = np.array([[1.0, 0.0]])
>>> def decay(P, H, A, C):
...     return symmetric_block([[0.9 * P], [P @ A - H @ C, P]])
>>> P, H = symmetric("P", 2), full("H", 2, 1)
>>> problem = Problem("observer")
>>> problem.add_lmi("decay", decay(P, H, A, C), ">>")
>>> problem.add("size", P << np.eye(2))
>>> problem.maximise_lambda_min(P)
>>> def prove(values):
...     P, K = Enclosure.of(values["P"]), np.linalg.solve(values["P"], values["H"])
...     return prove_positive_definite(decay(P, P @ K, Enclosure.of(A), Enclosure.of(C)))
>>> observer = solve_with_margin(problem, prove=prove)
>>> observer.proof.all_proved
True
"""

from obsynth.designs.lmi.conic import Solution
from obsynth.designs.lmi.expression import (
    Affine,
    ExpressionError,
    constant,
    diagonal,
    full,
    scalar,
    symmetric,
    trace,
)
from obsynth.designs.lmi.margin import Margin, MarginSolution, largest_margin, solve_with_margin
from obsynth.designs.lmi.problem import Problem, block, cap_gain, he, symmetric_block
from obsynth.designs.lmi.proof import FamilyProof, prove_family
from obsynth.designs.lmi.reductions import (
    distinct_members,
    extreme_points,
    split_common,
)
from obsynth.designs.lmi.relaxation import (
    RowMultipliers,
    UncertainRow,
    corner_block,
    relax_sum,
    row_multipliers,
)
from obsynth.designs.lmi.search import (
    Knob,
    bisect_feasible,
    search_line,
    search_log_convex,
    smallest_changes,
)
from obsynth.designs.lmi.solve import solve_lazily, solve_reliably, solve_with_retries

__all__ = [
    "Affine",
    "ExpressionError",
    "FamilyProof",
    "Knob",
    "Margin",
    "MarginSolution",
    "Problem",
    "RowMultipliers",
    "Solution",
    "UncertainRow",
    "bisect_feasible",
    "block",
    "cap_gain",
    "constant",
    "corner_block",
    "diagonal",
    "distinct_members",
    "extreme_points",
    "full",
    "he",
    "largest_margin",
    "prove_family",
    "relax_sum",
    "row_multipliers",
    "scalar",
    "search_line",
    "search_log_convex",
    "smallest_changes",
    "solve_lazily",
    "solve_reliably",
    "solve_with_margin",
    "solve_with_retries",
    "split_common",
    "symmetric",
    "symmetric_block",
    "trace",
]
