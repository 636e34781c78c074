"""Affine matrix expressions, conic solvers and proofs of definiteness.

Write the LMI once, as a function of its matrices, with ``block`` and ``+ - @ *``: called with
variables it becomes a constraint of a `Problem`, called with `Enclosure` it is
what `prove_positive_definite` decides, called with `ExactMatrix` it is the
independent check by `is_positive_definite`.
"""
