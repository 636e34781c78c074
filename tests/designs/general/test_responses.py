"""Sums of absolute responses against exact ones and their derivative; small-gain solutions."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from obsynth.derive.rigour import Enclosure
from obsynth.designs.general.peak import absolute_sums, power_sum, response, small_gain_solution


def exact_inverse(matrix: list[list[Fraction]]) -> list[list[Fraction]]:
    """Return the inverse by Gauss-Jordan elimination."""
    size = len(matrix)
    table = [[*row, *(Fraction(int(i == j)) for j in range(size))] for i, row in enumerate(matrix)]
    for i in range(size):
        pivot = next(r for r in range(i, size) if table[r][i])
        table[i], table[pivot] = table[pivot], table[i]
        table[i] = [value / table[i][i] for value in table[i]]
        for r in range(size):
            if r != i:
                table[r] = [a - table[r][i] * b for a, b in zip(table[r], table[i], strict=True)]
    return [row[size:] for row in table]


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    values=st.lists(st.floats(0, 1), min_size=9, max_size=9),
    radius=st.sampled_from([0.0, 1e-9]),
    norm=st.sampled_from([0.3, 0.9, 0.99]),
    unit=st.sampled_from([1.0, 1e8]),
)
def test_sums_of_powers_are_above_the_exact_ones(values, radius, norm, unit):
    """For A >= 0 the sum of all powers is (I - A)^-1, computed here in fractions."""
    # no coefficient is as small as 1e-100, whose balanced size would be lost beside the rest
    matrix = np.array([value if value > 1e-100 else 0.0 for value in values]).reshape(3, 3)
    matrix *= norm / max(matrix.sum(axis=1).max(), 1e-3)
    matrix[0, 1:] *= unit
    matrix[1:, 0] /= unit
    rad = radius * matrix
    sums = power_sum(Enclosure(matrix, rad))
    largest = [
        [
            Fraction(int(i == j)) - Fraction(float(a)) - Fraction(float(r))
            for j, (a, r) in enumerate(zip(row, rrow, strict=True))
        ]
        for i, (row, rrow) in enumerate(zip(matrix, rad, strict=True))
    ]
    exact = exact_inverse(largest)
    total = response(sums, np.eye(3), Enclosure.of(np.eye(3))).total
    for bound in (sums.bound, total):
        for i in range(3):
            for j in range(3):
                assert exact[i][j] <= Fraction(float(bound[i, j]))
        expected = np.array([[float(x) for x in row] for row in exact])
        # the fourth power of the remainder stands in every entry
        scale = np.array([[1, unit, unit], [1 / unit, 1, 1], [1 / unit, 1, 1]])
        np.testing.assert_allclose(bound / scale, expected / scale, 1e-10 + 1e5 * radius, 1e-22)


def test_the_naive_sum_is_not_a_bound():
    """Mutant: the plain sum of computed powers falls below the exact value."""
    matrix = np.array([[0.9, 0.05], [0.03, 0.7]])
    naive = sum(np.linalg.matrix_power(matrix, k) for k in range(2000))
    one = [
        [Fraction(int(i == j)) - Fraction(float(matrix[i, j])) for j in range(2)] for i in range(2)
    ]
    exact = exact_inverse(one)
    sums = power_sum(Enclosure.of(matrix)).bound
    pairs = [(i, j) for i in range(2) for j in range(2)]
    assert any(Fraction(float(naive[i, j])) < exact[i][j] for i, j in pairs)
    assert all(Fraction(float(sums[i, j])) >= exact[i][j] for i, j in pairs)


def test_single_powers_are_within_their_error():
    matrix = np.array([[0.5, 0.25], [-0.125, 0.75]])
    sums = power_sum(Enclosure.of(matrix))
    power = [[Fraction(1), Fraction(0)], [Fraction(0), Fraction(1)]]
    entries = [[Fraction(float(v)) for v in row] for row in matrix]
    for k in range(200):
        computed = sums.powers[k] if k < sums.steps else np.zeros((2, 2))
        for i in range(2):
            for j in range(2):
                lost = abs(power[i][j] - Fraction(float(computed[i, j])))
                assert lost <= Fraction(float(sums.error[i, j]))
        power = [
            [sum(entries[i][m] * power[m][j] for m in range(2)) for j in range(2)] for i in range(2)
        ]
        power = [[Fraction(round(x * 2**200), 2**200) for x in row] for row in power]


@settings(max_examples=30, deadline=None, derandomize=True)
@given(
    values=st.lists(st.floats(0, 1), min_size=16, max_size=16),
    noise=st.lists(st.sampled_from([0.0, 1e-6, 1.0, 1e3]), min_size=4, max_size=4),
    norm=st.sampled_from([0.0, 0.5, 0.999]),
)
def test_small_gain_solutions_are_exact_supersolutions(values, noise, norm):
    G = np.array(values).reshape(4, 4)
    G *= norm / max(G.sum(axis=1).max(), 1e-3)
    n = np.array(noise)
    b = small_gain_solution(G, n)
    for i in range(4):
        image = Fraction(n[i]) + sum(Fraction(G[i, j]) * Fraction(b[j]) for j in range(4))
        assert image <= Fraction(b[i])
    np.testing.assert_allclose(b, np.linalg.solve(np.eye(4) - G, n), rtol=1e-8, atol=1e-250)


def test_outputs_that_are_known_up_to_a_radius():
    """A scalar: (|q| + r) (|b| + s) / (1 - |a|). Mutants: either radius left out."""
    sums = power_sum(Enclosure.of(np.array([[0.5]])))
    for r in (0.0, 0.25):
        for s in (0.0, 0.125):
            Q = Enclosure(np.array([[-1.0]]), np.array([[r]]))
            B = Enclosure(np.array([[2.0]]), np.array([[s]]))
            found = response(sums, Q, B)
            exact = (1 + r) * (2 + s) * 2
            assert exact <= found.total[0, 0] <= exact * (1 + 1e-9)
            assert np.all(found.terms.max(axis=0) + found.spread >= (1 + r) * (2 + s))


@pytest.mark.parametrize("wanted", [1, 5, 31, 100])
def test_batched_sums(wanted):
    rng = np.random.default_rng(wanted)
    matrix, inputs = 0.4 * rng.normal(size=(3, 3)), rng.normal(size=(3, 2))
    outputs = rng.normal(size=(4, 3))
    fast = absolute_sums(matrix, inputs, outputs, wanted).total
    steps = 4
    while steps < wanted:
        steps *= 2
    direct = sum(np.abs(outputs @ np.linalg.matrix_power(matrix, k) @ inputs) for k in range(steps))
    np.testing.assert_allclose(fast, direct, rtol=1e-12)


def test_derivative_of_the_sums():
    rng = np.random.default_rng(7)
    matrix, inputs = 0.4 * rng.normal(size=(3, 3)), rng.normal(size=(3, 2))
    outputs, weights = rng.normal(size=(4, 3)), rng.uniform(size=(4, 2))
    bars = absolute_sums(matrix, inputs, outputs, 31).derivative(weights)
    step = 1e-7
    for which, bar in enumerate(bars):
        for entry in np.ndindex(bar.shape):
            ends = []
            for sign in (1, -1):
                data = [matrix.copy(), inputs.copy()]
                data[which][entry] += sign * step
                ends.append((weights * absolute_sums(*data, outputs, 31).total).sum())
            assert bar[entry] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-5)
