"""Enclosures contain the exact result of every operation."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from obsynth.derive.rigour import Enclosure, ExactMatrix, enclosure, interval
from obsynth.symbolic.errors import ObsynthError

PROPERTY = settings(derandomize=True, max_examples=40, deadline=None)

OPERATIONS = {
    "sum": lambda a, b: a + b,
    "difference": lambda a, b: a - b,
    "product": lambda a, b: a @ b,
    "elementwise": lambda a, b: a * b,
    "number": lambda a, b: (2.0 - b[0, 0]) * a,
    "chain": lambda a, b: (a @ b - b.T) @ a.T + 0.1 * b,
    "quotient": lambda a, b: a / (b[0, 0] * b[0, 0] + np.ones((1, 1))),
}


def wide(rng, shape):
    """Doubles over many orders of magnitude, with zeros."""
    values = rng.normal(size=shape) * 10.0 ** rng.uniform(-12, 12, shape)
    return np.where(rng.random(shape) < 0.1, 0.0, values)


def inside(exact, enclosed):
    return all(
        abs(q - Fraction(m)) <= Fraction(r)
        for rows in zip(
            exact.to_fractions(), enclosed.mid.tolist(), enclosed.rad.tolist(), strict=True
        )
        for q, m, r in zip(*rows, strict=True)
    )


@pytest.mark.parametrize("name", OPERATIONS)
@PROPERTY
@given(
    seed=st.integers(0, 10**6),
    n=st.integers(1, 6),
    thick=st.sampled_from([0.0, 2.0**-30, 2.0**30]),
)
def test_the_exact_result_is_inside(name, seed, n, thick):
    """Mutant: the rounding of the radius itself left out, which radii above the middles see."""
    assume(name != "quotient" or thick < 1.0)
    rng = np.random.default_rng(seed)
    mids = [wide(rng, (n, n)) for _ in range(2)]
    rads = [np.abs(m) * thick * rng.uniform(0.1, 1.0, m.shape) for m in mids]
    operation = OPERATIONS[name]
    enclosed = operation(*(Enclosure.of(m, r) for m, r in zip(mids, rads, strict=True)))
    # Points of the operands: midpoints moved by exact fractions of the radii, ends included.
    for shift in (Fraction(0), Fraction(1), Fraction(-1), Fraction(2, 3)):
        points = [
            ExactMatrix.of(m) + shift * ExactMatrix.of(r) for m, r in zip(mids, rads, strict=True)
        ]
        assert inside(operation(*points), enclosed)


def test_without_rounding_bounds_the_exact_result_escapes(monkeypatch):
    rng = np.random.default_rng(1)
    a, b = wide(rng, (6, 6)), wide(rng, (6, 6))
    exact = ExactMatrix.of(a) @ ExactMatrix.of(b)
    assert inside(exact, Enclosure.of(a) @ Enclosure.of(b))
    monkeypatch.setattr(enclosure, "gamma_bound", lambda n: 0.0)
    monkeypatch.setattr(interval, "gamma_bound", lambda n: 0.0)
    assert not inside(exact, Enclosure.of(a) @ Enclosure.of(b))


@PROPERTY
@given(entries=st.lists(st.fractions(), min_size=6, max_size=6))
def test_an_exact_matrix_is_enclosed_by_its_nearest_doubles(entries):
    exact = ExactMatrix.of(np.array(entries, dtype=object).reshape(2, 3))
    assert inside(exact, Enclosure.of(exact))
    assert (Enclosure.of(exact).mid == exact.to_floats()).all()


def test_a_nearest_double_without_radius_is_caught(monkeypatch):
    third = ExactMatrix.of(Fraction(1, 3))
    assert Enclosure.of(ExactMatrix.of(0.5)).rad[0, 0] == 0.0
    monkeypatch.setattr(enclosure, "smallest_above", lambda value: 0.0)
    assert not inside(third, Enclosure.of(third))


def test_families_are_enclosed_member_by_member():
    rng = np.random.default_rng(2)
    a, b = rng.normal(size=(7, 3, 4)), rng.normal(size=(4, 2))
    family = Enclosure.of(a, 1e-9) @ b
    for k in range(7):
        single = Enclosure.of(a[k], 1e-9) @ b
        assert np.allclose(family.mid[k], single.mid, rtol=1e-15, atol=1e-18)
        assert np.allclose(family.rad[k], single.rad, rtol=1e-12)
    assert family.member(3).shape == (3, 2)


def test_enclosures_refuse_what_has_no_meaning():
    with pytest.raises(ObsynthError, match="negative"):
        Enclosure.of(np.eye(2), -1.0)
    with pytest.raises(ObsynthError, match="zero"):
        Enclosure.of(np.eye(2)) / Enclosure.of([[0.1]], 0.2)
    with pytest.raises(ObsynthError, match="do not fit"):
        Enclosure.of(np.eye(2)) + Enclosure.of([[1.0]])
    with pytest.raises(ObsynthError, match="shape"):
        Enclosure.of(np.zeros(3))


def test_underflow_is_enclosed():
    tiny = Enclosure.of([[2.0**-600]])
    assert inside(ExactMatrix.of([[2.0**-600]]) @ ExactMatrix.of([[2.0**-600]]), tiny @ tiny)
    assert inside(ExactMatrix.of([[2.0**-600]]) * ExactMatrix.of([[2.0**-600]]), tiny * tiny)


def test_a_combination_of_directions_contains_the_exact_one():
    rng = np.random.default_rng(3)
    centre, directions = wide(rng, (3, 3)), wide(rng, (4, 3, 3))
    weights = np.sign(rng.normal(size=(8, 4))) * np.array([1.0, 0.1, 3.0, 0.7])
    family = Enclosure.combine(Enclosure.of(centre, 1e-9), Enclosure.of(directions, 1e-10), weights)
    assert family.rad.strides[0] == 0
    for k in range(8):
        for end in (-1, 1):
            exact = ExactMatrix.of(centre) + end * ExactMatrix.of(np.full((3, 3), 1e-9))
            for weight, direction in zip(weights[k], directions, strict=True):
                radius = ExactMatrix.of(np.full((3, 3), 1e-10)) * float(end * np.sign(weight))
                exact = exact + float(weight) * (ExactMatrix.of(direction) + radius)
            assert inside(exact, family.member(k))
