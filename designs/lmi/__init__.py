"""Affine matrix expressions, conic solvers and proofs of definiteness.

Write the LMI once, as a function of its matrices, with ``block`` and ``+ - @ *``: called with
variables it becomes a constraint of a `Problem`, called with `Enclosure` it is
what `prove_positive_definite` decides, called with `ExactMatrix` it is the
independent check by `is_positive_definite`.

Examples
--------
An observer x+ = A x with two vertices, its LMI written once, solved, and proved for the gain
as it is stored:

>>> import numpy as np
>>> from obsynth.derive.rigour import Enclosure, prove_positive_definite
>>> from obsynth.designs.lmi.expression import full, symmetric
>>> from obsynth.designs.lmi.margin import solve_with_margin
>>> from obsynth.designs.lmi.problem import Problem, symmetric_block
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
