"""Polytopes of matrices and of parameters, with fewer vertices."""
