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

from obsynth.designs.lmi.conic import Solution as Solution
from obsynth.designs.lmi.expression import Affine as Affine
from obsynth.designs.lmi.expression import ExpressionError as ExpressionError
from obsynth.designs.lmi.expression import constant as constant
from obsynth.designs.lmi.expression import diagonal as diagonal
from obsynth.designs.lmi.expression import full as full
from obsynth.designs.lmi.expression import scalar as scalar
from obsynth.designs.lmi.expression import symmetric as symmetric
from obsynth.designs.lmi.expression import trace as trace
from obsynth.designs.lmi.margin import Margin as Margin
from obsynth.designs.lmi.margin import MarginSolution as MarginSolution
from obsynth.designs.lmi.margin import largest_margin as largest_margin
from obsynth.designs.lmi.margin import solve_with_margin as solve_with_margin
from obsynth.designs.lmi.problem import Problem as Problem
from obsynth.designs.lmi.problem import block as block
from obsynth.designs.lmi.problem import cap_gain as cap_gain
from obsynth.designs.lmi.problem import he as he
from obsynth.designs.lmi.problem import symmetric_block as symmetric_block
from obsynth.designs.lmi.proof import FamilyProof as FamilyProof
from obsynth.designs.lmi.proof import prove_family as prove_family
from obsynth.designs.lmi.reductions import extreme_points as extreme_points
from obsynth.designs.lmi.reductions import split_common as split_common
from obsynth.designs.lmi.relaxation import RowMultipliers as RowMultipliers
from obsynth.designs.lmi.relaxation import UncertainRow as UncertainRow
from obsynth.designs.lmi.relaxation import corner_block as corner_block
from obsynth.designs.lmi.relaxation import relax_sum as relax_sum
from obsynth.designs.lmi.relaxation import row_multipliers as row_multipliers
from obsynth.designs.lmi.search import Knob as Knob
from obsynth.designs.lmi.search import bisect_feasible as bisect_feasible
from obsynth.designs.lmi.search import search_line as search_line
from obsynth.designs.lmi.search import search_log_convex as search_log_convex
from obsynth.designs.lmi.search import smallest_changes as smallest_changes
from obsynth.designs.lmi.solve import solve_lazily as solve_lazily
from obsynth.designs.lmi.solve import solve_reliably as solve_reliably
from obsynth.designs.lmi.solve import solve_with_retries as solve_with_retries
