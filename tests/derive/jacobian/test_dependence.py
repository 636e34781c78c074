"""Affine dependences and families: found, proved, and never claimed without proof."""

from dataclasses import replace
from fractions import Fraction
from itertools import product

import numpy as np
import pytest
import sympy as sp
from members import belongs

from obsynth.derive import DerivationError, jacobian_bounds, split
from obsynth.derive.jacobian import family
from obsynth.derive.jacobian.family import (
    AffineDependence,
    AffineFamily,
    build_family,
    find_dependences,
)
from obsynth.symbolic import Plant
from obsynth.symbolic.plants import lorenz

x, y = sp.symbols("x y", real=True)
POINTS = np.random.default_rng(0).random((2, 60)) + 0.5


def found(entries):
    """Basis and dependences of scalar expressions in x and y, in one row."""
    named = {(0, k): sp.sympify(e) for k, e in enumerate(entries)}
    samples = {
        place: np.array([float(e.evalf(17, subs={x: a, y: b})) for a, b in POINTS.T])
        for place, e in named.items()
    }
    basis, dependences = find_dependences(named, samples, [x, y])
    return [j for _, j in basis], {d.entry[1]: d for d in dependences}


def test_scaled_and_shifted_copies():
    basis, others = found([sp.sqrt(x), 3 - sp.sqrt(2) * sp.sqrt(x), sp.sqrt(x) / 7])
    assert basis == [0]
    assert others[1].coefficients == {(0, 0): -sp.sqrt(2)}
    assert others[1].constant == 3
    assert others[2].coefficients == {(0, 0): sp.Rational(1, 7)}


def test_combination_of_two_entries():
    basis, others = found([sp.sin(x), sp.exp(y), 2 * sp.sin(x) - sp.exp(y) + 1])
    assert basis == [0, 1]
    assert others[2].coefficients == {(0, 0): 2, (0, 1): -1}
    assert str(others[2]).startswith("m13 = 2 m11 - m12 + 1")


def test_equal_in_disguise():
    basis, others = found([sp.sin(x) ** 2, 3 - 2 * sp.cos(x) ** 2])
    assert basis == [0]
    assert others[1].coefficients == {(0, 0): 2}
    assert others[1].constant == 1
    assert others[1].proof == "simplify"


def test_nearly_dependent_is_not_dependent():
    tiny = sp.Rational(1, 10**6)
    basis, others = found([sp.sin(x), sp.sin(x) + tiny * x**2])
    assert basis == [0, 1]
    assert not others


def test_numerically_dependent_needs_a_proof():
    """A difference of 1e-12 passes the rank test; the exact test refuses it."""
    tiny = sp.Rational(1, 10**12)
    basis, others = found([sp.sin(x), sp.sin(x) + tiny * x**2])
    assert basis == [0, 1]
    assert not others


def test_constant_entries_are_constants():
    basis, others = found([sp.Rational(1, 3), x * y])
    assert basis == [1]
    assert others[0].coefficients == {}
    assert str(others[0]).startswith("m11 = 0.333333: constant")


def test_fewer_variables_go_first():
    basis, _ = found([sp.sin(x) + sp.cos(y), sp.sin(x), sp.cos(y)])
    assert basis == [1, 2]


# -- families --------------------------------------------------------------------------------------


def test_rounded_coefficients_are_paid_for_by_the_radius():
    named = {(0, 0): sp.sin(x), (0, 1): sp.sin(x) * sp.sqrt(2) / 3 + sp.Rational(1, 10)}
    samples = {k: np.array([float(e.subs(x, v)) for v in POINTS[0]]) for k, e in named.items()}
    basis, dependences = find_dependences(named, samples, [x])
    family = build_family((1, 2), basis, dependences, {(0, 0): (-1.0, 1.0)}, {(0, 0): ("x",)})
    assert 0.0 < family.radius[0, 1] < 5e-16
    assert family.radius[0, 0] == 0.0
    for s in (-1.0, -0.3, 0.7, 1.0):
        exact = sp.Rational(s) * sp.sqrt(2) / 3 + sp.Rational(1, 10)
        error = abs(exact - sp.Rational(float(family.at([s])[0, 1])))
        assert error <= sp.Rational(float(family.radius[0, 1]))


@pytest.mark.parametrize("terms", [0, 1, 2, 5])
def test_the_radius_holds_rounded_coefficients_and_rounded_vertices(terms):
    """In exact numbers at every vertex, many times.

    Mutants: the rounding of the constant or of the sum left out; one rounding per term; terms that
    do not count.
    """
    rng = np.random.default_rng(terms)
    basis = [(0, k) for k in range(terms)]
    for _ in range(60):
        c = {e: sp.Rational(int(rng.integers(-99, 99)), 7) for e in basis}
        ranges = {e: tuple(sorted(rng.normal(size=2) * 10.0 ** rng.integers(-3, 3))) for e in basis}
        constant = sp.Rational(int(rng.integers(-99, 99)), 13)
        last = AffineDependence((0, terms), c, constant, "given", ("x",))
        family = build_family((1, terms + 1), basis, [last], ranges, dict.fromkeys(basis, ("x",)))
        allowed = Fraction(family.radius[0, terms])
        for corner, vertex in zip(product(*ranges.values()), family.vertices(), strict=True):
            value = Fraction(constant.p, constant.q)
            for v, s in zip(c.values(), corner, strict=True):
                value += Fraction(v.p, v.q) * Fraction(s)
            error = abs(value - Fraction(vertex[0, terms]))
            assert error <= allowed


def test_a_coefficient_between_two_doubles_is_paid_for_beside_product_and_sum():
    """Coefficient, product and sum each lose almost half a unit to the same side.

    Mutant: the distance of the coefficient from its double left out.
    """
    unit = sp.Rational(1, 2**52)
    coefficient = 1 + sp.Rational(7, 2**28) + unit * sp.Rational(99, 200)
    s, constant = 1.0 + 2.0**-28, unit * sp.Rational(125, 256)
    last = AffineDependence((0, 1), {(0, 0): coefficient}, constant, "given", ("x",))
    family = build_family((1, 2), [(0, 0)], [last], {(0, 0): (0.5 * s, s)}, {(0, 0): ("x",)})
    exact = coefficient * sp.Rational(2**28 + 1, 2**28) + constant
    error = Fraction(exact.p, exact.q) - Fraction(family.vertices()[1, 0, 1])
    assert Fraction(1.4 * 2.0**-52) < error <= Fraction(family.radius[0, 1])


def family_of(ranges, exact=True):
    K = len(ranges)
    directions = np.zeros((K, 1, K))
    for k in range(K):
        directions[k, 0, k] = 1.0
    zero = np.zeros((1, K))
    return AffineFamily(zero, directions, np.array(ranges, dtype=float), zero, ("s",) * K, exact)


def test_scalars_without_width_make_no_vertices():
    family = family_of([(0, 1), (2, 2), (3, 4)])
    assert family.vertex_count == 4
    np.testing.assert_array_equal(
        family.vertices()[:, 0], [[0, 2, 3], [0, 2, 4], [1, 2, 3], [1, 2, 4]]
    )


def test_too_many_vertices_are_refused():
    with pytest.raises(DerivationError, match="131072 vertices"):
        family_of([(0, 1)] * 17).vertices()


def test_membership():
    family = family_of([(0, 1), (2, 3)])
    assert belongs(family, np.array([[0.5, 2.5]]))
    assert not belongs(family, np.array([[0.5, 3.5]]))


# -- from plants -----------------------------------------------------------------------------------


def coupled(shared):
    plant = Plant("coupled")
    a, b = plant.states("a b", range=(0.5, 1.5))
    plant.dynamics([a * b if shared else a**2, b**3 + (a**2 / 3 if not shared else 0)])
    plant.outputs([a, b])
    return plant


def test_entries_that_share_variables_give_an_outer_box():
    found = jacobian_bounds(coupled(shared=True))
    # b, a and 3 b^2: the first and the last depend on b both, and not affinely
    assert len(found.family.ranges) == 3
    assert not found.family.exact
    assert "outer" in str(found)


def test_disjoint_variables_are_exact():
    found = jacobian_bounds(coupled(shared=False))
    assert len(found.family.ranges) == 2
    assert found.family.exact
    assert str(found.dependences[0]).startswith("m21 = 0.333333 m11")


def test_uncertain_parameters_are_variables_of_the_box():
    plant = Plant("p")
    (a,) = plant.states("a", range=(1, 2))
    plant.inputs("u", nominal=0)
    (p,) = plant.params("p", range=(3, 4))
    plant.dynamics([-p * a**2])
    plant.outputs([a])
    found = jacobian_bounds(plant)
    assert found.variables == ("a", "p")
    assert (found.min[0, 0], found.max[0, 0]) == pytest.approx((-16.0, -6.0), rel=1e-14)
    np.testing.assert_array_equal(found.attained_at[0, 0], [[2.0, 4.0], [1.0, 3.0]])


def test_inputs_and_whole_plants(model, parts):
    by_input = jacobian_bounds(parts, wrt="inputs")
    # B is constant, and g takes up its rounding
    assert np.abs(by_input.max).max() < 1e-17
    assert by_input.vertices().shape == (1, 4, 2)
    whole = jacobian_bounds(model)
    difference = whole.min - jacobian_bounds(parts).min
    np.testing.assert_allclose(difference, parts.A, atol=1e-15)
    assert not any(name in whole.variables for name in ("d", "f1", "w1"))


def test_bounds_of_a_fault_that_scales_a_state():
    plant = Plant("leak")
    (h,) = plant.states("h", range=(1, 4))
    plant.inputs("u", nominal=0)
    (leak,) = plant.process_faults("leak", range=(0, 0.5))
    plant.dynamics([-(1 + leak) * sp.sqrt(h)])
    plant.outputs([h])
    found = jacobian_bounds(plant)
    assert found.variables == ("h", "leak")
    assert found.min[0, 0] == pytest.approx(-0.75, rel=1e-15)


def test_rational_constants_enter_as_they_are():
    """A third of x is not fl(1/3) x; the bounds hold the exact slope."""
    plant = Plant("third")
    (a,) = plant.states("a", range=(-1, 1))
    plant.inputs("u", nominal=0)
    (c,) = plant.params("c", sp.Rational(1, 3))
    plant.dynamics([-c * a + a**2 / 2])
    plant.outputs([a])
    found = jacobian_bounds(split(plant, at=([0], [0]), linear="terms"))
    exact_low = sp.Integer(-1) - sp.Rational(1, 3) - sp.Rational(float(-1 / 3))
    assert sp.Rational(float(found.min[0, 0])) <= exact_low
    assert found.min[0, 0] >= -1.0 - 1e-15


@pytest.mark.parametrize("options", [{"wrt": "outputs"}, {"effort": "all"}, {"rtol": 2.0}])
def test_unknown_options_are_refused(parts, options):
    with pytest.raises(DerivationError):
        jacobian_bounds(parts, **options)


def test_display_is_a_table(bounds):
    assert ">m33</td>" in bounds._repr_html_()
    assert "16 vertices (exact) in place of 64" in bounds._repr_html_()
    assert "16 vertices (exact)" in str(bounds)
    assert "in place of 64" in str(bounds)


def test_numbers_between_two_doubles_do_not_vary():
    found = jacobian_bounds(lorenz())
    assert found.min[2, 2] < found.max[2, 2]
    assert int(found.varying.sum()) == 4
    assert str(found).startswith("4 varying entries, 8 vertices (exact) in place of 16")
    assert "m33" not in str(found)
    assert "m33" not in found._repr_html_()


def test_constants_left_by_rounding_are_not_written_as_terms(bounds):
    texts = [str(d) for d in bounds.dependences]
    assert any(d.constant != 0 for d in bounds.dependences)
    assert not any("e-17:" in text.split("up to")[0] for text in texts)
    assert any(text.startswith("m13 = -m33 up to ") for text in texts)
    assert str(AffineDependence((0, 0), {(1, 1): sp.Integer(2)}, sp.Float(1e-9), "", ("x",))) == (
        "m11 = 2 m22 + 1e-09: both depend on x only; difference proved zero ()"
    )


def test_a_family_covers_one_with_narrower_ranges_and_no_other():
    family = AffineFamily(
        np.eye(2), np.ones((1, 2, 2)), np.array([[0.0, 1.0]]), np.zeros((2, 2)), ("s",), True
    )
    assert family.covers(family)
    assert family.covers(replace(family, ranges=np.array([[0.25, 0.5]])))
    for mistake in (
        {"ranges": np.array([[0.0, np.nextafter(1.0, 2.0)]])},
        {"ranges": np.array([[-1e-300, 1.0]])},
        {"radius": np.full((2, 2), 1e-300)},
        {"constant": np.zeros((2, 2))},
        {"directions": 2 * np.ones((1, 2, 2))},
        {"directions": np.ones((2, 2, 2)), "ranges": np.array([[0.0, 1.0]] * 2)},
    ):
        assert not family.covers(replace(family, **mistake)), mistake


def test_every_scalar_of_a_family_has_to_be_covered():
    """Mutants: one lower end, one upper end or one entry of the radius is enough."""
    family = AffineFamily(
        np.zeros((1, 2)),
        np.array([[[1.0, 0.0]], [[0.0, 1.0]]]),
        np.array([[0.0, 1.0]] * 2),
        np.zeros((1, 2)),
        ("s", "t"),
        True,
    )
    for row in (0, 1):
        for end, value in ((0, -0.5), (1, 1.5)):
            ranges = family.ranges.copy()
            ranges[row, end] = value
            assert not family.covers(replace(family, ranges=ranges))
        radius = np.zeros((1, 2))
        radius[0, row] = 1e-9
        assert not family.covers(replace(family, radius=radius))


def test_the_room_of_a_family_counts_both_ends():
    """Mutant: lower ends alone."""
    family = AffineFamily(
        constant=np.zeros((1, 1)),
        directions=np.ones((1, 1, 1)),
        ranges=np.array([[0.0, 1.0]]),
        radius=np.zeros((1, 1)),
        labels=("s",),
        exact=True,
    )
    for ranges, room in (([[0.25, 0.5]], 0.0), ([[-0.25, 0.9]], -0.25), ([[0.5, 1.5]], -0.5)):
        assert family.room(replace(family, ranges=np.array(ranges))) == room
    assert family.room(replace(family, ranges=np.zeros((2, 2)))) == -np.inf


def test_what_holds_up_to_rounding_is_refused_by_numbers(monkeypatch):
    """Slips of tyres at 20 m/s: 1.2 / 20 is no double, and the last entry depends nearly on others.

    SymPy does not come to an end on it.
    """
    asked = []
    monkeypatch.setattr(family, "simplified", lambda rest: asked.append(rest) or rest)
    plant = Plant("lateral")
    slip, yaw = plant.states("slip yaw", range=[(-0.15, 0.15), (-0.8, 0.8)])
    front, rear = -slip - 0.06 * yaw, 0.07 * yaw - slip
    forces = [k * sp.sin(1.4 * sp.atan(9 * a)) for k, a in ((7000, front), (7500, rear))]
    plant.dynamics([sum(forces) / 30000 - yaw, (1.2 * forces[0] - 1.4 * forces[1]) / 2400])
    plant.outputs([yaw])
    bounds = jacobian_bounds(plant)
    assert asked == [] and bounds.dependences == () and len(bounds.vertices()) == 16
