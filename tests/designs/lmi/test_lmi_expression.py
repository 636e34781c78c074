"""Affine expressions against NumPy, and one formula in all arithmetics."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from obsynth.derive.rigour import Enclosure, ExactMatrix
from obsynth.designs.lmi.expression import (
    ExpressionError,
    constant,
    diagonal,
    full,
    scalar,
    symmetric,
    trace,
)
from obsynth.designs.lmi.problem import Problem, block, he, symmetric_block

PROPERTY = settings(derandomize=True, max_examples=25, deadline=None)


def draw(seed, members):
    """Data and values for the formula below; families where members is given."""
    rng = np.random.default_rng(seed)
    lead = () if members is None else (members,)
    root = rng.normal(size=(3, 3))
    return {
        "A": rng.normal(size=(3, 3)),
        "M": rng.normal(size=(*lead, 3, 3)),
        "C": rng.normal(size=(2, 3)),
        "P": root + root.T,
        "H": rng.normal(size=(3, 2)),
        "T": np.diag(rng.normal(size=2)),
        "g": rng.normal(size=(1, 1)),
    }


def within(exact, enclosed, share):
    """Whether the exact entries lie within a share of the radius."""
    rows = zip(exact.to_fractions(), enclosed.mid.tolist(), enclosed.rad.tolist(), strict=True)
    return all(
        abs(q - Fraction(m)) <= share * Fraction(r)
        for row in rows
        for q, m, r in zip(*row, strict=True)
    )


def variables():
    return {
        "P": symmetric("P", 3),
        "H": full("H", 3, 2),
        "T": diagonal("T", 2),
        "g": scalar("g"),
    }


@PROPERTY
@given(seed=st.integers(0, 10**6), members=st.sampled_from([None, 1, 4]))
def test_an_expression_has_the_value_numpy_computes(seed, members):
    data = draw(seed, members)
    # A number plus a matrix is refused by expressions, so the identity stands for it here.
    values = {name: data[name] for name in "PHTg"}

    def version(P, H, T, g):
        X = P @ (data["A"] + data["M"]) - H @ data["C"]
        corner = (1 - g) * np.eye(3) + P - he(X) / 2.0
        side = 3.0 * (data["C"] @ X) + T @ data["C"]
        side = side - (H[:, [0]] @ data["C"][:1, :])[1:, :]
        return symmetric_block([[corner], [side, 2 * np.eye(2) - T], [0, T[[1], :], -g]])

    expression = version(**variables())
    expected = version(**values)
    value = expression.value(values)
    assert value.shape == expected.shape
    assert np.abs(value - expected).max() < 1e-13 * np.abs(expected).max()
    again = expression.T.value(values)
    assert np.array_equal(again, np.swapaxes(value, -1, -2))


@PROPERTY
@given(seed=st.integers(0, 10**6))
def test_the_exact_value_of_a_formula_lies_in_its_enclosure(seed):
    data = draw(seed, None)

    def version(P, H, T, A, M, C):
        X = P @ (A + M) - H @ C
        return symmetric_block([[P * 0.1 - he(X)], [3 * (C @ X) + T @ C / 3.0, T]])

    names = ("P", "H", "T", "A", "M", "C")
    enclosed = version(**{name: Enclosure.of(data[name]) for name in names})
    exact = version(**{name: ExactMatrix.of(data[name]) for name in names})
    plain = version(**{name: data[name] for name in names})
    assert enclosed.contains(plain)
    assert within(exact, enclosed, Fraction(1))
    assert enclosed.rad.max() < 1e-14 * np.abs(enclosed.mid).max()
    # A radius a thousand times smaller would be a false statement.
    assert not within(exact, enclosed, Fraction(1, 1000))


def test_members_of_a_family_are_its_single_expressions():
    data = draw(3, 5)
    P = symmetric("P", 3)
    family = he(P @ data["M"])
    for k in range(5):
        single = he(P @ data["M"][k])
        assert np.array_equal(
            family.member(k).value({"P": data["P"]}), single.value({"P": data["P"]})
        )
    assert family.member(np.array([4, 0])).members == 2


def test_trace_and_elementwise_products():
    data = draw(4, 5)
    P = symmetric("P", 3)
    assert np.allclose(
        trace(P @ data["M"]).value(data)[:, 0, 0],
        np.trace(data["P"] @ data["M"], axis1=1, axis2=2),
        rtol=1e-13,
    )
    weights = np.arange(1.0, 6.0).reshape(5, 1, 1)
    assert np.allclose((P * weights).value(data), data["P"] * weights, rtol=1e-15)
    assert np.allclose((scalar("g") * data["A"]).value(data), data["g"] * data["A"], rtol=1e-15)


@pytest.mark.parametrize(
    ("attempt", "word"),
    [
        (lambda P: P @ P, "product of variables"),
        (lambda P: P * P, "product of variables"),
        (lambda P: P + 1.0, "identity"),
        (lambda P: P + np.eye(2), "do not fit"),
        (lambda P: P @ np.ones((2, 2)), "columns meet"),
        (lambda P: P @ np.ones(3), "column"),
        (lambda P: block([[P, 0], [0, 0]]), "only zeros"),
        (lambda P: block([[P, np.ones((2, 2))]]), "sizes"),
        (lambda P: block([[P, Enclosure.of(np.eye(3))]]), "different arithmetics"),
        (lambda P: symmetric_block([[P], [P]]), "lower triangle"),
        (lambda P: symmetric("", 3), "name"),
    ],
)
def test_what_is_not_affine_or_does_not_fit_is_refused(attempt, word):
    with pytest.raises(ExpressionError, match=word):
        attempt(symmetric("P", 3))


def test_one_name_means_one_variable():
    problem = Problem("names")
    problem.add("first", symmetric("P", 3) >> 0)
    with pytest.raises(ExpressionError, match="'P'") as caught:
        problem.add("second", full("P", 2, 2) >= 0)
    assert caught.value.variable == "P"
    with pytest.raises(ExpressionError, match="two blocks"):
        problem.add("first", symmetric("P", 3) << 1e3 * np.eye(3))


def test_a_product_with_a_constant_expression_is_affine():
    P = symmetric("P", 3)
    A = constant(draw(5, None)["A"])
    assert np.allclose((A @ P).value({"P": np.eye(3)}), A.constant, rtol=1e-15)


def test_blocks_of_exact_matrices_are_exact():
    a = ExactMatrix.of([[1, 2], [3, 5]])
    assert block([[a, 0], [0, ExactMatrix.of(7)]]).to_fractions() == [
        [1, 2, 0],
        [3, 5, 0],
        [0, 0, 7],
    ]
