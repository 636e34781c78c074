"""What guards the guarantee of the bounded-error observer, each with a mutant that it catches."""

from dataclasses import replace
from fractions import Fraction
from itertools import product

import numpy as np
import pytest

import obsynth as ob
from obsynth.designs.bounded_error.lmis import (
    build_error_system,
)
from obsynth.designs.bounded_error.model import NoiseBox, read
from obsynth.designs.bounded_error.record import UioDesign
from obsynth.designs.bounded_error.step import build_core, running_bound
from obsynth.designs.bounded_error.synthesis import analyse_gain, synthesise
from obsynth.designs.core.step import Step


@pytest.fixture(scope="module")
def design(base):
    return UioDesign.from_record(base.record)


@pytest.fixture(scope="module")
def run(tank, base, alone):
    return ob.simulate(tank, alone(base), ob.scenarios.quadruple_tank("FS2"), seed=0)


def recursion_residual(design, tank_split, run, Wbar, shift=0):
    """Largest violation of eq. (16) along a simulated run."""
    system = build_error_system(design.data.without_nonlinearity(), "plain")
    X = system.Abar[0] - design.gain("plain") @ system.Cbar
    Z = (Wbar - design.gain("plain") @ system.Vbar) / design.data_scale
    Y = np.vstack([design.T, np.zeros((2, 4))])
    g = tank_split.g_function().map(len(run.x))
    s = np.array(g(run.x.T, run.u.T) - g(run.xhat.T, run.u.T)).T
    error = np.hstack([run.x - run.xhat, run.f - run.fhat])
    rates = np.diff(run.f, axis=0)
    last = len(rates) - 1
    now, later = slice(0, last), slice(1 + shift, last + 1 + shift)
    v = np.hstack([run.w[now], rates[now], run.w[later]])
    predicted = error[now] @ X.T + s[now] @ Y.T + v @ Z.T
    return np.abs(error[1 : last + 1] - predicted).max()


@pytest.fixture(scope="module")
def scaled(design):
    """The design with the radii of v attached, to undo the scaling of the error system."""
    stacked = np.concatenate([design.w_radius, design.rate, design.w_radius])
    object.__setattr__(design, "data_scale", stacked)
    return design


def test_error_recursion_16(scaled, tank_split, run):
    Wbar = build_error_system(scaled.data.without_nonlinearity(), "plain").Wbar
    assert recursion_residual(scaled, tank_split, run, Wbar) < 1e-12


def test_error_recursion_16_with_the_printed_third_block_fails(scaled, tank_split, run):
    Wbar = build_error_system(scaled.data.without_nonlinearity(), "plain").Wbar.copy()
    Wbar[:4, -3:] = scaled.E @ np.zeros((3, 3))  # E W1, as (18) prints it
    assert recursion_residual(scaled, tank_split, run, Wbar) > 0.05


def test_error_recursion_16_with_a_set_of_the_next_instant_fails(scaled, tank_split, run):
    Wbar = build_error_system(scaled.data.without_nonlinearity(), "plain").Wbar
    assert recursion_residual(scaled, tank_split, run, Wbar, shift=1) > 0.05


def test_h3_is_not_covered_with_the_printed_third_block(scaled, run):
    system = build_error_system(scaled.data, "plain")
    Wbar = system.Wbar.copy()
    Wbar[..., :4, -3:] = 0.0
    noise = NoiseBox(scaled.w_centre, scaled.w_radius, scaled.rate).equal_weights()
    mutant = synthesise(
        replace(system, Wbar=Wbar), 0.005, noise, "trace_inverse", np.array([1, 1, 1, 1, 1, 1.0])
    )
    width = np.sqrt(mutant.inverse_diagonal[2])
    assert np.abs(run.x - run.xhat)[2000:, 2].max() > width


def test_step_is_the_observer_of_the_paper(base, alone, design, tank_split, run):
    """(10)-(12) with N, G, L, T and g, against the step, from the same memory."""
    base = alone(base)
    g = tank_split.g_function()
    gains, layout = base.gains, base.memory_layout
    scenario = ob.scenarios.quadruple_tank("FS2")
    memory = base.memory0(scenario.guess, x_range=scenario.x_range, f_range=scenario.f_range)
    for k in range(50):
        z, fhat = memory[layout["z"]], memory[layout["fhat"]]
        xhat = z - gains["E"] @ run.y[k]
        expected = (
            gains["N"] @ z
            + gains["G"] @ run.u[k]
            + gains["L"] @ run.y[k]
            + gains["T"] @ design.B_f @ fhat
            + gains["T"] @ np.array(g(xhat, run.u[k])).ravel()
        )
        out = base.step(memory, run.u[k], run.y[k])
        memory = np.array(out[0]).ravel()
        np.testing.assert_allclose(np.array(out[1]).ravel(), xhat, atol=1e-12)
        np.testing.assert_allclose(memory[layout["z"]], expected, atol=1e-11)
        new = fhat + gains["F"] @ (run.y[k] - design.C @ xhat)
        np.testing.assert_allclose(memory[layout["fhat"]], new, atol=1e-12)


@pytest.mark.parametrize("shift", [-1, 1])
def test_a_set_reported_for_another_instant_is_not_covered(given_peak, tank, shift):
    run = ob.simulate(tank, given_peak, ob.scenarios.quadruple_tank("FS1"), seed=0)
    lower, upper = np.roll(run.x_lower, shift, axis=0), np.roll(run.x_upper, shift, axis=0)
    inside = (lower <= run.x) & (run.x <= upper)
    assert ((run.x_lower <= run.x) & (run.x <= run.x_upper)).all()
    assert not inside[5:-5, 2].all()


def admissible(tank, observer, seed, steps=400):
    """Random admissible trajectories: bang-bang noise, faults that walk at their rate."""
    rng = np.random.default_rng(seed)
    scenario = ob.scenarios.quadruple_tank("FS1")
    rates = np.array([s.rate for s in tank.f])
    increments = rng.choice([-1.0, 1.0], (steps, 2)) * rates
    faults = np.vstack([np.zeros(2), np.cumsum(increments, axis=0)])
    corners = np.array([rng.choice(pair) for pair in scenario.x_range])
    noise = rng.choice([-0.1, 0.1], (steps + 1, 3))
    return replace(
        scenario,
        name=f"random {seed}",
        steps=steps,
        x0=corners,
        inputs=scenario.inputs[: steps + 1],
        faults=faults,
        unknown_inputs=rng.uniform(-0.5, 0.5, (steps + 1, 1)),
        disturbances=noise,
    )


@pytest.mark.parametrize("which", ["base", "given_peak"])
def test_random_admissible_trajectories_are_inside_from_the_first_instant(which, tank, request):
    observer = request.getfixturevalue(which)
    for seed in range(8):
        run = ob.simulate(tank, observer, admissible(tank, observer, seed), seed=seed)
        assert min(run.coverage.values()) == 1.0, f"seed {seed}"


def test_a_start_box_that_is_too_small_is_noticed(given_peak, alone, tank):
    given_peak = alone(given_peak)
    scenario = admissible(tank, given_peak, 0)
    small = 0.2 * (scenario.x_range - scenario.guess[:, None]) + scenario.guess[:, None]
    run = ob.simulate(tank, given_peak, replace(scenario, x_range=small), seed=0)
    assert run.status[0] & 8


# -- certificates ------------------------------------------------------------------------------


def step(observer, memory, u=(10.0, 10.0), y=(128.0, 168.0, 30.0)):
    names = ("memory_next", "xhat", "fhat", "x_lower", "x_upper", "f_lower", "f_upper", "status")
    values = observer.step(memory, list(u), list(y))
    return {name: np.array(v).ravel() for name, v in zip(names, values, strict=True)}


def test_not_initialised(base):
    out = step(base, np.zeros(base.step.size1_in(0)))
    assert int(out["status"][0]) & 1
    assert np.all(np.isinf(out["x_lower"]))
    assert np.all(out["memory_next"] == 0)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_missing_reading_leaves_what_the_equations_say(base, alone, bad):
    box = np.array([[115, 135], [155, 175], [15, 35], [25, 45]])
    for observer in (base, alone(base)):
        memory = observer.memory0([125, 165, 25, 35], x_range=box)
        good = step(observer, memory)
        out = step(observer, good["memory_next"], y=(128.0, bad, 30.0))
        assert int(out["status"][0]) & (2 | 8 | 32) == 32
        assert np.all(np.isfinite(out["xhat"])) and np.all(np.isfinite(out["memory_next"]))
        later = step(observer, out["memory_next"])
        assert np.all(np.isfinite(later["xhat"])) and np.all(np.isfinite(later["x_upper"]))
        # without the equations nothing bounds a fault whose range is not declared
        assert np.all(np.isfinite(later["f_upper"])) == (observer is base)


def test_a_missing_input_begins_the_sets_anew(base):
    memory = base.memory0(
        [125, 165, 25, 35], x_range=np.array([[115, 135], [155, 175], [15, 35], [25, 45]])
    )
    out = step(base, memory, u=(np.nan, 10.0))
    assert int(out["status"][0]) & 2
    assert np.all(np.isfinite(out["x_lower"]))
    later = step(base, out["memory_next"])
    assert later["x_upper"][3] - later["x_lower"][3] == pytest.approx(95, rel=1e-9)
    assert int(later["status"][0]) == 16


def test_an_impossible_measurement_is_flagged(given_peak):
    box = np.array([[124, 126], [164, 166], [24, 26], [34, 36.0]])
    memory = given_peak.memory0([125, 165, 25, 35], x_range=box)
    first = step(given_peak, memory, y=(125, 165, 25))
    far = 125 + 5 * (first["x_upper"][0] - first["x_lower"][0]) + 5
    assert int(step(given_peak, memory, y=(125, 165, 25))["status"][0]) & 8 == 0
    assert int(step(given_peak, memory, y=(far, 165, 25))["status"][0]) & 8


def test_leaving_the_domain_is_flagged_and_survived(base):
    memory = base.memory0([125, 165, 25, 35])
    out = step(base, memory, y=(-50.0, 20.0, -4.0))
    assert int(out["status"][0]) & 8
    assert np.all(np.isfinite(out["memory_next"]))


@pytest.mark.long
def test_bounds_return_after_a_missing_measurement(alone):
    plant = ob.Plant("tank")
    (h,) = plant.states("h", range=(10, 100))
    (v,) = plant.inputs("v", range=(0, 10), nominal=5)
    plant.actuator_faults("f", of=v, rate=0.01, range=(-2, 2))
    (w,) = plant.disturbances("w", bound=0.1)
    plant.dynamics([0.1 * v - 0.1 * h**0.5])
    plant.outputs([h + w])
    observer = ob.BoundedErrorUIO(form="corrected").design(plant.discretise("euler", Ts=1.0))
    for one in (observer, alone(observer)):
        memory = one.memory0([40], x_range=[[30, 50]])
        lost = step(one, memory, u=[5], y=[np.nan])
        assert (lost["x_lower"][0], lost["x_upper"][0]) == (30, 50)
        back = step(one, lost["memory_next"], u=[5], y=[40.0])
        assert np.isfinite(back["x_upper"][0])
        far = np.array(lost["memory_next"])
        far[one.memory_layout["fhat"]] = 3000.0
        # an estimate far off is of no use: it is placed anew
        again = step(one, far, u=[5], y=[40.0])
        assert -2 <= again["fhat"][0] <= 2
        assert again["f_lower"][0] <= -2 < 2 <= again["f_upper"][0] or one is observer


def test_rounding_of_a_step_is_within_its_allowance(base, design, run):
    """One step in doubles against the same step in exact arithmetic with 60-digit roots."""
    import sympy as sp

    model = base.model
    values = model.constant_values
    rows = [
        row.subs(dict.fromkeys([s.symbol for s in (*model.d, *model.w)], 0)) for row in model.rhs
    ]
    rng = np.random.default_rng(0)
    layout = base.memory_layout
    for k in rng.integers(10, 5000, 5):
        memory = np.zeros(base.step.size1_in(0))
        z = design.T @ run.xhat[k]
        memory[layout["z"]], memory[layout["fhat"]] = z, run.fhat[k]
        memory[layout["initialised"]] = 1.0
        after = step(base, memory, run.u[k], run.y[k])["memory_next"]
        exact = [
            [sp.Rational(float(v)) for v in row] for row in (z, run.y[k], run.u[k], run.fhat[k])
        ]
        E, C, T, K = (
            sp.Matrix(m).applyfunc(sp.Rational) for m in (design.E, design.C, design.T, design.K)
        )
        xhat = sp.Matrix(exact[0]) - E * sp.Matrix(exact[1])
        point = dict(
            zip(
                [s.symbol for s in (*model.x, *model.u, *model.f)],
                [*xhat, *exact[2], *exact[3]],
                strict=True,
            )
        )
        next_state = sp.Matrix([row.subs(values).subs(point).evalf(40) for row in rows])
        true = T * next_state + K * (sp.Matrix(exact[1]) - C * xhat)
        lost = [
            abs(sp.Float(float(a), 40) - b) for a, b in zip(after[layout["z"]], true, strict=True)
        ]
        assert np.all(np.array(lost, dtype=float) <= design.rounding[:4])


def test_a_step_without_the_fault_is_not_certified_by_chance(base, alone, tank):
    """Coverage is lost if the deployed step is not the proved one (a sign of F flipped)."""
    observer = alone(base)
    design = observer.certificate.design
    core = build_core(replace(design, F=-design.F))
    mutant = Step(observer.certificate.contract.guard(design), core).build()
    scenario = ob.scenarios.quadruple_tank("FS1")
    run = ob.simulate(tank, replace(observer, step=mutant), scenario, seed=0)
    assert min(run.coverage.values()) < 1.0 or np.any(run.status & 8)


def test_shifted_error_recursion(design, tank_split, run):
    """zeta = T x - z follows its own recursion, without w_{k+1}."""
    still = build_error_system(design.data.without_nonlinearity(), "shifted")
    scale = np.concatenate([design.w_radius, design.rate])
    kept = [0, 1, 3]
    gain = np.vstack([design.K[kept], design.F])
    X, Z = still.Abar[0] - gain @ still.Cbar, (still.Wbar[0] - gain @ still.Vbar) / scale
    error = run.x - run.xhat
    zeta = error - run.w @ (design.E @ design.W2).T
    g = tank_split.g_function().map(len(run.x))
    s = np.array(g(run.x.T, run.u.T) - g(run.xhat.T, run.u.T)).T
    xi = np.hstack([zeta[:, kept], run.f - run.fhat])
    v = np.hstack([run.w[:-1], np.diff(run.f, axis=0)])
    # column 3 of K and zeta_3 vanish for k >= 1, up to the solver's last digits
    predicted = (
        xi[:-1] @ X.T + v @ Z.T + np.hstack([s[:-1] @ design.T.T[:, kept], np.zeros((5000, 2))])
    )
    assert np.abs(xi[1:] - predicted)[1:].max() < 1e-4


@pytest.mark.long
def test_the_best_trace_of_a_given_gain_is_log_convex_in_gamma(base, tank_split, tank_bounds):
    """Why the search over gamma has one minimum when the gain is given."""
    prepared = read(tank_split, tank_bounds)
    system = build_error_system(prepared.design.data, "plain")
    noise = ob.BoundedErrorUIO._noise(prepared, system.blocks)
    gain = np.vstack([base.gains["K"], base.gains["F"]])
    weights = np.ones(len(gain))
    gammas = [0.001, 0.0025, 0.004, 0.0055]
    traces = [
        synthesise(system, g, noise, "trace_inverse", weights, gain).inverse_diagonal.sum()
        for g in gammas
    ]
    values = np.log(traces)
    # second differences far above what the solver's accuracy could hide
    assert np.diff(values, 2).min() > 1e-4
    best = analyse_gain(system, gain, noise, weights)
    assert best.inverse_diagonal.sum() <= min(traces) * (1 + 1e-3)


def test_the_recursion_of_the_ellipsoid_counts_the_rounding_of_a_step(design):
    """xi+ moved by tau raises V+ to (sqrt(V+) + rho)^2 at most; mutant: no rho in the offset."""
    rough = replace(design, rounding=np.full_like(design.rounding, 1e-3))
    bound, ellipsoid = running_bound(rough), design.bound
    P, gamma = ellipsoid.P[0], float(ellipsoid.gamma[0])
    tau = rough.rounding
    rho = np.sqrt(max(s @ P @ s for s in tau * np.array(list(product((-1, 1), repeat=len(tau))))))
    for V in np.linspace(0.0, 3.0, 61):
        moved = (np.sqrt((1 - gamma) * V + gamma) + rho) ** 2
        assert np.all(bound.decay @ np.full(len(tau), V) + bound.offset >= moved)


@pytest.mark.parametrize("options", [{"bounds": "peak", "form": "corrected"}, {"gamma": 0.05}])
def test_a_fault_without_a_range_may_have_a_coefficient_that_is_no_double(options):
    """1/3 rounds, times a fault of 1e6: more than 2^-40 of the states.

    Mutant: the allowance of the step alone, which ends in an unproved claim.
    """
    plant = ob.Plant("a third of a fault")
    x, z = plant.states("x z", range=(-5, 5))
    (f,) = plant.faults("f", rate=0.01)
    (w,) = plant.disturbances("w", bound=0.1)
    plant.dynamics([x / 2 + f / 3 + w, z / 3 + x / 7], Ts=1)
    plant.outputs([x, z])
    observer = ob.BoundedErrorUIO(**options).design(plant)
    design = observer.certificate.design
    lost = float(1e6 * abs(Fraction(1, 3) - Fraction(1 / 3)))
    assert lost > 2.0**-40 * 5
    if "gamma" in options:
        assert design.rounding[0] > lost
        assert observer.certificate.check()["matrix_rounding"].holds
    else:
        # the constants that the equations have, in the bound of every instruction
        assert design.rounding.p[0] > lost and observer.certificate.check()["rounding"].holds
