"""Bounds and parameters that explain a record."""
