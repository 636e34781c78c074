"""Quadratic parameter-varying forms."""
