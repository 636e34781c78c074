"""Acceptance: Buciakowski et al., bounded-error observer on the quadruple tank.

Numbers from an independent implementation (tests/reference/bounded_error_uio.json).
"""

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

import obsynth as ob
from obsynth.designs.bounded_error.lmis import build_error_system
from obsynth.designs.bounded_error.printed import (
    box_vertices,
    find_fixed_point,
    largest_multiplier_gamma,
    verify_fixed_point,
)
from obsynth.designs.bounded_error.record import UioDesign
from obsynth.designs.bounded_error.step import first_bound
from obsynth.designs.bounded_error.synthesis import largest_gamma
from obsynth.designs.core.boxes import Ends
from obsynth.designs.core.stepping import largest_level

SCENARIOS = ("FS1", "FS2")


def test_equilibrium_and_frozen_matrices(tank_split, reference):
    model = reference["model"]
    np.testing.assert_allclose(tank_split.at.x, model["xeq"], rtol=1e-10)
    np.testing.assert_allclose(tank_split.A, model["A"], atol=1e-12)
    np.testing.assert_allclose(tank_split.B, model["B"], atol=1e-15)
    np.testing.assert_array_equal(tank_split.D, [[0], [0], [1], [0]])
    np.testing.assert_array_equal(tank_split.W1, np.zeros((4, 3)))
    np.testing.assert_array_equal(tank_split.W2, np.eye(3))


def test_jacobian_bounds_and_sixteen_vertices(tank_bounds, reference):
    np.testing.assert_allclose(tank_bounds.min, reference["model"]["Jmin"], atol=1e-9)
    np.testing.assert_allclose(tank_bounds.max, reference["model"]["Jmax"], atol=1e-9)
    assert tank_bounds.vertices().shape == (16, 4, 4)
    assert tank_bounds.naive_vertex_count == 64


def test_base_half_widths(base, reference):
    half_widths = base.performance["core_half_widths"]
    np.testing.assert_allclose(half_widths, reference["base"]["z"], rtol=5e-3)
    np.testing.assert_allclose(
        half_widths, [2.2125, 2.0193, 4.2426, 1.9656, 5.4952, 5.8632], rtol=5e-3
    )


def test_base_trace(base, tank_split, tank_bounds):
    assert base.performance["trace_P_inv"] == pytest.approx(95.412, rel=5e-3)
    slow = ob.BoundedErrorUIO(gamma=0.002).design(tank_split, tank_bounds)
    assert slow.performance["trace_P_inv"] == pytest.approx(233.859, rel=5e-3)


def test_base_gains(base):
    N, K, F = base.gains["N"], base.gains["K"], base.gains["F"]
    found = [N[0, 0], N[1, 1], K[3, 0], F[0, 0], F[1, 1]]
    np.testing.assert_allclose(found, [0.7489, 0.7910, 0.1638, 0.3845, 0.3807], atol=5e-3)


def test_h3_closed_form(base, tank_split, tank_bounds):
    assert base.performance["core_half_widths"][2] == pytest.approx(0.3 / np.sqrt(0.005), rel=1e-3)
    slow = ob.BoundedErrorUIO(gamma=0.002).design(tank_split, tank_bounds)
    assert slow.performance["core_half_widths"][2] == pytest.approx(0.3 / np.sqrt(0.002), rel=1e-3)


def test_first_level_of_the_papers_start(base, tank):
    """V_0 for x_0, z_0 of the paper and the first noise sample of seed 0."""
    scenario = ob.scenarios.quadruple_tank("FS1")
    w0 = np.random.default_rng(0).uniform(-0.1, 0.1, (5001, 3))[0]
    design = UioDesign.from_record(base.record)
    y0 = design.C @ scenario.x0 + w0
    error = np.concatenate([scenario.x0 - (scenario.guess - design.E @ y0), np.zeros(2)])
    level = error @ design.bound.P[0] @ error
    assert level == pytest.approx(57.977, rel=5e-3)
    # the start that the observer takes for this z_0 and the box {x_0} holds that level
    memory = base.memory0(scenario.guess, z0=scenario.guess)
    kept = {part: ca.SX(memory[base.memory_layout[part]]) for part in ("z", "fhat")}
    box, still = (np.column_stack([v, v]) for v in (scenario.x0, np.zeros(2)))
    start = ca.evalf(first_bound(design, Ends.of(box), Ends.of(still), kept))
    assert np.all(np.array(start) >= level)
    assert largest_level(design.bound.P[0], error, error) == pytest.approx(level, rel=1e-9)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("name", SCENARIOS)
@pytest.mark.parametrize("which", ["base", "given_peak", "peak"])
def test_every_state_and_fault_inside_at_every_instant(which, name, seed, tank, request):
    observer = request.getfixturevalue(which)
    run = ob.simulate(tank, observer, ob.scenarios.quadruple_tank(name), seed=seed)
    assert len(run.x) == 5001
    assert set(run.coverage) == {"h1", "h2", "h3", "h4", "f1", "f2"}
    assert all(share == 1.0 for share in run.coverage.values())


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("FS1", [0.0434, 0.0234, 0.0576, 0.0259, 0.1373, 0.0389]),
        ("FS2", [0.0437, 0.0434, 0.0576, 0.0262, 0.1369, 0.1536]),
    ],
)
def test_rms(base, alone, tank, reference, name, expected):
    run = ob.simulate(tank, alone(base), ob.scenarios.quadruple_tank(name), seed=0)
    rms = np.array(list(run.rms(from_step=1000).values()))
    np.testing.assert_allclose(rms, expected, rtol=0.1)
    np.testing.assert_allclose(rms, reference["sim"][name]["rms"], rtol=0.02)


def test_printed_form_is_refused_on_the_derived_bounds(tank_split, tank_bounds):
    method = ob.BoundedErrorUIO(form="printed", gamma=0.01)
    with pytest.raises(ob.InfeasibleDesign, match="infeasible for every gamma") as refusal:
        method.design(tank_split, tank_bounds)
    point = refusal.value.certificate
    assert point.q1 >= 0
    assert point.q2 >= 0
    assert "s = M e" in str(refusal.value)


@pytest.mark.long
def test_gamma_of_the_paper_is_refused_with_the_largest_feasible(tank_split, tank_bounds):
    with pytest.raises(ob.InfeasibleDesign, match="largest feasible gamma") as refusal:
        ob.BoundedErrorUIO(gamma=0.01).design(tank_split, tank_bounds)
    assert refusal.value.largest_gamma == pytest.approx(0.00903, rel=0.02)
    assert "disturbances and rates do not enter feasibility" in str(refusal.value)
    assert 0.5 < refusal.value.largest_share < 1.0
    assert "binding: decay" in str(refusal.value)


def test_peak_bounds_of_the_given_gain(given_peak):
    expected = [0.23985572, 0.28211696, 0.1, 1.12410313, 0.77555366, 1.17477582]
    np.testing.assert_allclose(given_peak.performance["core_half_widths"], expected, rtol=2e-7)
    assert given_peak.performance["sum_half_widths"] / 24.32 == pytest.approx(0.152, abs=5e-4)


def test_peak_bounds_of_a_gain_of_our_own(peak):
    assert peak.performance["sum_half_widths"] / 24.32 <= 0.1347


@pytest.mark.long
def test_repaired_form(tank_split, tank_bounds):
    method = ob.BoundedErrorUIO(form="repaired", gamma=0.005, objective="trace")
    observer = method.design(tank_split, tank_bounds)
    assert observer.performance["sum_half_widths"] == pytest.approx(24.32, rel=5e-3)


@pytest.mark.long
def test_repaired_form_has_a_smaller_largest_gamma(base, tank_bounds):
    exact = UioDesign.from_record(base.record).data
    assert largest_gamma(build_error_system(exact, "plain")) == pytest.approx(0.00903, rel=0.005)
    vertices = box_vertices(tank_bounds)
    assert largest_multiplier_gamma(exact.at(vertices)) == pytest.approx(0.00776, rel=0.01)


def test_largest_gamma_with_the_printed_bounds(base):
    """.00917 for the paper's M bounds."""
    data = UioDesign.from_record(base.record).data
    ends = {
        (0, 0): (0.0026, 0.0065),
        (0, 2): (-0.0144, 0.0039),
        (1, 1): (0.0008, 0.0033),
        (1, 3): (-0.0078, 0.0037),
        (2, 2): (-0.0039, 0.0144),
        (3, 3): (-0.0037, 0.0078),
    }
    low, high = np.zeros((4, 4)), np.zeros((4, 4))
    for entry, (a, b) in ends.items():
        low[entry], high[entry] = a, b
    vertices = box_vertices(SimpleNamespace(min=low, max=high))
    together = (vertices[:, 0, 2] == -vertices[:, 2, 2]) & (vertices[:, 1, 3] == -vertices[:, 3, 3])
    vertices = vertices[together]
    assert len(vertices) == 16
    assert largest_gamma(build_error_system(data.at(vertices), "plain")) == pytest.approx(
        0.00917, rel=0.005
    )


@pytest.mark.long
@pytest.mark.parametrize(
    ("options", "ratio"),
    [
        ({"gamma": 0.005}, 0.896),
        ({"gamma": 0.0063}, 0.823),
        ({"gamma": 0.0065, "multipliers": "per_component"}, 0.686),
        ({"gamma": 0.0063, "error": "shifted"}, 0.569),
    ],
)
def test_narrower_step_by_step(tank_split, tank_bounds, options, ratio):
    observer = ob.BoundedErrorUIO(**options).design(tank_split, tank_bounds)
    assert observer.performance["sum_half_widths"] / 24.32 == pytest.approx(ratio, abs=2e-3)


@pytest.mark.long
def test_one_ellipsoid_per_component(tank_split, tank_bounds, tank):
    method = ob.BoundedErrorUIO(
        gamma=0.0063, error="shifted", multipliers="per_component", post="per_component"
    )
    observer = method.design(tank_split, tank_bounds)
    assert observer.performance["sum_half_widths"] / 24.32 == pytest.approx(0.377, abs=0.02)
    run = ob.simulate(tank, observer, ob.scenarios.quadruple_tank("FS2"), seed=0)
    assert min(run.coverage.values()) == 1.0


@pytest.mark.long
def test_gamma_search_beats_the_fixed_gamma(tank_split, tank_bounds):
    observer = ob.BoundedErrorUIO().design(tank_split, tank_bounds)
    assert observer.performance["sum_half_widths"] < 20.02
    assert 0.0058 < observer.performance["gamma"] < 0.007


@pytest.mark.long
@pytest.mark.parametrize(
    ("objective", "key", "sign"),
    [("log_det", "log_det_P", 1), ("lambda_min", "lambda_min_P", 1), ("trace", "trace_P", 1)],
)
def test_each_objective_is_best_at_its_own(tank_split, tank_bounds, base, objective, key, sign):
    method = ob.BoundedErrorUIO(gamma=0.005, objective=objective)
    observer = method.design(tank_split, tank_bounds)
    assert sign * observer.performance[key] > sign * base.performance[key]
    assert observer.performance["trace_P_inv"] > base.performance["trace_P_inv"]


def decimals(text):
    from fractions import Fraction

    return [[Fraction(value) for value in row.split()] for row in text.strip().splitlines()]


PRINTED = {
    "A": decimals(".9902 0 .0201 0\n0 .9946 0 .0113\n0 0 .9799 0\n0 0 0 .9887"),
    "B_f": decimals(".0653 0\n0 .0488\n0 .0628\n.0440 0"),
    "C": decimals("1 0 0 0\n0 1 0 0\n0 0 1 0"),
    "T": decimals("1 0 0 0\n0 1 0 0\n0 0 0 0\n0 0 0 1"),
}
PRINTED_M = decimals(".0065 0 .0039 0\n0 .0008 0 -.0078\n0 0 .0144 0\n0 0 0 .0078")


def fractions(text):
    from fractions import Fraction

    return tuple(Fraction(value) for value in text.split())


def test_certificate_of_infeasibility_for_the_printed_numbers():
    """Four-digit data of the paper: the fixed point in short rationals, checked and searched."""
    point = {
        "e": fractions("0 0 0 1"),
        "e_f": fractions("13/100 -113/488"),
        "s": fractions("-8489/1000000 0 0 279/50000"),
    }
    found = verify_fixed_point(**PRINTED, M=PRINTED_M, **point)
    assert found == fractions("111/50000 18480479/1000000000000")
    searched = find_fixed_point(**PRINTED, vertices=[PRINTED_M])
    assert searched is not None
    assert searched.q1 >= 0
    assert searched.q2 >= 0
    again = verify_fixed_point(**PRINTED, M=PRINTED_M, e=searched.e, e_f=searched.e_f, s=searched.s)
    assert again == (searched.q1, searched.q2)


@pytest.mark.parametrize("entry", ["e", "e_f", "s"])
def test_a_spoilt_certificate_of_infeasibility_is_not_accepted(entry):
    point = {
        "e": fractions("0 0 0 1"),
        "e_f": fractions("13/100 -113/488"),
        "s": fractions("-8489/1000000 0 0 279/50000"),
    }
    first, *rest = point[entry]
    point[entry] = (first + fractions("1/1000000")[0], *rest)
    assert verify_fixed_point(**PRINTED, M=PRINTED_M, **point) is None


def test_no_certificate_where_the_nonlinearity_vanishes():
    zero = [[value * 0 for value in row] for row in PRINTED_M]
    assert find_fixed_point(**PRINTED, vertices=[zero]) is None
