"""The proof of definiteness never accepts what exact arithmetic refutes."""

import numpy as np
import pytest

from obsynth.derive.rigour import enclosure, is_positive_definite, prove_positive_definite
from obsynth.symbolic.errors import ObsynthError


def nearly_singular(rng, rows, count, spread=20.0):
    """Symmetric doubles whose smallest eigenvalue is some roundings away from zero."""
    matrices = np.empty((count, rows, rows))
    for k in range(count):
        orthogonal = np.linalg.qr(rng.normal(size=(rows, rows)))[0]
        values = 10.0 ** rng.uniform(-3, 0, rows)
        values[0] = spread * rows * 2.0**-53 * rng.normal()
        scale = 2.0 ** rng.integers(-4, 5, rows) if k % 2 else np.ones(rows)
        matrix = (orthogonal * values) @ orthogonal.T
        matrices[k] = scale[:, None] * (np.tril(matrix) + np.tril(matrix, -1).T) * scale
    return matrices


def verdicts(matrices):
    proved = prove_positive_definite(matrices).proved
    exact = np.array([is_positive_definite(matrix) for matrix in matrices])
    return proved, exact


def test_no_false_acceptance_among_nearly_singular_matrices():
    rng = np.random.default_rng(0)
    accepted = 0
    for rows, count in ((8, 120), (9, 80), (10, 80), (12, 80), (28, 12)):
        proved, exact = verdicts(nearly_singular(rng, rows, count))
        assert not np.any(proved & ~exact)
        assert exact.any() and not exact.all()
        accepted += int(proved.sum())
    assert accepted > 0


@pytest.mark.long
def test_no_false_acceptance_in_ten_thousand():
    rng = np.random.default_rng(1)
    for rows in (8, 9, 10, 11, 12):
        proved, exact = verdicts(nearly_singular(rng, rows, 2000))
        assert not np.any(proved & ~exact)
        assert proved.any() and not exact.all()
    proved, exact = verdicts(nearly_singular(rng, 28, 200))
    assert not np.any(proved & ~exact)
    assert proved.any() and not exact.all()


def test_without_its_error_bound_the_proof_would_accept_indefinite_matrices(monkeypatch):
    matrices = nearly_singular(np.random.default_rng(2), 10, 400, spread=0.5)
    exact = np.array([is_positive_definite(matrix) for matrix in matrices])
    assert not np.any(prove_positive_definite(matrices).proved & ~exact)
    monkeypatch.setattr(enclosure, "gamma_bound", lambda n: 0.0)
    monkeypatch.setattr(enclosure, "UNIT_ROUNDOFF", 0.0)
    assert np.any(prove_positive_definite(matrices).proved & ~exact)


@pytest.mark.parametrize("sharp", [True, False])
def test_the_margin_is_a_lower_bound_of_the_smallest_eigenvalue(sharp):
    rng = np.random.default_rng(3)
    roots = rng.normal(size=(50, 6, 9))
    matrices = roots @ np.swapaxes(roots, 1, 2)
    matrices = 0.5 * (matrices + np.swapaxes(matrices, 1, 2))
    result = prove_positive_definite(matrices, 1e-10, sharp=sharp)
    least = np.linalg.eigvalsh(matrices)[:, 0]
    assert result.all_proved
    assert np.all(result.margin <= least) and np.all(result.margin > 0)
    for matrix, margin in zip(matrices[:5], result.margin[:5], strict=True):
        assert is_positive_definite(matrix - np.diag(np.full(6, 0.999 * margin)))
    if sharp:
        assert np.all(result.relative > 0.5 * least / np.abs(matrices).max(axis=(1, 2)) / 4)


def test_the_radius_counts():
    matrix = np.array([[1.0, 0.5], [0.5, 1.0]])
    assert prove_positive_definite(matrix, 0.2).all_proved
    assert not prove_positive_definite(matrix, 0.25).all_proved
    corner = np.array([[0.0, 0.6], [0.6, 0.0]])
    assert not prove_positive_definite(matrix, corner).all_proved


def test_the_radii_of_both_halves_count():
    """Entries .75 and .85, both up to .25 away, may both be 1; mutant: half of one radius."""
    matrix, radius = np.array([[1.0, 0.75], [0.85, 1.0]]), np.array([[0.0, 0.25], [0.25, 0.0]])
    assert prove_positive_definite(matrix, 0.5 * radius).all_proved
    assert not prove_positive_definite(matrix, radius).all_proved


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_not_proved(value):
    matrices = np.stack([np.eye(3), np.eye(3), 2 * np.eye(3)])
    matrices[1, 2, 2] = value
    assert prove_positive_definite(matrices).proved.tolist() == [True, False, True]
    matrices[1] = np.eye(3)
    radius = np.zeros((3, 3, 3))
    radius[1, 0, 1] = radius[1, 1, 0] = np.inf
    assert prove_positive_definite(matrices, radius).proved.tolist() == [True, False, True]


def test_badly_scaled_matrices_are_proved_after_scaling():
    scale = np.diag([1e-120, 1e-3, 1.0, 1e90])
    matrix = scale @ (np.eye(4) + 0.1 * np.ones((4, 4))) @ scale
    result = prove_positive_definite(matrix)
    assert result.all_proved and result.relative[0] > 0.2
    assert 0 < result.margin[0] < 1.2e-240


@pytest.mark.parametrize(
    "matrix", [np.zeros((2, 2)), np.diag([1.0, 0.0]), np.diag([1.0, -1e-300]), -np.eye(3)]
)
def test_semidefinite_and_indefinite_matrices_are_refused(matrix):
    result = prove_positive_definite(matrix)
    assert not result.all_proved and result.margin[0] == -np.inf


def test_asymmetric_or_rectangular_input_is_an_error():
    with pytest.raises(ObsynthError, match=r"\(0, 1\) and \(1, 0\)") as caught:
        prove_positive_definite([[1.0, 0.1], [0.2, 1.0]])
    assert caught.value.entry == (0, 1)
    assert prove_positive_definite([[1.0, 0.1], [0.2, 1.0]], 0.06).all_proved
    with pytest.raises(ObsynthError, match="not square"):
        prove_positive_definite(np.ones((2, 3)))


def test_worst_first():
    result = prove_positive_definite(np.stack([np.eye(2), 0.5 * np.eye(2) + 0.4, np.eye(2)]))
    assert result.worst(1).tolist() == [1]


def test_a_floor_is_proved_as_a_lower_bound():
    rng = np.random.default_rng(6)
    roots = rng.normal(size=(20, 5, 8))
    matrices = roots @ np.swapaxes(roots, 1, 2) * np.logspace(-6, 6, 20)[:, None, None]
    matrices = 0.5 * (matrices + np.swapaxes(matrices, 1, 2))
    for matrix in matrices:
        least = np.linalg.eigvalsh(matrix)[0]
        above = prove_positive_definite(matrix, floor=0.999 * least)
        assert above.all_proved and 0.999 * least <= above.margin[0] <= least
        assert not prove_positive_definite(matrix, floor=1.001 * least).all_proved
        exact = matrix - np.diag(np.full(5, above.margin[0]))
        assert is_positive_definite(exact)
