"""The error of one step, once for variables, floats and enclosures."""

from __future__ import annotations

from typing import Any


def error_matrices(A: Any, C: Any, L: Any) -> Any:
    """Return A + M - L C for matrices A + M at the vertices."""
    return A - L @ C


def noise_matrix(W1: Any, W2: Any, L: Any) -> Any:
    """Return W1 - L W2."""
    return W1 - L @ W2
