"""Largest eigenvalues and norms, guaranteed: of matrices, interval matrices, matrix functions."""

from obsynth.derive.spectrum.field import SymmetricField
from obsynth.derive.spectrum.interval_matrix import (
    IntervalExtreme,
    augment,
    eigenvalue_over_interval,
    norm_over_interval,
)
from obsynth.derive.spectrum.search import Maximum, largest_over_box
from obsynth.derive.spectrum.symmetric import largest_eigenvalue

__all__ = [
    "IntervalExtreme",
    "Maximum",
    "SymmetricField",
    "augment",
    "eigenvalue_over_interval",
    "largest_eigenvalue",
    "largest_over_box",
    "norm_over_interval",
]
