"""The simulation against a naive loop, its refusals, and what it says about its own truth."""

import casadi as ca
import numpy as np
import pytest

from obsynth.codegen.kernel import dense
from obsynth.evaluate import SimulationError, simulate
from obsynth.symbolic import Plant

CLAIMS = ("xhat", "fhat", "x_lower", "x_upper", "f_lower", "f_upper")


def naive(plant, observer, scenario, seed):
    """The contract's time convention, written out with NumPy calls of the functions."""
    arrays = scenario.arrays(plant, seed)
    step, function = observer.step, plant.function()
    x = np.array(scenario.x0, dtype=float)
    memory, rows = None, []
    for k in range(scenario.steps + 1):
        d, f, w = (arrays[key][k] for key in "dfw")
        u = arrays["u"][k]
        following, y = (np.array(v).ravel() for v in function(x, u, d, f, w, [], []))
        if memory is None:
            memory = observer.memory0(
                scenario.guess, x_range=scenario.x_range, f_range=scenario.f_range, y0=y
            )
        memory, *claims = (np.array(v).ravel() for v in step(memory, u, y))
        rows.append([x, y, *claims])
        x = following
    return dict(
        zip(("x", "y", *CLAIMS, "status"), map(np.array, zip(*rows, strict=True)), strict=True)
    )


@pytest.mark.parametrize("delay", [0, 1])
def test_simulate_equals_a_naive_loop_to_the_last_bit(toy, delay):
    observer = toy.observer(toy.plant, fault_delay=delay)
    run = simulate(toy.plant, observer, toy.scenario(), seed=7)
    expected = naive(toy.plant, observer, toy.scenario(), 7)
    for key in ("x", "y", *CLAIMS):
        np.testing.assert_array_equal(getattr(run, key), expected[key], err_msg=key)
    np.testing.assert_array_equal(run.status, expected["status"].ravel().astype(int))
    assert run.t[3] == 1.5


def test_seeds_decide_the_disturbances(toy):
    observer = toy.observer(toy.plant)
    first, again, other = (simulate(toy.plant, observer, toy.scenario(), seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(first.w, again.w)
    np.testing.assert_array_equal(
        first.w, np.random.default_rng(1).uniform(-0.1, 0.1, (toy.N + 1, 1))
    )
    assert not np.array_equal(first.w, other.w)


def test_inputs_as_a_function_of_k_equal_the_array(toy):
    observer = toy.observer(toy.plant)
    array = simulate(toy.plant, observer, toy.scenario())
    called = simulate(toy.plant, observer, toy.scenario(inputs=lambda k: [np.sin(k / 7.0)]))
    np.testing.assert_array_equal(array.x, called.x)


def test_feedback_sees_the_measurement_of_the_same_instant(toy):
    observer = toy.observer(toy.plant)
    scenario = toy.scenario(inputs=lambda k, y: [-0.5 * y[0]], feedback=True)
    run = simulate(toy.plant, observer, scenario, seed=0)
    np.testing.assert_array_equal(run.u, -0.5 * run.y)
    following = 0.9 * run.x[:-1, 0] + 0.1 * np.sin(run.x[:-1, 1]) + run.u[:-1, 0] + run.f[:-1, 0]
    np.testing.assert_allclose(run.x[1:, 0], following, rtol=0, atol=1e-12)


def test_feedback_through_a_direct_feedthrough_is_an_algebraic_loop():
    plant = Plant("direct")
    (a,) = plant.states("a", range=(-1, 1))
    (v,) = plant.inputs("v")
    plant.dynamics([a / 2], Ts=1)
    plant.outputs([a + v])

    class Step:
        model, method, fault_delay, half_widths = plant, "toy", 0, None
        ode, step_covered = None, False
        m, u, y = ca.SX.sym("m"), ca.SX.sym("u"), ca.SX.sym("y")
        none = ca.SX(0, 1)
        step = ca.Function(
            "step",
            [m, u, y],
            [m, y, none, y, y, none, none, 0 * y],
            ["memory", "u", "y"],
            ["next", *CLAIMS, "status"],
        )

        def memory0(self, guess, x_range=None, f_range=None, y0=None):
            return np.zeros(1)

    from obsynth.symbolic import Scenario

    loop = Scenario("loop", 5, x0=[0.5], guess=[0], inputs=lambda k, y: y, feedback=True)
    with pytest.raises(SimulationError, match=r"y1 depends on v.*algebraic loop"):
        simulate(plant, Step(), loop)
    held = Scenario("held", 5, x0=[0.5], guess=[0], inputs=np.zeros((6, 1)))
    assert simulate(plant, Step(), held).x[-1, 0] == 0.5**6


def test_continuous_truth_is_integrated_and_marked():
    import sympy as sp

    plant = Plant("tank")
    (h,) = plant.states("h", range=(0.1, 9), unit="cm")
    (v,) = plant.inputs("v", range=(0, 5), nominal=2)
    plant.dynamics([v - sp.sqrt(h)])
    plant.outputs([h])
    model = plant.discretise("euler", Ts=0.5)

    class Copy:
        method, fault_delay, half_widths = "copy", 0, None
        ode, step_covered = None, False
        m, u, y = ca.SX.sym("m"), ca.SX.sym("u"), ca.SX.sym("y")
        none = ca.SX(0, 1)
        step = ca.Function(
            "step",
            [m, u, y],
            [m, y, none, y, y, none, none, 0 * y],
            ["memory", "u", "y"],
            ["next", *CLAIMS, "status"],
        )

        def __init__(self, model):
            self.model = model

        def memory0(self, guess, x_range=None, f_range=None, y0=None):
            return np.zeros(1)

    from obsynth.symbolic import Scenario

    scenario = Scenario("fill", 8, x0=[1.0], guess=[1.0], inputs=np.full((9, 1), 2.0))
    coarse, fine = (simulate(plant, Copy(model), scenario, substeps=s).x[-1, 0] for s in (1, 64))
    # sqrt(h) = s: 2 s s' = 2 - s, so t = -2 (s - 1) - 4 ln((2 - s) / 1) from s = 1
    from scipy.optimize import brentq

    s = brentq(lambda s: -2 * (s - 1) - 4 * np.log(2 - s) - 4.0, 1.0, 2.0 - 1e-9)
    assert abs(fine - s**2) < 1e-9
    assert 1e-9 < abs(coarse - fine) < 1e-3
    run = simulate(model, Copy(model), scenario, substeps=4)
    assert "continuous plant" in run.truth
    assert "discretisation" in run.outside[0]
    own = simulate(model, Copy(model), scenario)
    assert own.outside == ()
    assert "own discrete model" in own.truth
    other = simulate(plant.discretise("rk4", Ts=0.5), Copy(model), scenario)
    assert "not the model" in other.outside[0]
    assert other.x[-1, 0] == pytest.approx(coarse, abs=1e-12)
    with pytest.raises(SimulationError, match="is a continuous plant: give substeps="):
        simulate(plant, Copy(model), scenario)
    with pytest.raises(SimulationError, match=r"sample time 0\.25"):
        simulate(plant.discretise("euler", Ts=0.25), Copy(model), scenario)


@pytest.mark.parametrize("substeps", [0, -1, 1.5, True])
def test_substeps_have_to_be_a_positive_whole_number(toy, substeps):
    with pytest.raises(SimulationError, match=r"substeps=.* is not a positive whole number"):
        simulate(toy.plant, toy.observer(toy.plant), toy.scenario(), substeps=substeps)


def test_a_plant_declared_in_discrete_time_has_no_substeps(toy):
    with pytest.raises(SimulationError, match="declared in discrete time"):
        simulate(toy.plant, toy.observer(toy.plant), toy.scenario(), substeps=2)


@pytest.mark.parametrize(
    ("engine", "message"),
    [("joint", "needs a continuous-time method"), ("fast", "is not known")],
)
def test_other_engines_are_refused(toy, engine, message):
    with pytest.raises(SimulationError, match=message) as error:
        simulate(toy.plant, toy.observer(toy.plant), toy.scenario(), engine=engine)
    assert error.value.engine == engine


def test_misshapen_and_non_finite_data_are_refused_by_name(toy):
    observer = toy.observer(toy.plant)
    faults = np.zeros((toy.N + 1, 1))
    faults[17] = np.nan
    cases = {
        "faults": ({"faults": faults}, ValueError),
        "inputs": ({"inputs": lambda k: [1.0, 2.0]}, ValueError),
        "unknown_inputs": ({"unknown_inputs": np.zeros((5, 1))}, ValueError),
        "guess": ({"guess": [1.0, 2.0, 3.0]}, ValueError),
        "disturbances": ({"disturbances": lambda rng, k: [np.inf]}, ValueError),
    }
    for field, (change, kind) in cases.items():
        with pytest.raises(kind, match=field):
            simulate(toy.plant, observer, toy.scenario(**change))


def test_a_feedback_that_returns_nonsense_is_refused_with_its_instant(toy):
    observer = toy.observer(toy.plant)
    wrong = toy.scenario(inputs=lambda k, y: [0.0] if k < 5 else [np.nan], feedback=True)
    with pytest.raises(SimulationError, match=r"inputs at k = 5.*v is nan"):
        simulate(toy.plant, observer, wrong)
    misshapen = toy.scenario(inputs=lambda k, y: [0.0, 1.0], feedback=True)
    with pytest.raises(SimulationError, match="inputs at k = 0 has shape"):
        simulate(toy.plant, observer, misshapen)


def test_another_plant_is_refused_with_both_lists_of_names(toy):
    other = Plant("other")
    (a,) = other.states("a", range=(0, 1))
    other.dynamics([a / 2], Ts=0.5)
    other.outputs([a])
    with pytest.raises(SimulationError, match=r"states of the model.*are not those"):
        simulate(other, toy.observer(toy.plant), toy.scenario())


def test_a_truth_that_is_no_number_any_more_is_refused_with_state_and_instant():
    import sympy as sp

    from obsynth.symbolic import Scenario

    plant = Plant("draining")
    (h,) = plant.states("h", range=(0.1, 2))
    plant.dynamics([h - sp.sqrt(h)], Ts=1.0)
    plant.outputs([h])

    class Blind:
        model, method, fault_delay, half_widths = plant, "blind", 0, None
        ode, step_covered = None, False
        m, u, y = ca.SX.sym("m"), ca.SX(0, 1), ca.SX.sym("y")
        u = ca.SX.sym("u", 0)
        none = ca.SX(0, 1)
        step = ca.Function(
            "step",
            [m, u, y],
            [m, y, none, y, y, none, none, 0 * y],
            ["memory", "u", "y"],
            ["next", *CLAIMS, "status"],
        )

        def memory0(self, guess, x_range=None, f_range=None, y0=None):
            return np.zeros(1)

    scenario = Scenario("drain", 6, x0=[0.5], guess=[0.5], inputs=np.zeros((7, 0)))
    with pytest.raises(SimulationError, match="h is nan at k = 2") as error:
        simulate(plant, Blind(), scenario)
    assert error.value.symbol == "h"


def test_a_scenario_that_breaks_a_declared_bound_says_so(toy):
    observer = toy.observer(toy.plant)
    assert simulate(toy.plant, observer, toy.scenario()).outside == ()
    jump = np.where(np.arange(toy.N + 1) < 30, 0.0, 0.5)[:, None]
    loud = np.zeros((toy.N + 1, 1))
    loud[40] = 0.3
    run = simulate(toy.plant, observer, toy.scenario(faults=jump, disturbances=loud, x0=[3, 0]))
    text = "\n".join(run.outside)
    assert "f moves by 0.5 from k = 29 to 30; its declared rate is 0.05" in text
    assert "w is outside its range [-0.1, 0.1] at 1 instants, first k = 40" in text
    assert "a is outside its assumed initial range [-1, 1]" in text
    early = simulate(toy.plant, observer, toy.scenario(faults=np.full((toy.N + 1, 1), 0.2)))
    assert "f is outside its assumed initial range [0, 0]" in early.outside[0]


def test_wrong_step_signatures_are_refused(toy):
    class Renamed(toy.observer):
        @property
        def step(self):
            good = super().step
            return ca.Function("s", good.sx_in(), good.call(good.sx_in()))

    with pytest.raises(SimulationError, match=r"step takes \(i0: \d, i1: 1, i2: 1\)"):
        simulate(toy.plant, Renamed(toy.plant), toy.scenario())

    class Swapped(toy.observer):
        @property
        def step(self):
            (m, v, y), out = super().step.sx_in(), super().step.name_out()
            found = super().step.call([m, y, v])
            return ca.Function("s", [m, y, v], found, ["memory", "y", "u"], out)

    with pytest.raises(SimulationError, match=r"takes \(memory: 6, y: 1, u: 1\) numbers"):
        simulate(toy.plant, Swapped(toy.plant), toy.scenario())

    class Short(toy.observer):
        def memory0(self, guess, x_range=None, f_range=None, y0=None):
            return np.zeros(2)

    with pytest.raises(SimulationError, match=r"memory0 has shape \(2,\); its step takes 6"):
        simulate(toy.plant, Short(toy.plant), toy.scenario())


def test_seeds_are_whole_numbers(toy):
    with pytest.raises(SimulationError, match="seed=-1"):
        simulate(toy.plant, toy.observer(toy.plant), toy.scenario(), seed=-1)


def test_sparse_functions_are_made_dense_before_buffers_write_them():
    x = ca.SX.sym("x", 3)
    sparse = ca.Function("sparse", [x], [ca.vertcat(x[0], ca.SX(1, 1), x[2])])
    assert sparse.nnz_out(0) == 2
    assert dense(sparse).nnz_out(0) == 3
    np.testing.assert_array_equal(np.array(dense(sparse)([1, 2, 3])).ravel(), [1, 0, 3])


def test_the_fastest_path_stays_fast(toy):
    """5001 instants through buffers; calls with NumPy arguments would take half a second."""
    import time

    observer = toy.observer(toy.plant)
    scenario = toy.scenario(steps=5000)
    simulate(toy.plant, observer, scenario)
    start = time.perf_counter()
    simulate(toy.plant, observer, scenario)
    assert time.perf_counter() - start < 0.3
