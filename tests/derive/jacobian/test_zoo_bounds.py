"""Every plant of the zoo goes through splits and Jacobian bounds: sound, tight, as published."""

import functools
from dataclasses import replace

import casadi as ca
import mpmath
import numpy as np
import pytest
import sympy as sp

from obsynth.derive import Status, StructureError, equilibrium, jacobian_bounds, split
from zoo import ZOO

HEAVY = ("bicycle", "planar_arm 3R")
LIGHT = tuple(name for name in ZOO if name not in HEAVY)
REFUSED = {"qpv_example": ("f1", "x1"), "water_tanks": ("fc1", "h1")}
KINDS = ("x", "u", "d", "f", "w", "p", "rho")


@functools.cache
def plant_of(name):
    return ZOO[name]()


@functools.cache
def bounds_of(name, wrt, effort):
    return jacobian_bounds(plant_of(name), wrt, effort=effort)


@functools.cache
def split_of(name, linear):
    return split(plant_of(name), linear=linear)


def targets(name):
    return ("states", "inputs") if plant_of(name).u else ("states",)


@functools.cache
def jacobian(name, wrt):
    """Exact entries that are not zero, and the CasADi function of the whole matrix."""
    plant = plant_of(name)
    kind = {"states": "x", "inputs": "u"}[wrt]
    exact = plant.rhs.jacobian([s.symbol for s in getattr(plant, kind)])
    exact = exact.subs(plant.constant_values)
    sx = plant.sx()
    columns = [getattr(sx, k) for k in KINDS]
    dense = ca.densify(ca.jacobian(sx.rhs, getattr(sx, kind)))
    return exact, ca.Function("jacobian", columns, [ca.vec(dense)])


@functools.cache
def precisely(name, wrt, place):
    """An entry as a function of all signals, in 40 digits."""
    plant = plant_of(name)
    symbols = [s.symbol for kind in KINDS for s in getattr(plant, kind)]
    # the boxes of the zoo leave no room for the delta of a sign
    entry = jacobian(name, wrt)[0][place].replace(sp.DiracDelta, lambda *_: sp.Integer(0))
    return sp.lambdify(symbols, entry, "mpmath")


def ends(plant, kind):
    box = plant.box(kind)
    return [np.where(np.isfinite(box[:, k]), box[:, k], 2.0 * k - 1.0) for k in (0, 1)]


def sampled(plant, count, seed):
    """Points of the box, a third of the coordinates at its ends."""
    rng = np.random.default_rng(seed)
    blocks = []
    for kind in KINDS:
        low, high = ends(plant, kind)
        share = rng.random((count, len(low)))
        share = np.where(rng.random(share.shape) < 1 / 3, np.round(share), share)
        blocks.append(np.clip(low + share * (high - low), low, high).T)
    return blocks


def true_value(name, wrt, place, point):
    with mpmath.workdps(40):
        return precisely(name, wrt, place)(*[mpmath.mpf(float(v)) for v in point])


def violations(name, wrt, bounds, count, seed=0):
    """Sampled entries outside the bounds; what doubles leave open is judged in 40 digits."""
    plant = plant_of(name)
    blocks = sampled(plant, count, seed)
    values = np.array(jacobian(name, wrt)[1](*blocks)).reshape(*bounds.min.shape[::-1], count)
    values = values.transpose(1, 0, 2)
    assert np.isfinite(values).all()
    outside = (values < bounds.min[:, :, None]) | (values > bounds.max[:, :, None])
    far = 1e-9 * (1e-12 + np.abs(values).max(axis=2, keepdims=True))
    surely = (values < bounds.min[:, :, None] - far) | (values > bounds.max[:, :, None] + far)
    found = [tuple(index) for index in np.argwhere(surely)]
    constant = constant_places(name, wrt)
    for i, j, k in np.argwhere(outside & ~surely):
        if (i, j) in constant:
            continue
        value = true_value(name, wrt, (i, j), np.concatenate(blocks)[:, k])
        if not bounds.min[i, j] <= value <= bounds.max[i, j]:
            found.append((i, j, k))
    return found


def wrongly_attained(name, wrt, bounds):
    """Entries whose attained values are not attained at the stored points, or beyond the bounds."""
    plant = plant_of(name)
    order = [s.name for kind in KINDS for s in getattr(plant, kind)]
    middle = np.concatenate([0.5 * (low + high) for low, high in (ends(plant, k) for k in KINDS)])
    found = []
    for place in np.ndindex(bounds.min.shape):
        if np.isnan(bounds.attained_at[place]).any():
            continue
        low, high = bounds.min[place], bounds.max[place]
        for side in (0, 1):
            point = middle.copy()
            point[[order.index(n) for n in bounds.variables]] = bounds.attained_at[place][side]
            value = true_value(name, wrt, place, point)
            reached = (
                value <= bounds.attained_min[place]
                if side == 0
                else value >= bounds.attained_max[place]
            )
            if not (low <= value <= high and reached):
                found.append((place, side, value))
    return found


def constant_places(name, wrt):
    exact = jacobian(name, wrt)[0]
    return {p for p in np.ndindex(exact.shape) if not exact[p].free_symbols and exact[p] != 0}


def loose_entries(name, effort, limit=1e-6):
    """Entries with a gap of more than the limit, and how many entries vary at all."""
    loose, varying = {}, 0
    for wrt in targets(name):
        bounds, constant = bounds_of(name, wrt, effort), constant_places(name, wrt)
        width = bounds.max - bounds.min
        for place in map(tuple, np.argwhere(width > 0)):
            if place in constant:
                continue
            varying += 1
            gap = bounds.gap[place] / max(width[place], 1e-12)
            if gap > limit:
                loose[(wrt, *place)] = float(gap)
    return loose, varying


# -- points of operation -----------------------------------------------------------------------


@pytest.mark.parametrize("name", ZOO)
def test_plants_rest_inside_their_box_for_their_nominal_inputs(name):
    plant, point = plant_of(name), equilibrium(plant_of(name))
    box = plant.box("x")
    assert ((box[:, 0] <= point.x) & (point.x <= box[:, 1])).all()
    assert point.residual <= 1e-12 * (1 + np.abs(point.x).max())


# -- splits ------------------------------------------------------------------------------------


@pytest.mark.parametrize("linear", ["frozen", "terms", "jacobian"])
@pytest.mark.parametrize("name", [n for n in ZOO if n not in REFUSED])
def test_plants_split_and_the_parts_add_up(name, linear):
    plant, parts = plant_of(name), split_of(name, linear)
    assert parts.proof.holds
    blocks = sampled(plant, 12, seed=1)
    blocks[1] = blocks[1] + 0.25
    whole = np.array(plant.function()(*blocks)[0])
    values = dict(zip(KINDS, blocks, strict=True))
    extra = [values[k] for k in ("p", "rho") if plant.names(k)]
    summed = sum(
        matrix @ values[kind]
        for matrix, kind in (
            (parts.A, "x"),
            (parts.B, "u"),
            (parts.D, "d"),
            (parts.B_f, "f"),
            (parts.W1, "w"),
        )
    ) + np.array(parts.g_function()(values["x"], values["u"], *extra))
    scale = 1 + np.abs(parts.A) @ np.abs(values["x"]) + np.abs(parts.B) @ np.abs(values["u"])
    assert (np.abs(whole - summed) <= 1e-12 * scale + 1e-12 * np.abs(whole)).all()


@pytest.mark.parametrize("name", REFUSED)
def test_faults_that_multiply_states_are_refused_by_name(name):
    symbol, row = REFUSED[name]
    with pytest.raises(StructureError, match=f"the fault {symbol} enters the row of {row}") as told:
        split(plant_of(name))
    assert (told.value.symbol, told.value.row) == (symbol, row)


@pytest.mark.long
@pytest.mark.parametrize("name", [n for n in LIGHT if n not in REFUSED])
def test_bounds_of_the_remainder_are_those_of_the_plant_moved(name):
    parts, whole = split_of(name, "jacobian"), bounds_of(name, "states", "normal")
    found = jacobian_bounds(parts)
    slack = 1e-6 * (whole.max - whole.min) + 1e-12 * (1 + np.abs(parts.A))
    assert (np.abs(found.min + parts.A - whole.min) <= slack).all()
    assert (np.abs(found.max + parts.A - whole.max) <= slack).all()


# -- bounds: sound -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=pytest.mark.long if n in ("planar_arm 3R", "bicycle") else ())
        for n in ZOO
    ],
)
def test_samples_stay_within_the_bounds(name):
    effort = "fast" if name in HEAVY else "normal"
    for wrt in targets(name):
        assert not violations(name, wrt, bounds_of(name, wrt, effort), 3000)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=pytest.mark.long if n in ("planar_arm 3R", "bicycle") else ())
        for n in ZOO
    ],
)
def test_attained_values_are_attained_where_it_is_said(name):
    effort = "fast" if name in HEAVY else "normal"
    for wrt in targets(name):
        assert not wrongly_attained(name, wrt, bounds_of(name, wrt, effort))


@pytest.mark.long
@pytest.mark.parametrize("name", ZOO)
def test_a_million_samples_stay_within_the_bounds(name):
    for wrt in targets(name):
        bounds = bounds_of(name, wrt, "normal")
        for seed in range(20):
            assert not violations(name, wrt, bounds, 50_000, seed)
        assert not wrongly_attained(name, wrt, bounds)


def narrower(bounds, share, upper):
    """Bounds with one side moved in by a share of the width."""
    width = bounds.max - bounds.min
    moved = share * np.where(width > 1e-9, width, 0.0)
    if upper:
        return replace(bounds, max=bounds.max - moved)
    return replace(bounds, min=bounds.min + moved)


@pytest.mark.parametrize("upper", [True, False])
@pytest.mark.parametrize("name", ["exothermic_cstr", "quadrotor", "three_tanks", "van_der_pol"])
def test_bounds_that_are_too_narrow_are_caught(name, upper):
    bounds = bounds_of(name, "states", "normal")
    assert violations(name, "states", narrower(bounds, 0.2, upper), 3000)
    assert wrongly_attained(name, "states", narrower(bounds, 1e-5, upper))


@pytest.mark.parametrize("name", ["haldane_bioreactor", "quadrotor"])
def test_bounds_of_another_entry_are_caught(name):
    bounds = bounds_of(name, "states", "normal")
    low, high = np.roll(bounds.min, 1, axis=0), np.roll(bounds.max, 1, axis=0)
    shifted = replace(bounds, min=low, max=high)
    assert violations(name, "states", shifted, 3000)


# -- bounds: tight -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", LIGHT)
def test_no_entry_is_left_loose(name):
    loose, _ = loose_entries(name, "normal")
    assert loose == {}
    for wrt in targets(name):
        done = bounds_of(name, wrt, "normal").status
        assert set(done.ravel()) <= {Status.EXACT, Status.CONVERGED}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.long] * (name in ("planar_arm 3R", "bicycle")))
        for name in ZOO
    ],
)
def test_constant_entries_are_known_to_the_last_place(name):
    effort = "fast" if name in HEAVY else "normal"
    for wrt in targets(name):
        bounds, exact = bounds_of(name, wrt, effort), jacobian(name, wrt)[0]
        for place in constant_places(name, wrt):
            low, high = bounds.min[place], bounds.max[place]
            assert sp.Rational(low) <= exact[place] <= sp.Rational(high)
            assert high - low <= 2 * np.spacing(abs(float(exact[place])))


@pytest.mark.long
@pytest.mark.parametrize("name", ZOO)
def test_no_entry_is_left_loose_at_the_highest_effort(name):
    loose, varying = loose_entries(name, "tight")
    assert loose == {}
    assert varying > 0 or name == "three_tanks_fdt"


# -- published numbers -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "largest"),
    [
        ("hinf_example", {(0, 1): 0.7187752003879, (2, 2): 0.33}),
        ("hinf_example as printed", {(0, 0): 0.72, (0, 1): 0.0123237575437, (2, 2): 0.33}),
    ],
)
def test_jacobian_of_the_hinf_example(name, largest):
    found = jacobian_bounds(split_of(name, "terms"), rtol=1e-10)
    expected = np.zeros((3, 3))
    for place, value in largest.items():
        expected[place] = value
    size = np.maximum(-found.min, found.max)
    np.testing.assert_allclose(size, expected, rtol=0, atol=1e-9)
    assert found.family.vertex_count == 2 ** len(largest)


def test_majorant_of_the_hinf_example_is_rounded_upwards_in_the_paper():
    found = jacobian_bounds(split_of("hinf_example", "terms"), rtol=1e-10)
    squares = np.maximum(found.min**2, found.max**2).sum(axis=0)
    np.testing.assert_allclose(squares, [0, 0.5166377886, 0.1089], rtol=0, atol=1e-9)
    assert squares[1] < 0.517


def test_state_matrix_of_the_qpv_example_with_its_faults():
    found, reach = bounds_of("qpv_example", "states", "normal"), np.sqrt(0.1)
    low = [[-5 - reach, 10, 2], [-1, -2 - reach, 1.5], [1, 1, -7 - reach]]
    high = [[-4 + reach, 10, 4], [-1, -1 + reach, 3.5], [1, 1, -4 + reach]]
    np.testing.assert_allclose(found.min, low, rtol=0, atol=1e-14)
    np.testing.assert_allclose(found.max, high, rtol=0, atol=1e-14)


def test_state_matrix_of_the_interval_example():
    found = bounds_of("interval_example", "states", "normal")
    middle = np.array([[-1, 1.5, 0.1], [-0.9, 0.2, 0.4], [0.3, -0.5, -1]])
    radius = np.diag([0.1, 0, 0.05])
    np.testing.assert_allclose(found.min, middle - radius, rtol=0, atol=1e-15)
    np.testing.assert_allclose(found.max, middle + radius, rtol=0, atol=1e-15)
    assert len(found.vertices()) == 4


def test_three_tanks_have_half_the_reference_hull_of_their_quasi_linear_form():
    found = bounds_of("three_tanks", "states", "normal")
    # d rho / dz is half of rho / z, whose hull over the box is the reference
    steep, flat = 0.030511198447951998, 0.015255599223975999
    assert found.min[0, 0] == pytest.approx(-steep / 2, rel=1e-12)
    assert found.max[0, 0] == pytest.approx(-flat / 2, rel=1e-12)
    assert found.max[2, 1] == pytest.approx(steep / 2, rel=1e-12)
    assert found.min[1, 1] == pytest.approx(-0.07682944377985208 / 2, rel=1e-12)
    # both terms of entry (3, 3) hold x3, so the hull of each alone is not reached
    assert -0.061022396895904 / 2 < found.min[2, 2] < -0.0385939524947691 / 2


def test_jacobian_of_the_lorenz_system_is_that_of_the_box():
    found = bounds_of("lorenz", "states", "normal")
    low = [[-10, 10, 0], [-22, -1, -20], [-27, -20, -8 / 3]]
    high = [[-10, 10, 0], [28, -1, 20], [27, 20, -8 / 3]]
    np.testing.assert_allclose(found.min, low, rtol=1e-15, atol=0)
    np.testing.assert_allclose(found.max, high, rtol=1e-15, atol=0)


def test_quadrotor_has_thirty_six_entries():
    count = sum(
        int(((bounds.min != 0) | (bounds.max != 0)).sum())
        for bounds in (bounds_of("quadrotor", wrt, "normal") for wrt in ("states", "inputs"))
    )
    assert count == 36


def test_bias_vector_of_the_three_link_arm_without_a_search():
    found = bounds_of("planar_arm_bias", "states", "normal")
    assert found.min[3:, 0].tolist() == found.max[3:, 0].tolist() == [0.0, 0.0, 0.0]
    # dh3/ddq1 = 2 (dq1 + dq2) sin q3 + 2 dq1 sin(q2 + q3), extreme in a corner
    assert -found.min[5, 3] == pytest.approx(2 * np.sin(0.3) + np.sin(0.6), rel=1e-12)
