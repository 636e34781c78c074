"""What Buciakowski et al. take as given, derived: matrices, Jacobian bounds, vertices."""

import dataclasses

import numpy as np
import pytest

from obsynth.derive import (
    Status,
    StructureError,
    UnboundedError,
    analyse,
    equilibrium,
    jacobian_bounds,
    split,
)
from obsynth.derive.structure.conditions import detectability, unknown_input_condition

CORRECT = {
    (0, 0): (0.002596, 0.006490),
    (0, 2): (-0.014459, 0.005041),
    (1, 1): (0.000817, 0.003264),
    (1, 3): (-0.007803, 0.004453),
    (2, 2): (-0.005041, 0.014459),
    (3, 3): (-0.004453, 0.007803),
}
PRINTED = {
    (0, 0): (0.0026, 0.0065),
    (0, 2): (-0.0144, 0.0039),
    (1, 1): (0.0008, 0.0033),
    (1, 3): (-0.0078, 0.0037),
    (2, 2): (-0.0039, 0.0144),
    (3, 3): (-0.0037, 0.0078),
}
RADII = (0.00194698, 0.00122372, 0.00974959, 0.00612783)


def jacobian_of_g(parts, x):
    """Derivative of g by hand, from the paper's equations (53)-(56)."""
    hole, area = np.array([0.071, 0.051, 0.071, 0.051]), np.array([28.0, 32.0, 28.0, 32.0])
    slope = hole * np.sqrt(2 * 981.0) / (2 * np.sqrt(x))
    J = np.diag(1.0 - slope / area)
    J[0, 2], J[1, 3] = slope[2] / area[0], slope[3] / area[1]
    return J - parts.A


def sampled_points(count, seed=0):
    low, high = np.array([60.0, 60, 5, 5]), np.array([280.0, 280, 100, 100])
    return low + np.random.default_rng(seed).random((count, 4)) * (high - low)


# -- equilibrium and matrices ------------------------------------------------------------------


def test_equilibrium_of_section_6(model, reference):
    point = equilibrium(model, u=[10, 10])
    np.testing.assert_allclose(point.x, reference["xeq"], rtol=1e-12)
    assert point.residual <= 1e-12


def test_other_gravity_gives_another_level(model, reference):
    # the paper omits g; 980.665 instead of 981 moves h1 by more than the digits it prints
    lower = equilibrium(model, u=[10, 10]).x[0] * 981 / 980.665
    assert abs(lower - reference["xeq"][0]) > 0.04


def test_frozen_matrices_equal_the_reference(parts, reference):
    np.testing.assert_allclose(parts.A, reference["A"], rtol=0, atol=4e-16)
    np.testing.assert_allclose(parts.B, reference["B"], rtol=0, atol=4e-17)
    assert abs(parts.A[0, 0] - 0.9901535225219396) <= 2.3e-16
    np.testing.assert_array_equal(parts.B_f, parts.B)


def test_frozen_matrix_is_not_the_jacobian(model, parts):
    tangent = split(model, linear="jacobian")
    assert tangent.A[0, 0] == pytest.approx(0.99508, abs=5e-6)
    assert parts.A[0, 0] == pytest.approx(0.990154, abs=5e-7)


def test_noise_enters_the_outputs_only(parts):
    assert not parts.W1.any()
    np.testing.assert_array_equal(parts.W2, np.eye(3))
    np.testing.assert_array_equal(parts.D, [[0.0], [0.0], [1.0], [0.0]])
    np.testing.assert_array_equal(parts.C, np.eye(3, 4))


@pytest.mark.parametrize("linear", ["frozen", "terms", "jacobian"])
def test_parts_add_up_numerically_as_well(model, linear):
    found = split(model, linear=linear)
    assert found.proof.holds
    rng = np.random.default_rng(1)
    g, f = found.g_function(), model.function()
    for x in sampled_points(20, seed=2):
        u, d, fault, w = rng.normal(10, 1, 2), rng.normal(size=1), rng.normal(size=2), np.ones(3)
        whole = np.array(f(x, u, d, fault, w, [], [])[0]).ravel()
        summed = (
            found.A @ x
            + found.B @ u
            + found.D @ d
            + found.B_f @ fault
            + found.W1 @ w
            + np.array(g(x, u)).ravel()
        )
        np.testing.assert_allclose(summed, whole, rtol=1e-14)


# -- bounds ------------------------------------------------------------------------------------


def test_table_bounds_of_the_jacobian_of_g(bounds):
    # the table has six digits, of which the last is rounded
    for (i, j), (low, high) in CORRECT.items():
        assert bounds.min[i, j] == pytest.approx(low, abs=1e-6)
        assert bounds.max[i, j] == pytest.approx(high, abs=1e-6)


def test_bounds_equal_the_reference_to_1e_9(bounds, reference):
    np.testing.assert_allclose(bounds.min, reference["Jmin"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(bounds.max, reference["Jmax"], rtol=0, atol=1e-9)


def test_bounds_are_exact_and_attained(bounds, parts):
    for place in CORRECT:
        assert bounds.status[place] is Status.EXACT
        assert bounds.gap[place] <= 1e-15
        for side, value in ((0, bounds.attained_min), (1, bounds.attained_max)):
            x = bounds.attained_at[place][side][:4]
            assert jacobian_of_g(parts, x)[place] == pytest.approx(value[place], abs=1e-15)


def test_structural_zeros_stay_zero(bounds):
    zeros = np.ones((4, 4), dtype=bool)
    for place in CORRECT:
        zeros[place] = False
    assert not bounds.min[zeros].any()
    assert not bounds.max[zeros].any()


def violations(parts, low, high, points):
    return [x for x in points if not _inside(jacobian_of_g(parts, x), low, high)]


def _inside(J, low, high):
    return bool((low - 1e-15 <= J).all() and (high + 1e-15 >= J).all())


def test_samples_never_leave_the_bounds(bounds, parts):
    corner = np.array([[60.0, 60, 5, 5], [280.0, 280, 100, 100]])
    points = np.vstack([sampled_points(5000), corner])
    assert not violations(parts, bounds.min, bounds.max, points)


@pytest.mark.parametrize("level", [5.0, 5.4])
def test_printed_bounds_fail_a_sampled_jacobian_at_low_levels(parts, level):
    low, high = np.zeros((4, 4)), np.zeros((4, 4))
    for place, (a, b) in PRINTED.items():
        low[place], high[place] = a, b
    x = np.array([130.0, 170.0, level, 40.0])
    J = jacobian_of_g(parts, x)
    assert violations(parts, low, high, [x])
    assert J[2, 2] < low[2, 2]
    assert J[0, 2] > high[0, 2]


def test_printed_bounds_are_forward_differences_of_one_centimetre(bounds, reference):
    # their weakness: a step of 1 cm from h3 = 5 already misses a fifth of the range
    assert (reference["FDmin"] >= bounds.min).all()
    assert (reference["FDmax"] <= bounds.max).all()
    assert reference["FDmax"][0, 2] < 0.8 * bounds.max[0, 2]


# -- vertices ----------------------------------------------------------------------------------


def test_sixteen_exact_vertices_in_place_of_64(bounds):
    assert bounds.naive_vertex_count == 64
    assert bounds.vertices().shape == (16, 4, 4)
    assert bounds.family.exact
    assert bounds.family.radius.max() < 1e-16


def test_the_reason_can_be_read(bounds):
    reasons = [str(d) for d in bounds.dependences]
    assert len(reasons) == 2
    assert reasons[0].startswith("m13 = -m33")
    assert reasons[1].startswith("m24 = -m44")
    assert all("proved zero" in r for r in reasons)
    assert "h3 only" in reasons[0]


def test_scalars_of_the_peak_bounds(bounds):
    family = bounds.family
    np.testing.assert_allclose(family.half_ranges, RADII, rtol=0, atol=6e-9)
    expected = (
        [(0, 0, 1.0)],
        [(1, 1, 1.0)],
        [(2, 2, 1.0), (0, 2, -1.0)],
        [(3, 3, 1.0), (1, 3, -1.0)],
    )
    for direction, entries in zip(family.directions, expected, strict=True):
        built = np.zeros((4, 4))
        for i, j, value in entries:
            built[i, j] = value
        np.testing.assert_array_equal(direction, built)
    np.testing.assert_allclose(family.midpoint, 0.5 * (bounds.min + bounds.max), atol=1e-16)


def test_family_holds_every_sampled_jacobian(bounds, parts):
    family = bounds.family
    low, high = family.ranges[:, 0], family.ranges[:, 1]
    for x in sampled_points(500, seed=3):
        J = jacobian_of_g(parts, x)
        s = J.diagonal()
        assert (s >= low - 1e-15).all()
        assert (s <= high + 1e-15).all()
        # 1e-15: the error of this evaluation, not of the family
        assert np.abs(J - family.at(s)).max() <= 1e-15


def test_family_with_a_wrong_sign_is_caught(bounds, parts):
    directions = bounds.family.directions.copy()
    directions[2, 0, 2] *= -1.0
    wrong = dataclasses.replace(bounds.family, directions=directions)
    J = jacobian_of_g(parts, sampled_points(1)[0])
    assert np.abs(J - wrong.at(J.diagonal())).max() > 1e-4


def test_mean_value_matrix_keeps_the_dependence(bounds, parts):
    """The integral of J along a segment lies in the family; the row-wise form need not."""
    nodes, weights = np.polynomial.legendre.leggauss(40)
    rng = np.random.default_rng(5)
    for a, b in zip(sampled_points(20, seed=6), sampled_points(20, seed=7), strict=True):
        t = 0.5 * (nodes + 1)
        M = sum(
            0.5 * w * jacobian_of_g(parts, b + s * (a - b)) for s, w in zip(t, weights, strict=True)
        )
        g = parts.g_function()
        u = rng.normal(10, 1, 2)
        difference = np.array(g(a, u) - g(b, u)).ravel()
        np.testing.assert_allclose(M @ (a - b), difference, rtol=0, atol=1e-12)
        assert abs(M[0, 2] + M[2, 2]) <= 1e-15
        assert np.abs(M - bounds.family.at(M.diagonal())).max() <= 1e-15


def test_tanks_of_different_areas_scale_the_dependence(tanks):
    found = jacobian_bounds(split(tanks(tank_areas=(20, 32, 28, 30))))
    assert len(found.vertices()) == 16
    assert found.family.directions[2, 0, 2] == pytest.approx(-28 / 20, rel=1e-15)
    assert 0.0 < found.family.radius[0, 2] < 1e-15


# -- structure ---------------------------------------------------------------------------------


def test_decoupling_matrices_as_printed(parts):
    found = unknown_input_condition(parts)
    np.testing.assert_array_equal(found.T, np.diag([1.0, 1.0, 0.0, 1.0]))
    E = np.zeros((4, 3))
    E[2, 2] = -1.0
    np.testing.assert_array_equal(found.E, E)
    assert not (found.T @ parts.D).any()


def test_state_and_faults_are_detectable_at_all_vertices(parts, bounds):
    found = detectability(parts, bounds)
    assert found.vertices == 16
    assert found.margin > 1e-3


def test_two_outputs_cannot_decouple_the_inflow(tanks):
    parts = split(tanks(measured=(0, 1)))
    with pytest.raises(StructureError, match=r"rank\(C D\) = 0 but rank\(D\) = 1") as caught:
        unknown_input_condition(parts)
    assert caught.value.symbols == ("d",)
    assert caught.value.states == ("h3",)
    assert (caught.value.rank_D, caught.value.rank_CD) == (1, 0)
    assert "Measure h3" in str(caught.value)


def test_second_pump_fault_is_hidden_without_h2(tanks):
    parts = split(tanks(measured=(0, 2, 3)))
    with pytest.raises(StructureError, match="the fault f2 cannot be detected") as caught:
        detectability(parts, jacobian_bounds(parts))
    assert caught.value.symbols == ("f2",)
    assert caught.value.mode == 1.0
    assert caught.value.states == ("h2",)


def test_a_hidden_fault_really_is_hidden(tanks):
    """The motion that the message describes leaves the outputs alone, at the vertex it names."""
    parts = split(tanks(measured=(0, 2, 3)))
    with pytest.raises(StructureError) as caught:
        detectability(parts, jacobian_bounds(parts))
    M = caught.value.vertex
    T = unknown_input_condition(parts).T
    h2 = np.linalg.solve(np.eye(1) - (T @ (parts.A + M))[1:2, 1:2], (T @ parts.B_f)[1:2, 1])
    x = np.array([0.0, h2[0], 0.0, 0.0])
    moved = T @ (parts.A + M) @ x + T @ parts.B_f @ np.array([0.0, 1.0])
    np.testing.assert_allclose(moved, x, atol=1e-12)
    assert not (parts.C @ x).any()


def test_box_that_reaches_an_empty_tank_is_refused(tanks):
    parts = split(tanks(lowest=0.0))
    with pytest.raises(UnboundedError, match=r"h3 in \[0, ") as caught:
        jacobian_bounds(parts)
    error = caught.value
    assert error.entries == ("dg/dx[1,3]", "dg/dx[2,4]", "dg/dx[3,3]", "dg/dx[4,4]")
    assert error.operation == "a division by an interval that contains zero"
    low, high = error.sub_boxes["dg/dx[4,4]"]["h4"]
    assert low == 0.0
    assert high < 1e-3


def test_analyse_reports_and_raises_nothing(model, tanks):
    report = analyse(model)
    assert report.passed
    assert "16 (exact) in place of 64" in str(report)
    assert "m13 = -m33" in str(report)
    assert "h3 is then taken from the measurement alone" in str(report)
    assert "f1, f2 can be told apart" in report["faults"].text
    failed = analyse(tanks(measured=(0, 2, 3)))
    assert not failed.passed
    assert failed["detectability"].passed is False
    assert "f2" in failed["detectability"].text
    assert analyse(tanks(measured=(0, 1)))["unknown inputs"].passed is False
    assert "h3" in analyse(tanks(lowest=0.0))["Jacobian bounds"].text
    assert "&lt;" not in report._repr_html_().replace("&lt;=", "")
