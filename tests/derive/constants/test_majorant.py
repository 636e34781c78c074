"""Diagonal majorants of the H-infinity paper, and why its (11) fails."""

import dataclasses
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
import sympy as sp

from obsynth.derive import Status, split
from obsynth.derive.constants import majorant as module
from obsynth.derive.constants.eigenvalue_search import Maximum
from obsynth.derive.constants.majorant import largest_together, majorant, scaled
from obsynth.derive.errors import DerivationError, UnboundedError
from obsynth.derive.jacobian.entries import matrix_entries
from obsynth.derive.rigour import UNIT_ROUNDOFF
from obsynth.derive.rigour.interval import smallest_above
from obsynth.symbolic import Plant, plants


def hinf_split(variant="consistent"):
    return split(plants.hinf_example(variant), at=(np.zeros(3), np.zeros(1)), linear="terms")


def jacobians(parts, count=4000, seed=0):
    """Jacobians of g at random points, corners and zeros of the box."""
    model = parts.model
    box = np.vstack([model.box("x"), model.box("u")])
    rng = np.random.default_rng(seed)
    share = rng.random((count, len(box)))
    share[: count // 4] = np.round(share[: count // 4])
    points = box[:, 0] + share * (box[:, 1] - box[:, 0])
    points[-count // 4 :, :] *= rng.integers(0, 2, (count // 4, len(box)))
    points = np.clip(points, box[:, 0], box[:, 1])
    g = parts.g_function()
    arguments = g.sx_in()
    slope = ca.densify(ca.jacobian(g(*arguments), arguments[0]))
    n = len(model.x)
    function = ca.Function("J", arguments, [ca.vec(slope.T)])
    values = np.array(function(points[:, :n].T, points[:, n:].T)).T
    return values.reshape(count, n, n)


def excess(parts, found, J):
    """Largest eigenvalue of J'J - M'M, allowed to be the rounding of A that g takes up."""
    J = np.where(found.entry_bounds > 0.0, J, 0.0)
    return float(np.linalg.eigvalsh(J.transpose(0, 2, 1) @ J - found.matrix).max())


# -- the paper's example ---------------------------------------------------------------------------


def test_consistent_variant_is_equation_52():
    found = majorant(hinf_split())
    np.testing.assert_allclose(found.diagonal, [0.0, 0.51663779, 0.1089], rtol=0, atol=5e-9)
    assert found.diagonal[0] == 0.0
    assert found.diagonal[1] >= 0.5166377886
    assert found.status is not Status.BUDGET
    bounds = found.entry_bounds
    np.testing.assert_allclose([bounds[0, 1], bounds[2, 2]], [0.7187752004, 0.33], rtol=1e-6)


def test_attained_value_of_the_consistent_variant():
    found = majorant(hinf_split())
    (x2,) = found.groups[0][2].at.values()
    a = -7.2 * np.sin(12 * x2) / (x2**2 + 10) - 1.2 * np.cos(12 * x2) * x2 / (x2**2 + 10) ** 2
    assert a**2 == pytest.approx(found.diagonal[1], rel=1e-8)
    assert a**2 <= found.diagonal[1]


@pytest.mark.long
@pytest.mark.parametrize("d2", [10.0, 1.0, 0.1])
def test_printed_variant_is_a_family(d2):
    """sup a^2 / d1 + b^2 / d2 <= 1; the note's .51841 is .5184 rounded up."""
    parts = hinf_split("as_printed")
    found = majorant(parts, fixed={"x2": d2})
    assert found.diagonal[1] == d2
    assert 0.5184 <= found.diagonal[0] <= 0.51841
    assert found.diagonal[2] == pytest.approx(0.1089, rel=1e-12)
    J = jacobians(parts)
    assert (J[:, 0, 0] ** 2 / found.diagonal[0] + J[:, 0, 1] ** 2 / d2).max() <= 1.0
    assert excess(parts, found, J) <= 1e-15


def test_printed_variant_without_a_wish():
    parts = hinf_split("as_printed")
    found = majorant(parts)
    assert found.diagonal[0] == pytest.approx(0.5184, rel=1e-7)
    assert 0.0123237576**2 < found.diagonal[1] < 0.01
    bounds = found.entry_bounds
    np.testing.assert_allclose(bounds[0, :2], [0.72, 0.0123237576], rtol=1e-6)
    assert excess(parts, found, jacobians(parts)) <= 1e-15


@pytest.mark.parametrize(
    ("variant", "gamma2"), [("consistent", 0.51663779), ("as_printed", 0.5184)]
)
def test_scalar_majorant_is_equation_14(variant, gamma2):
    found = majorant(hinf_split(variant), shape="scalar")
    np.testing.assert_allclose(found.diagonal, gamma2, rtol=1e-8)


def test_rounding_of_A_is_told_and_kept_out():
    found = majorant(hinf_split())
    assert 0.0 < found.rounding.max() < 1e-15
    assert not found.rounding[found.entry_bounds > 0.0].any()


@pytest.mark.parametrize("shape", ["diagonal", "scalar"])
def test_rounding_of_A_is_told_where_nothing_else_is_left(shape):
    """Mutant: the rounding forgotten where g has no other row."""
    plant = Plant("third")
    (x,) = plant.states("x", range=(-1, 1))
    plant.dynamics([x / 3], Ts=1)
    plant.outputs([x])
    found = majorant(split(plant, linear="terms"), shape=shape)
    assert found.diagonal.tolist() == [0.0]
    lost = abs(Fraction(1, 3) - Fraction(1 / 3))
    assert lost <= Fraction(found.rounding[0, 0]) <= lost * (1 + Fraction(1, 2**40))


# -- why (11) fails --------------------------------------------------------------------------------


def violation(M, row):
    """(M_x e)^2 - (M e)^2 on the direction that M does not see, for one-row matrices."""
    e = np.array([M[1], -M[0]]) if M.any() else np.array([1.0, 0.0])
    return float((row @ e) ** 2 - (M @ e) ** 2)


def test_no_matrix_within_the_bounds_majorises_a_row():
    rng = np.random.default_rng(0)
    corners = np.array([[1.0, 1.0], [1.0, -1.0]])
    for M in [np.array([1.0, 1.0]), *rng.uniform(-1, 1, (500, 2))]:
        assert max(violation(M, row) for row in corners) > 0.0
    assert violation(np.array([1.0, 1.0]), corners[1]) == 4.0


@pytest.mark.long
def test_the_paper_s_own_printed_example_is_such_a_row():
    """With the bounds of dg1/dx1 and dg1/dx2, no M of (11) holds for the Jacobians that occur."""
    parts = hinf_split("as_printed")
    rows = jacobians(parts)[:, 0, :2]
    r = majorant(parts).entry_bounds[0, :2]
    rng = np.random.default_rng(1)
    for M in [r, r * [1, -1], *rng.uniform(-1, 1, (200, 2)) * r]:
        assert max(violation(M, row) for row in rows) > 0.0


# -- other functions -------------------------------------------------------------------------------


def test_rows_that_share_states_are_scaled_together(parts):
    found = majorant(parts)
    assert [group[:2] for group in found.groups] == [((0, 2), (0, 2)), ((1, 3), (1, 3))]
    J = jacobians(parts)
    assert excess(parts, found, J) <= 1e-15
    total = np.sum([row.diagonal for row in found.rows], axis=0)
    assert (found.diagonal <= total * (1 + 1e-12)).all()
    for _, _, largest in found.groups:
        assert largest.upper <= 1.0
        assert largest.attained >= 1.0 - 1e-8


@pytest.mark.parametrize("share", [0.999, 0.9])
def test_a_smaller_diagonal_is_refuted(parts, share):
    found = majorant(parts)
    smaller = dataclasses.replace(found, diagonal=share * found.diagonal)
    assert excess(parts, smaller, jacobians(parts)) > 1e-9


def test_every_row_has_a_majorant_of_its_own(parts):
    J = jacobians(parts)
    for row in majorant(parts).rows:
        used = row.diagonal > 0.0
        sums = (J[:, row.row, used] ** 2 / row.diagonal[used]).sum(axis=1)
        assert sums.max() <= 1.0 + 1e-14
        assert sums.max() >= 1.0 - 1e-9
        np.testing.assert_array_less(
            np.abs(J[:, row.row, :]).max(axis=0) - 1e-15, row.entries + 1e-15
        )


def test_lorenz_rows():
    parts = split(plants.lorenz(), at=(np.zeros(3), []), linear="terms")
    found = majorant(parts)
    assert excess(parts, found, jacobians(parts)) <= 1e-9
    fixed = majorant(parts, fixed={"x": 6000.0})
    assert fixed.diagonal[0] == 6000.0
    assert excess(parts, fixed, jacobians(parts)) <= 1e-9


def test_one_column_in_two_rows_adds_the_squares():
    plant = Plant("column")
    (x, y) = plant.states("x y", range=(-1, 1))
    plant.dynamics([sp.sin(x), sp.cos(x) + y / 2], Ts=1)
    plant.outputs([x])
    found = majorant(split(plant, at=(np.zeros(2), []), linear="terms"))
    # cos^2 + sin^2 = 1, although both derivatives reach 1 and sin(1)
    np.testing.assert_allclose(found.diagonal, [1.0, 0.0], rtol=1e-8)


def test_without_a_nonlinearity_there_is_nothing_to_majorise():
    plant = Plant("linear")
    (x,) = plant.states("x", range=(-1, 1))
    plant.dynamics([x / 2], Ts=1)
    plant.outputs([x])
    found = majorant(split(plant, linear="terms"))
    assert found.diagonal.tolist() == [0.0]
    assert found.rows == found.groups == ()


# -- refusals and reading --------------------------------------------------------------------------


def test_fixed_elements_that_are_too_small_are_refused_with_the_factor():
    with pytest.raises(DerivationError, match="too small for the row of x1") as caught:
        majorant(hinf_split("as_printed"), fixed={"x2": 1e-5})
    assert caught.value.symbols == ("x2",)
    assert caught.value.factor == pytest.approx(0.0123237576**2 / 1e-5, rel=1e-6)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"fixed": {"x9": 1.0}}, "x9"),
        ({"fixed": {"x2": -1.0}}, "positive"),
        ({"fixed": {"x2": 1.0}, "shape": "scalar"}, "scalar"),
        ({"shape": "round"}, "round"),
    ],
)
def test_options_that_make_no_sense(options, text):
    with pytest.raises(DerivationError, match=text):
        majorant(hinf_split(), **options)


def test_majorant_can_be_read():
    found = majorant(hinf_split())
    assert "diag(0, 0.51663779, 0.1089)" in str(found)
    assert "x2 = " in str(found)
    assert "<table>" in found._repr_html_()


# -- entries that vanish all over the box, slopes of any size --------------------------------------

SATURATED = "min(1/2, max(-1/2, x))"


def two_states(rows):
    plant = Plant("two")
    x, _ = plant.states("x y", range=[(1, 2), (-1, 1)])
    plant.dynamics(rows)
    plant.outputs([x])
    return split(plant, linear="terms", at=((1, 0), ()))


@pytest.mark.parametrize("options", [{}, {"shape": "scalar"}, {"fixed": {"y": 20.0}}])
@pytest.mark.parametrize(
    "rows",
    [
        (f"{SATURATED} + y**2", "-y"),
        (f"{SATURATED} + y**2", "x*y"),
        (f"{SATURATED} + y**2", f"{SATURATED} + y**3"),
        (f"{SATURATED} + 1e-200*y**2", "-y"),
    ],
    ids=["alone", "shared column", "two rows", "tiny"],
)
def test_an_entry_that_is_zero_all_over_the_box_weighs_nothing(rows, options):
    """The saturation never moves for x in [1, 2].

    Mutants: majorant without ``entries.take``; row_majorant without ``unit``.
    """
    parts = two_states(rows)
    found = majorant(parts, **options)
    assert np.isfinite(found.diagonal).all()
    J = jacobians(parts)
    assert np.linalg.eigvalsh(J.transpose(0, 2, 1) @ J - found.matrix).max() <= 1e-12
    if not options:
        assert (found.diagonal[0] == 0.0) == ("x*y" not in rows[1])
        tight = 4.0e-400 if "1e-200" in rows[0] else 4.0
        assert found.diagonal[1] >= tight
        assert found.diagonal[1] <= (1e-300 if tight < 1.0 else 14.0)


def test_a_majorant_that_is_no_double_is_refused():
    """Mutant: majorant without the look at its own diagonal."""
    with pytest.raises(UnboundedError, match="no finite element for y"):
        majorant(two_states(("1e170*y**2", "-y")))


def rows_that_share():
    plant = Plant("rows that share a state")
    x, z = plant.states("x z", range=(-1, 1))
    plant.dynamics([x / 2 + sp.sin(3 * x) / 10, sp.sin(4 * x) / 10 + sp.sin(2 * z) / 10], Ts=1)
    plant.outputs([x])
    return split(plant, at=(np.zeros(2), np.zeros(0)), linear="terms")


def test_a_diagonal_for_rows_that_share_states_is_held_against_them_together():
    """gamma^2 I of a Lipschitz constant is a majorant, also where no row may have an equal share.

    Mutants: shares of the rows alone (refuses .282); a sum of rows that is not looked at.
    """
    parts = rows_that_share()
    # at x = z = 0 the Jacobian is [.3, 0; .4, .2]
    gamma2 = float(np.linalg.svd(np.array([[0.3, 0.0], [0.4, 0.2]]))[1][0] ** 2)
    enough = {"x": gamma2 * (1 + 1e-5), "z": gamma2 * (1 + 1e-5)}
    found = majorant(parts, fixed=enough)
    assert found.diagonal.tolist() == list(enough.values())
    with pytest.raises(DerivationError, match="are too small for the rows of x, z") as refusal:
        majorant(parts, fixed={"x": 0.99 * gamma2, "z": 0.99 * gamma2})
    assert refusal.value.factor == pytest.approx(1 / 0.99, rel=1e-4)


# -- rounding, in exact numbers --------------------------------------------------------------------


def test_a_scaled_maximum_holds_the_exact_product():
    """Mutant: without UP the product may round inwards."""
    rng = np.random.default_rng(0)
    for upper, share, factor in rng.uniform(0.1, 1.0, (300, 3)):
        value = upper * share
        found = scaled(Maximum(upper, value, {}, Status.CONVERGED, "given"), factor)
        assert Fraction(found.upper) >= Fraction(upper) * Fraction(factor)
        assert Fraction(found.attained) <= Fraction(value) * Fraction(factor)
        assert found.upper <= 1.0


def test_the_root_of_the_diagonal_is_not_lost(monkeypatch):
    """(slope / root of d)^2 with the root rounded, against slope^2 / d.

    Mutants: norm.upper^2 without UP, attained^2 without UP.
    """

    def tight(chosen, *_):
        (value,) = chosen.exact.values()
        norm = Fraction(*map(int, value.subs(x, 1).as_numer_denom()))
        above = smallest_above(norm)
        return Maximum(above, np.nextafter(above, 0.0), {}, Status.EXACT, "given")

    plant = Plant("parabola")
    (x,) = plant.states("x", range=(-1, 1))
    plant.dynamics([x**2], Ts=1)
    plant.outputs([x])
    monkeypatch.setattr(module, "matrix_maximum", tight)
    for d in np.random.default_rng(0).uniform(0.5, 40.0, 100):
        entries = matrix_entries({(0, 0): 2 * x}, plant)
        found = largest_together(entries, np.full((1, 1), 2.0), (0,), np.array([d]), 1e-6, "fast")
        assert Fraction(found.attained) <= 4 / Fraction(d) <= Fraction(found.upper)
        assert found.gap <= 40 * UNIT_ROUNDOFF * found.upper


def test_the_sum_over_the_diagonal_is_at_most_one_exactly():
    """Mutant: UP = 1 - 2^-44."""
    rng = np.random.default_rng(0)
    for _ in range(4):
        a, b = (sp.Rational(int(k), 7) for k in rng.integers(1, 99, 2))
        r, s = (float(v) for v in rng.uniform(0.1, 5.0, 2))
        plant = Plant("bowl")
        x, y = plant.states("x y", range=[(-r, r), (-s, s)])
        plant.dynamics([a * x**2 / 2 + b * y**2 / 2, sp.S(0)], Ts=1)
        plant.outputs([x])
        found = majorant(split(plant, linear="terms", at=((0, 0), ())))
        R = [Fraction(d) for d in found.diagonal]
        total = (Fraction(a.p, a.q) * Fraction(r)) ** 2 / R[0]
        total += (Fraction(b.p, b.q) * Fraction(s)) ** 2 / R[1]
        assert 1 - Fraction(1e-6) <= total <= 1
        assert Fraction(found.groups[0][2].attained) <= total
