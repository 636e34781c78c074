"""Largest eigenvalues of single matrices: bounds that exact inertia cannot refute."""

import dataclasses
from fractions import Fraction

import numpy as np
import pytest

from obsynth.derive.rigour import eigenvalues as symmetric
from obsynth.derive.rigour import largest_eigenvalue, perron_bound


def symmetric_matrices(count, size, seed=0, scale=1.0):
    raw = np.random.default_rng(seed).normal(size=(count, size, size)) * scale
    return 0.5 * (raw + raw.transpose(0, 2, 1))


def negative_eigenvalues(matrix, shift):
    """Inertia of shift I - matrix in rational arithmetic, by symmetric elimination."""
    n = len(matrix)
    work = [[Fraction(float(-matrix[i, j])) for j in range(n)] for i in range(n)]
    for i in range(n):
        work[i][i] += Fraction(float(shift))
    count = 0
    for k in range(n):
        pivot = work[k][k]
        if pivot == 0:
            return count if not any(work[k][k:]) else count + 1
        count += pivot < 0
        for i in range(k + 1, n):
            factor = work[i][k] / pivot
            for j in range(k, n):
                work[i][j] -= factor * work[k][j]
    return count


def wrong_bounds(matrices, lower, upper):
    """Matrices whose bounds are refuted exactly."""
    return [
        k
        for k, A in enumerate(matrices)
        if negative_eigenvalues(A, upper[k]) > 0
        or negative_eigenvalues(A, np.nextafter(lower[k], -np.inf)) == 0
    ]


@pytest.mark.parametrize("size", [1, 2, 3, 5, 8])
def test_bounds_hold_exactly_and_are_tight(size):
    matrices = symmetric_matrices(30, size, seed=size)
    lower, upper = largest_eigenvalue(matrices)
    assert not wrong_bounds(matrices, lower, upper)
    assert (upper - lower).max() <= 1e-13 * size * size


def test_bounds_hold_for_multiple_and_badly_scaled_eigenvalues():
    scale = np.diag([1e-8, 1.0, 1e6])
    matrices = np.array(
        [np.eye(3), np.zeros((3, 3)), np.ones((3, 3)), -np.eye(3), scale @ np.ones((3, 3)) @ scale]
    )
    lower, upper = largest_eigenvalue(matrices)
    assert not wrong_bounds(matrices, lower, upper)
    np.testing.assert_allclose(upper, [1, 0, 3, -1, 1e12 + 1 + 1e-16], rtol=1e-13, atol=1e-280)


def test_without_the_charge_for_rounding_bounds_are_wrong(monkeypatch):
    whole = symmetric.rotate

    def careless(centre, radius):
        found = whole(centre, radius)
        return dataclasses.replace(found, error=0.0 * found.error, defect=0.0 * found.defect)

    monkeypatch.setattr(symmetric, "rotate", careless)
    matrices = symmetric_matrices(60, 5, seed=3, scale=1e3)
    assert wrong_bounds(matrices, *largest_eigenvalue(matrices))


def test_radius_covers_every_matrix_within():
    rng = np.random.default_rng(0)
    centre = symmetric_matrices(20, 4)
    radius = np.abs(symmetric_matrices(20, 4, seed=1))
    lower, upper = largest_eigenvalue(centre, radius)
    for _ in range(50):
        signs = np.triu(rng.uniform(-1, 1, size=(20, 4, 4)))
        signs = signs + np.triu(signs, 1).transpose(0, 2, 1)
        true = np.linalg.eigvalsh(centre + signs * radius)[:, -1]
        assert (true <= upper).all()
        assert (true >= lower).all()


def test_entries_that_are_not_finite_give_no_bound():
    matrices = np.array([[[np.nan, 0.0], [0.0, 1.0]], [[np.inf, 0.0], [0.0, 1.0]]])
    lower, upper = largest_eigenvalue(matrices)
    assert (lower == -np.inf).all()
    assert (upper == np.inf).all()


def perron_refuted(seed):
    """Nonnegative matrices whose bound is refuted exactly."""
    raw = np.random.default_rng(seed).exponential(size=(20, 4, 4)) ** 6
    matrices = np.tril(raw) + np.tril(raw, -1).transpose(0, 2, 1)
    return [k for k, A in enumerate(matrices) if negative_eigenvalues(A, perron_bound(matrices)[k])]


def test_the_perron_bound_holds_exactly(monkeypatch):
    assert not any(perron_refuted(seed) for seed in range(5))
    matrices = np.ones((1, 3, 3))
    assert 3.0 <= perron_bound(matrices)[0] <= 3.0 * (1 + 1e-13)
    monkeypatch.setattr(symmetric, "gamma_bound", lambda n: -(2.0**-44))
    assert any(perron_refuted(seed) for seed in range(5))


def test_the_bound_of_a_nonnegative_matrix_holds_its_row_sums():
    """a + b is the eigenvalue of [a b; b a]; mutant: the sum of a row rounded to nearest."""
    a, b = np.random.default_rng(0).uniform(0.1, 1.0, (2, 300))
    matrices = np.moveaxis(np.array([[a, b], [b, a]]), -1, 0)
    for x, y, bound in zip(a, b, perron_bound(matrices), strict=True):
        assert (
            Fraction(x) + Fraction(y)
            <= Fraction(bound)
            <= Fraction(x + y) * (1 + Fraction(1, 10**14))
        )
