"""Jacobians over a box: entries, bounds, dependences, affine families."""
