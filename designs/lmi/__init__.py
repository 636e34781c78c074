"""Affine matrix expressions, conic solvers and proofs of definiteness."""
