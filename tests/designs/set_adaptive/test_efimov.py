"""Acceptance: Efimov, Raissi, Zolghadri, set adaptive observer on the three tanks.

Numbers from an independent implementation (tests/reference/set_adaptive.json).
"""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import obsynth as ob
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.set_adaptive.gain import analyse_gain, design_gain
from obsynth.designs.set_adaptive.indicators import fault_indicators, monitors
from obsynth.designs.set_adaptive.method import SetAdaptiveObserver
from obsynth.designs.set_adaptive.printed import solve_printed

# flows between tanks and out of the second over the section of a tank
FLOWS = np.array([1.329e-4, 1.329e-4, 1.772e-4]) / 0.0154
TABLE = {
    50: {"x": (0.49802839, 0.10644992, 0.30089414)},
    199: {
        "x": (0.53303347, 0.15184539, 0.33650204),
        "zeta_m": (0.53183903, 0.15059599, 0.22733629),
        "zeta_M": (0.53454786, 0.15393285, 0.44533913),
        "xi_m": (0.53033843, 0.14853270, 0.22607692),
        "xi_M": (0.53575144, 0.15519747, 0.44707991),
        "theta_m": (5.53504e-5, 5.85961e-5),
        "theta_M": (-6.94966e-5, -9.68192e-5),
    },
    250: {"theta_m": (1.238085e-4, 4.74575e-5), "theta_M": (2.60972e-5, -7.73620e-5)},
}
TOLERANCE = {"theta_m": 2e-8, "theta_M": 2e-8}
REFERENCE = {
    "x": "x",
    "zeta_m": "zeta_m",
    "zeta_M": "zeta_M",
    "xi_m": "xi_m",
    "xi_M": "xi_M",
    "theta_m": "theta_m_hat_upper",
    "theta_M": "theta_M_hat_lower",
    "Omega_m": "Omega_m",
    "Omega_M": "Omega_M",
}


# -- the forms and the gain ----------------------------------------------------------


def printed_bounds(y1, y2):
    """A_m and A_M as the paper prints them, below (20)."""
    first, second, out = FLOWS

    def matrix(low, high):
        # x3 is at ``low`` or ``high`` where the entry is least; the other way round where largest
        near, far = abs(y1 - high) ** -0.5, abs(low - y2) ** -0.5
        other, away = abs(y1 - low) ** -0.5, abs(high - y2) ** -0.5
        return np.array(
            [
                [-first * near, 0, first * other],
                [0, -second * far - out * abs(y2) ** -0.5, second * away],
                [first * other, second * away, -second * far - first * near],
            ]
        )

    return matrix(0.24, 0.36), matrix(0.36, 0.24)


def test_the_eighteen_printed_entries(structure):
    function = structure.bounds.function()
    for y in np.random.default_rng(3).uniform((0.44, 0.04), (0.56, 0.16), (200, 2)):
        for found, expected in zip(function(y, y, [])[:2], printed_bounds(*y), strict=True):
            assert np.array(found) == pytest.approx(expected, rel=1e-12, abs=1e-16)


def true_matrix(x):
    """A(x) of the three tanks."""
    gaps = np.abs([x[0] - x[2], x[2] - x[1], x[1]]) ** -0.5
    a, b, c = FLOWS * gaps
    return np.array([[-a, 0, a], [0, -b - c, b], [a, b, -a - b]])


def test_noise_breaks_the_printed_bounds_and_not_the_widened_ones(structure):
    function, rng, broken = structure.bounds.function(), np.random.default_rng(11), 0
    box = structure.plant.box("x")
    x, v = rng.uniform(*box.T, (2000, 3)), rng.uniform(-4.5e-3, 4.5e-3, (2000, 2))
    for state, noise in zip(x, v, strict=True):
        true, y = true_matrix(state), state[:2] + noise
        shown = np.clip(y, *box[:2].T)
        low, high = (np.array(end) for end in function(shown, shown, [])[:2])
        broken += bool((true < low - 1e-15).any() or (true > high + 1e-15).any())
        ends = (np.clip(y + side, *box[:2].T) for side in (-4.5e-3, 4.5e-3))
        low, high = (np.array(end) for end in function(*ends, [])[:2])
        assert (low - 1e-15 <= true).all()
        assert (high + 1e-15 >= true).all()
    assert broken / len(x) == pytest.approx(0.115, abs=0.02)


def test_eigenvalues_with_the_paper_gain(structure, paper_gain, numbers):
    low, high = structure.bounds.function()([0.5, 0.1], [0.5, 0.1], [])[:2]
    LC = paper_gain["L"] @ structure.C
    for matrix, expected in (
        (low, [-3.05954633, -3.02316026, -0.04593733]),
        (high, [-3.05348832, -3.01710201, -0.03349467]),
    ):
        found = np.sort(np.linalg.eigvals(np.array(matrix) - LC).real)
        assert found == pytest.approx(expected, abs=1e-7)
    assert np.linalg.eigvals(np.array(high)).real.max() == pytest.approx(0.00272165, abs=1e-7)
    assert np.array(low) == pytest.approx(np.array(numbers["part1"]["Am_y0.5_0.1"]), rel=1e-12)
    assert np.array(high) == pytest.approx(np.array(numbers["part1"]["AM_y0.5_0.1"]), rel=1e-12)


def test_extremes_over_the_range(hull, numbers):
    assert hull[0] == pytest.approx(np.array(numbers["part1"]["Am_hull_lo"]), rel=1e-6)
    assert hull[1] == pytest.approx(np.array(numbers["part1"]["AM_hull_hi"]), rel=1e-6)
    assert (hull[0] <= np.array(numbers["part1"]["Am_hull_lo"]) + 1e-15).all()
    assert (hull[1] >= np.array(numbers["part1"]["AM_hull_hi"]) - 1e-15).all()


@pytest.mark.parametrize(
    ("cap", "alpha"), [(3.0, 0.0302010), (10.0, 0.0304181), (100.0, 0.0305019)]
)
def test_gain_program(hull, structure, cap, alpha):
    gain = design_gain(*hull, structure.C, cap)
    assert gain.alpha == pytest.approx(alpha, abs=1e-7)
    assert np.abs(gain.L).max() <= cap
    assert gain.p.sum() == pytest.approx(1.0, abs=1e-6)
    assert (gain.p > 0.0).all()
    assert (gain.p @ (hull[1] - gain.L @ structure.C) <= -gain.alpha * gain.p).all()


def test_the_program_as_a_problem_of_the_layer_and_of_cvxpy(tanks):
    method = SetAdaptiveObserver(noise=False)
    for alpha, sign in ((0.0302010 - 1e-6, 1.0), (0.0302010 + 1e-6, -1.0)):
        problem = method.problem(tanks, alpha)
        tight = {"tol_feas": 1e-11, "tol_gap_abs": 1e-12, "tol_gap_rel": 1e-12}
        margin = problem.solve(**tight)["margin"].item()
        assert sign * margin > 0.0
        other = problem.to_cvxpy()
        other.solve(solver="CLARABEL", **tight)
        assert other.var_dict["margin"].value.item() == pytest.approx(margin, abs=1e-9)
    with pytest.raises(ob.ObsynthError, match="no program"):
        SetAdaptiveObserver(robust=True).problem(tanks, 0.01)


def test_the_largest_decay_is_a_supremum(hull, structure, numbers):
    supremum = numbers["part1"]["max_alpha_common"]
    found = [design_gain(*hull, structure.C, cap).alpha for cap in (1e2, 1e3, 1e4)]
    assert found == sorted(found)
    assert found[-1] < supremum == pytest.approx(0.0305112, abs=1e-7)
    assert supremum - found[-1] < 2e-7


def test_decay_of_the_paper_gain(hull, structure, paper_gain):
    assert analyse_gain(*hull, structure.C, paper_gain["L"]).alpha == pytest.approx(
        0.0298909, abs=1e-7
    )


def test_smallest_multiple_of_the_measured_states(hull, structure, numbers):
    from scipy.optimize import brentq

    def decay(ell):
        return analyse_gain(*hull, structure.C, ell * np.eye(3, 2)).alpha

    assert brentq(decay, 1e-3, 1.0) == pytest.approx(numbers["part1"]["ell_min_hull"], abs=1e-6)


def test_a_gain_that_is_not_metzler_or_not_hurwitz_is_refused(tanks, hull, structure):
    too_large = 3.0 * np.eye(3, 2)
    too_large[2, 0] = 0.0153
    with pytest.raises(InfeasibleDesign, match=r"entry \(3, 1\).*lower L"):
        analyse_gain(*hull, structure.C, too_large)
    with pytest.raises(InfeasibleDesign, match="not Hurwitz"):
        SetAdaptiveObserver(noise=False).analyse(tanks, {"L": 0.01 * np.eye(3, 2)})


def test_the_printed_gain_condition_does_not_give_a_gain(tanks, hull, structure):
    p, w, L = solve_printed(*hull, structure.C)
    for A in hull:
        assert (p @ A - w @ structure.C < 0.0).all()
    # the second condition holds with any large r and so asks for nothing
    assert (np.minimum(p @ hull[0] - w @ structure.C, 0.0).min()) < 0.0
    assert np.abs(p @ L - w).max() > 0.01 * np.abs(w).max()
    with pytest.raises(InfeasibleDesign, match="not Metzler") as refusal:
        SetAdaptiveObserver(form="printed").design(tanks)
    assert (refusal.value.p @ refusal.value.L != refusal.value.w).all()


def test_longest_step_of_explicit_euler(printed, cooperative, numbers):
    assert printed.performance["euler_step"] == pytest.approx(0.325010, abs=1e-6)
    assert printed.performance["euler_step"] == pytest.approx(
        numbers["disc"]["euler_hmax_margin0"], rel=1e-6
    )
    assert printed.model.Ts == 0.01
    assert cooperative.performance["longest_step"] > 20.0


# -- the noise-free run --------------------------------------------------------------


def compare(run, numbers, case="printed_Gamma0.01", times=(50, 99, 150, 199, 210, 250, 299, 310)):
    """Largest errors of states and of fault bounds against the reference, all digits."""
    states, faults = 0.0, 0.0
    for t in times:
        expected = numbers["gold_noisefree"][case]["samples"][f"{float(t)}"]
        for name, key in REFERENCE.items():
            error = float(np.abs(run.part(t, name) - expected[key]).max())
            if name.startswith("theta"):
                faults = max(faults, error)
            elif not name.startswith("Omega"):
                states = max(states, error)
            else:
                states = max(states, error / 20.0)
    return states, faults


def test_table_of_values(together):
    for t, row in TABLE.items():
        for name, values in row.items():
            tolerance = TOLERANCE.get(name, 1e-6)
            np.testing.assert_allclose(
                together.part(t, name), values, atol=tolerance, rtol=0, err_msg=f"{name} at {t}"
            )


def test_all_digits_of_the_reference(together, numbers):
    states, faults = compare(together, numbers)
    assert states < 1e-8
    assert faults < 1e-10


def test_monitors_of_the_reference(together, printed, numbers):
    for t in (50, 199, 299):
        expected = numbers["gold_noisefree"]["printed_Gamma0.01"]["samples"][f"{float(t)}"]
        found = monitors(printed, together.at(t)[3:])
        assert found.weight == pytest.approx(t)
        for o in ("m", "M"):
            assert getattr(found, f"R_{o}").ravel() == pytest.approx(expected[f"R_{o}"], rel=1e-8)
            assert getattr(found, f"b_{o}") == pytest.approx(expected[f"b_{o}"], rel=1e-7)
            assert getattr(found, f"limit_{o}") == pytest.approx(expected[f"Rinv_b_{o}"], abs=1e-11)
        assert found.excitation == pytest.approx(expected["R_mineig_m"][0], rel=1e-8)
        # the condition of Theorem 1 (ii), theta_M < R_m^-1 b_m, fails for Theta = [-1e-4, 1e-4]
        assert (found.limit_m < 1e-4).all()


def crossings(run, observer):
    """First instants of d1, s1 after 200 s and of d2, s2 after 300 s; None where there is none."""
    C = np.eye(2, 3)

    def fault(i):
        return lambda t: max(run.part(t, "theta_M")[i], -run.part(t, "theta_m")[i])

    def output(i):
        def outside(t):
            y = run.part(t, "x")[i]
            return max((C @ run.part(t, "zeta_m"))[i] - y, y - (C @ run.part(t, "zeta_M"))[i])

        return outside

    return {
        "d1": run.first(fault(0), 200.0, 205.0),
        "s1": run.first(output(0), 200.0, 205.0),
        "d2": run.first(fault(1), 300.0, 310.0),
        "s2": run.first(output(1), 300.0, 310.0),
    }


def test_delays_of_the_first_fault(together, printed, numbers):
    found = crossings(together, printed)
    assert found["d1"] == pytest.approx(200.974253, abs=1e-5)
    assert found["s1"] == pytest.approx(200.695142, abs=1e-5)
    # the printed second fault is not detected while the model is defined
    assert found["d2"] is None
    assert found["s2"] is None


@pytest.mark.long
def test_the_printed_delays_cannot_be_reached(tanks, integrate, printed, paper_gain, numbers):
    cases = numbers["gold_noisefree"]
    for Gamma in (0.003, 0.03):
        observer = SetAdaptiveObserver(form="printed", Gamma=Gamma).analyse(tanks, paper_gain)
        run = integrate(observer, (8e-5, 6e-5), rtol=1e-9)
        found = crossings(run, observer)
        expected = cases[f"printed_Gamma{Gamma:g}"]["events"]
        assert found["d1"] == pytest.approx(expected["d1"][0], abs=1e-4)
        # S does not depend on Gamma, and both are later than the printed .35 s
        assert found["s1"] == pytest.approx(200.695142, abs=1e-5)
        assert min(found["d1"], found["s1"]) - 200.0 > 0.6
        assert found["d2"] is None


def test_a_second_fault_of_twice_the_size_is_detected(printed, integrate):
    found = crossings(integrate(printed, (8e-5, 1.2e-4)), printed)
    assert found["d2"] - 300.0 == pytest.approx(0.581006, abs=1e-5)
    assert found["s2"] - 300.0 == pytest.approx(0.320236, abs=1e-5)


def test_the_faulted_plant_leaves_the_range(together, tanks, numbers):
    events = numbers["gold_noisefree"]["printed_Gamma0.01"]["events"]
    upper = tanks.box("x")[:, 1]
    for i, (begin, end) in enumerate([(201.0, 230.0), (300.001, 310.0), (290.0, 299.9)]):
        t = together.first(lambda t, i=i: together.part(t, "x")[i] - upper[i], begin, end)
        assert t == pytest.approx(events[f"exit_x{i + 1}"][0], abs=1e-4)
    assert [round(events[f"exit_x{i}"][0], 3) for i in (1, 3, 2)] == [221.540, 297.343, 304.176]


def test_the_bounds_hold_the_truth_before_the_faults(together):
    for t in np.linspace(0.0, 200.0, 401):
        x = together.part(t, "x")
        for name in ("zeta", "xi"):
            assert (together.part(t, f"{name}_m") <= x + 1e-9).all()
            assert (x <= together.part(t, f"{name}_M") + 1e-9).all()
        assert (together.part(t, "theta_M") <= 0.0).all()
        assert (together.part(t, "theta_m") >= 0.0).all()


def test_the_joint_engine_arrives_at_the_table(tanks, printed):
    scenario = ob.scenarios.three_tanks("fault free", end=50.0, noise=None)
    run = ob.simulate(tanks, printed, scenario, engine="joint")
    assert run.x[-1] == pytest.approx(TABLE[50]["x"], abs=1e-8)
    assert (run.f_lower == tanks.box("f")[:, 0]).all()  # what is declared, nothing of the law's
    assert (run.status & 16 == 16).all()


def test_the_continuous_form_with_noise_included(tanks):
    observer = SetAdaptiveObserver(gain_cap=0.5).design(tanks)
    assert observer.model.Ts == 0.005 < 1.0 / observer.performance["adaptation"]
    scenario = ob.scenarios.three_tanks("fault free", end=30.0, Ts=0.005)
    run = ob.simulate(tanks, observer, scenario, engine="joint")
    assert min(run.coverage.values()) == 1.0
    assert not run.status.any()


@pytest.mark.parametrize("mutant", ["sign of row 2", "swapped bounds", "theta", "later by one"])
def test_the_table_sees_a_mutant(printed, integrate, numbers, certify, monkeypatch, mutant):
    from obsynth.designs.set_adaptive import step as module

    piece = ((100.0, 0.0, (0, 0)),)
    if mutant == "sign of row 2":
        run = integrate(printed, (0, 0), rtol=1e-8, sign=-1.0, pieces=((5.0, 0.0, (0, 0)),))
        right = integrate(printed, (0, 0), rtol=1e-8, pieces=((5.0, 0.0, (0, 0)),))
        assert np.abs(run.part(5.0, "x") - right.part(5.0, "x")).max() > 1000 * 1e-6
        return
    run = integrate(printed, (0, 0), rtol=1e-9, pieces=piece)
    assert max(compare(run, numbers, times=(50,))) < 1e-6
    if mutant == "later by one":
        shifted = run.part(50.01, "zeta_M")
        expected = numbers["gold_noisefree"]["printed_Gamma0.01"]["samples"]["50.0"]["zeta_M"]
        assert np.abs(shifted - expected).max() > 1e-6
        return
    right = getattr(module, "theta_rates" if mutant == "theta" else "drives")
    if mutant == "theta":

        def wrong(*given):
            return tuple(-rate for rate in right(*given))

        monkeypatch.setattr(module, "theta_rates", wrong)
    else:
        monkeypatch.setattr(module, "drives", lambda *given: right(*given)[::-1])
    broken = certify(printed.record).observer()
    found = integrate(broken, (0, 0), rtol=1e-7, pieces=((10.0, 0.0, (0, 0)),))
    healthy = integrate(printed, (0, 0), rtol=1e-7, pieces=((10.0, 0.0, (0, 0)),))
    name = "theta_m" if mutant == "theta" else "zeta_m"
    error = np.abs(found.part(10.0, name) - healthy.part(10.0, name)).max()
    assert error > 100 * TOLERANCE.get(name, 1e-6)


# -- indicators ----------------------------------------------------------------------


def test_the_reversed_test_alarms_for_ever(together, printed):
    times = [50.0, 150.0, 199.0]
    memory = np.array([together.at(t)[3:] for t in times])
    y = np.array([together.at(t)[:2] for t in times])
    right = fault_indicators(printed, memory, y)
    assert not right.S.any()
    assert not right.D.any()
    assert not right.Z.any()
    literal = fault_indicators(printed, memory, y, form="printed")
    assert literal.D.all()
    with pytest.raises(ob.ObsynthError, match="form"):
        fault_indicators(printed, memory, y, form="reversed")


def test_indicators_after_the_first_fault(together, printed):
    memory = np.array([together.at(t)[3:] for t in (200.6, 200.8, 201.2)])
    y = np.array([together.at(t)[:2] for t in (200.6, 200.8, 201.2)])
    found = fault_indicators(printed, memory, y)
    assert found.S.tolist() == [False, True, True]
    assert found.d.tolist() == [[False, False], [False, False], [True, False]]
    assert not found.z[:, 1].any()


# -- the two laws --------------------------------------------------------------------


@pytest.fixture(scope="module")
def coupled():
    """Two faults that both act on both states, and one entry of A that is not known."""
    plant = ob.Plant("coupled faults")
    x1, x2 = plant.states("x1:3", range=(0, 5))
    u1, u2 = plant.inputs("u1:3", range=(0, 1))
    (a,) = plant.scheduling("a", range=(-1.5, -0.9), measured=False)
    f1, f2 = plant.faults("theta1:3", range=(-2, 2))
    plant.dynamics([a * x1 + x2 / 10 + u1 + f1 + f2 / 2, x1 / 10 - x2 + u2 + f1 / 2 + f2])
    plant.outputs([x1, x2])
    return plant


def run_coupled(plant, law, end):
    observer = SetAdaptiveObserver(law=law, Gamma=0.1).analyse(plant, {"L": np.zeros((2, 2))})
    A = np.array([[-1.0, 0.1], [0.1, -1.0]])
    G = np.array([[1.0, 0.5], [0.5, 1.0]])
    theta, u = np.array([1.0, 0.3]), np.array([0.5, 0.5])
    start = observer.memory0([1, 1], x_range=[(1, 1), (1, 1)], f_range=[(-2, 2)] * 2)

    def rates(_, z):
        return np.concatenate(
            [A @ z[:2] + u + G @ theta, np.array(observer.ode(z[2:], u, z[:2])).ravel()]
        )

    found = solve_ivp(
        rates,
        (0, end),
        np.concatenate([[1, 1], start]),
        method="DOP853",
        rtol=1e-10,
        atol=1e-12,
        dense_output=True,
    )
    layout = observer.memory_layout
    times = np.linspace(0, end, 2001)
    values = found.sol(times)[2:]
    return times, values[layout["theta_m"]], values[layout["theta_M"]], observer


def test_the_printed_law_loses_the_order(coupled):
    _, upper, lower, observer = run_coupled(coupled, "printed", 4000.0)
    short = run_coupled(coupled, "printed", 200.0)
    assert short[1][1, -1] == pytest.approx(-0.22612, abs=1e-5)
    assert upper[1, -1] == pytest.approx(-0.2993266, abs=1e-6)
    assert short[2][1, -1] == pytest.approx(0.4210, abs=1e-4)
    # the fault is .3: above its "upper" bound, below its "lower" one
    assert upper[1, -1] < 0.3 < lower[1].max()
    assert any("neither fault bounds" in claim for claim in observer.guarantee.claims)
    declared = observer.step(observer.memory0([1, 1]), [0.5, 0.5], [1, 1])[5:7]
    assert np.array(declared)[..., 0].tolist() == [[-2, -2], [2, 2]]
    own = SetAdaptiveObserver(law="printed", Gamma=0.1, cuts=()).design(coupled)
    memory = own.step(own.memory0([1, 1]), [0.5, 0.5], [1, 1])[0]
    assert np.isinf(np.array(own.step(memory, [0.5, 0.5], [1, 1])[3:7])).all()


def test_the_cooperative_law_keeps_it(coupled):
    _, upper, lower, _ = run_coupled(coupled, "cooperative", 4000.0)
    assert upper[:, -1] == pytest.approx([2.295623, 0.521228], abs=1e-6)
    assert lower[:, -1] == pytest.approx([0.702348, -0.469024], abs=1e-6)
    for theta, high, low in zip((1.0, 0.3), upper, lower, strict=True):
        assert (high >= theta).all()
        assert (low <= theta).all()


@pytest.mark.parametrize("Gamma", [0.01, 1.0, 100.0])
def test_the_cooperative_order_holds_for_every_gain(coupled, Gamma):
    observer = SetAdaptiveObserver(Gamma=Gamma, Ts=0.05).analyse(coupled, {"L": np.zeros((2, 2))})
    F = coupled.discretise("rk4", 0.05).function()
    x, theta, u = np.array([1.0, 1.0]), np.array([1.0, 0.3]), np.array([0.5, 0.5])
    memory = observer.memory0(x)
    for k in range(400):
        a = -0.9 if k % 7 else -1.5
        memory, *_, x_low, x_high, low, high, status = observer.step(memory, u, x)
        assert int(status) == 0
        assert (np.array(low).ravel() <= theta).all()
        assert (theta <= np.array(high).ravel()).all()
        assert (np.array(x_low).ravel() <= x).all()
        assert (x <= np.array(x_high).ravel()).all()
        x = np.array(F(x, u, [], theta, [], [], [a])[0]).ravel()
