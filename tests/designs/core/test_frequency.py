"""Peaks over frequencies, against a dense grid; no number where a map is not stable."""

import numpy as np
import pytest

from obsynth.designs.core.frequency import peak_gain
from obsynth.designs.interval.printed import largest_alpha


def test_the_peak_is_that_of_a_dense_grid():
    rng = np.random.default_rng(0)
    A, B, C, D = (rng.standard_normal(shape) for shape in ((5, 3, 3), (3, 2), (2, 3), (2, 2)))
    A *= (0.97 / np.abs(np.linalg.eigvals(A)).max(axis=1))[:, None, None]
    gains, peaks, inputs = peak_gain(A, B, C, D)
    z = np.exp(1j * np.linspace(0.0, np.pi, 20001))[:, None, None]
    for a, gain, peak, w in zip(A, gains, peaks, inputs, strict=True):
        dense = np.linalg.norm(C @ np.linalg.solve(z * np.eye(3) - a, B) + D, ord=2, axis=(1, 2))
        assert dense.max() * (1 - 1e-9) <= gain <= dense.max() * (1 + 1e-4)
        there = C @ np.linalg.solve(np.exp(1j * peak) * np.eye(3) - a, B) + D
        assert np.linalg.norm(there @ w) == pytest.approx(gain) and np.linalg.norm(
            w
        ) == pytest.approx(1)


@pytest.mark.parametrize("R", [np.eye(2), np.diag([-1.0, 0.5]), 2 * np.eye(2)])
def test_there_is_none_where_a_mode_does_not_decay(R):
    """Mutant: the inverse is formed at a mode on the unit circle."""
    assert largest_alpha(R) == 0.0
