"""Exact matrices, judged by independent means."""

from fractions import Fraction
from itertools import combinations

import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from obsynth.derive.rigour import (
    ExactMatrix,
    above,
    down,
    exact,
    from_text,
    image,
    inverse,
    is_positive_definite,
    nearest,
    to_text,
)
from obsynth.symbolic.errors import ObsynthError

PROPERTY = settings(derandomize=True, max_examples=60, deadline=None)


@PROPERTY
@given(
    n=st.integers(1, 4),
    entries=st.lists(st.fractions(-4, 4, max_denominator=6), min_size=16, max_size=16),
    lift=st.integers(0, 6),
)
def test_the_verdict_is_that_of_the_leading_minors(n, entries, lift):
    matrix = [[entries[4 * min(i, j) + max(i, j)] for j in range(n)] for i in range(n)]
    for i in range(n):
        matrix[i][i] += lift
    minors = [sp.Matrix(matrix)[:k, :k].det() for k in range(1, n + 1)]
    assert is_positive_definite(matrix) == all(minor > 0 for minor in minors)


def test_a_singular_gram_matrix_is_not_definite_and_a_hair_more_is():
    columns = [[Fraction(1, 3), 2, 0], [1, Fraction(1, 7), 5], [0, 4, 1], [1, 1, 1]]
    gram = [
        [sum(Fraction(a) * b for a, b in zip(u, v, strict=True)) for v in columns] for u in columns
    ]
    assert not is_positive_definite(gram)
    for i in range(4):
        gram[i][i] += Fraction(1, 10**60)
    assert is_positive_definite(gram)
    assert all(
        is_positive_definite([[gram[i][j] for j in rows] for i in rows])
        for k in (1, 2, 3)
        for rows in combinations(range(4), k)
    )


def test_doubles_enter_without_rounding():
    assert ExactMatrix.of([[0.1]]).to_fractions() == [[Fraction(0.1)]]
    assert ExactMatrix.of([[0.1]]).to_fractions() != [[Fraction(1, 10)]]
    assert ExactMatrix.of([[sp.Rational(1, 3)]]).to_fractions() == [[Fraction(1, 3)]]
    rng = np.random.default_rng(0)
    values = rng.normal(size=(3, 2))
    assert np.array_equal(ExactMatrix.of(values).to_floats(), values)


def test_arithmetic_is_that_of_fractions():
    a = ExactMatrix.of([[1, 2], [3, 5]])
    assert (a @ a.inverse()).to_fractions() == [[1, 0], [0, 1]]
    assert (2 * a - a / 2).to_fractions()[1] == [Fraction(9, 2), Fraction(15, 2)]
    assert (a * a)[1, :].to_fractions() == [[9, 25]]
    assert (1 - ExactMatrix.of(Fraction(1, 3))).to_fractions() == [[Fraction(2, 3)]]
    assert (np.eye(2) @ a).to_fractions() == a.to_fractions()


@pytest.mark.parametrize(
    ("attempt", "word"),
    [
        (lambda: is_positive_definite([[1, 2], [3, 4]]), "not symmetric"),
        (lambda: is_positive_definite([[1, 2]]), "not symmetric"),
        (lambda: ExactMatrix.of([[float("nan")]]), "rational"),
        (lambda: ExactMatrix.of([["1"]]), "exact number"),
        (lambda: ExactMatrix.of(np.zeros((2, 2, 2))), "vertex"),
        (lambda: ExactMatrix.of([[1, 1], [1, 1]]).inverse(), "singular"),
        (lambda: ExactMatrix.of([[1, 1]]) + ExactMatrix.of([[1]]), "do not fit"),
        (lambda: ExactMatrix.of([[1]]) / 0, "not zero"),
    ],
)
def test_misuse_is_named(attempt, word):
    with pytest.raises(ObsynthError, match=word):
        attempt()


# -- arrays ----------------------------------------------------------------------------------------

FRACTIONS = st.lists(st.fractions(-50, 50, max_denominator=10**9), min_size=12, max_size=12)


def as_fractions(values):
    return [Fraction(int(v.p), int(v.q)) for v in exact(values).ravel()]


@PROPERTY
@given(entries=FRACTIONS)
def test_doubles_are_nearest_or_above(entries):
    values = exact(entries)
    near, high = nearest(values).tolist(), above(values).tolist()
    for value, n, h, below in zip(entries, near, high, down(above(values)), strict=True):
        assert n == float(value)
        assert Fraction(float(below)) < value <= Fraction(h)


def test_doubles_that_are_only_nearest_are_not_above(monkeypatch):
    values = exact([Fraction(k, 7) for k in range(1, 30)])
    assert all(
        Fraction(h) >= v for h, v in zip(above(values).tolist(), as_fractions(values), strict=True)
    )
    monkeypatch.setattr("obsynth.derive.rigour.rationals.smallest_above", float)
    assert any(
        Fraction(h) < v for h, v in zip(above(values).tolist(), as_fractions(values), strict=True)
    )


@PROPERTY
@given(matrix=FRACTIONS, low=FRACTIONS, width=FRACTIONS)
def test_the_image_of_a_box_is_the_smallest_box_around_it(matrix, low, width):
    M, low = exact(matrix).reshape(3, 4), exact(low[:4])
    high = low + abs(exact(width[:4]))
    bottom, top = image(M, low, high)
    corners = [M @ np.where(np.array(signs), high, low) for signs in np.ndindex(*([2] * len(low)))]
    assert (np.max(corners, axis=0) == top).all()
    assert (np.min(corners, axis=0) == bottom).all()


@PROPERTY
@given(entries=FRACTIONS)
def test_inverse_and_text_lose_nothing(entries):
    matrix = exact(entries[:9]).reshape(3, 3)
    assert (from_text(to_text(matrix), (3, 3)) == matrix).all()
    if sp.Matrix(3, 3, entries[:9]).det() != 0:
        assert (inverse(matrix) @ matrix == exact(np.eye(3))).all()
    else:
        with pytest.raises(ObsynthError, match="singular"):
            inverse(matrix)


def test_empty_arrays_keep_their_shape():
    empty = exact(np.zeros((0, 2)))
    assert inverse(exact(np.zeros((0, 0)))).shape == (0, 0)
    assert from_text(to_text(empty), (0, 2)).shape == nearest(empty).shape == (0, 2)
    assert ExactMatrix.of(np.zeros((3, 0))).to_floats().shape == (3, 0)
