"""What the bounded-error observer refuses, with the user's own names and the remedy."""

import numpy as np
import pytest
import sympy as sp

import obsynth as ob
from obsynth.symbolic.errors import ObsynthError


def tank(outputs=(0, 1, 2), lowest=5.0, w_bound=0.1, rate=0.05, faults=True):
    plant = ob.Plant("quadruple tank")
    box = [(60, 280), (60, 280), (lowest, 100), (lowest, 100)]
    h = plant.states("h1:5", range=box, unit="cm")
    v = plant.inputs("v1:3", range=(0, 20), nominal=10, unit="V")
    (d,) = plant.unknown_inputs("d")
    if faults:
        plant.actuator_faults("f1:3", of=v, rate=rate)
    w = plant.disturbances(f"w1:{len(outputs) + 1}", bound=w_bound)
    root = [(2 * 981 * level) ** 0.5 for level in h]
    plant.dynamics(
        [
            (-0.071 * root[0] + 0.071 * root[2] + 0.565 * 3.235 * v[0]) / 28,
            (-0.051 * root[1] + 0.051 * root[3] + 0.47 * 3.32 * v[1]) / 32,
            (-0.071 * root[2] + 0.53 * 3.32 * v[1]) / 28 + d,
            (-0.051 * root[3] + 0.435 * 3.235 * v[0]) / 32,
        ]
    )
    plant.outputs([h[i] + w[j] for j, i in enumerate(outputs)])
    return plant.discretise("euler", Ts=1.0)


def no_solver(monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("the solver was called before the structural conditions")

    monkeypatch.setattr("obsynth.designs.lmi.problem.Problem.solve", refuse)


def test_rank_condition(monkeypatch):
    no_solver(monkeypatch)
    with pytest.raises(ob.StructureError, match=r"rank\(C D\)") as refusal:
        ob.BoundedErrorUIO(gamma=0.005).design(tank(outputs=(0, 1)))
    assert "h3" in str(refusal.value)
    assert "d" in refusal.value.symbols


def test_undetectable_fault(monkeypatch):
    no_solver(monkeypatch)
    with pytest.raises(ob.StructureError, match="f2"):
        ob.BoundedErrorUIO(gamma=0.005).design(tank(outputs=(0, 2, 3)))


def test_box_that_reaches_zero(monkeypatch):
    no_solver(monkeypatch)
    with pytest.raises(ob.UnboundedError) as refusal:
        ob.BoundedErrorUIO(gamma=0.005).design(tank(lowest=0.0))
    message = str(refusal.value)
    assert "h3" in message or "h4" in message


def test_continuous_plant():
    with pytest.raises(ob.StructureError, match="discretise"):
        ob.BoundedErrorUIO().design(ob.plants.quadruple_tank())


def test_disturbance_without_bound():
    with pytest.raises(ob.StructureError, match="w1"):
        ob.BoundedErrorUIO().design(tank(w_bound=None))


def test_fault_without_rate():
    with pytest.raises(ob.StructureError, match="f1, f2 has no bound"):
        ob.BoundedErrorUIO().design(tank(outputs=(0, 2), rate=None))


def test_faults_without_rate_are_divided_out_where_outputs_show_them():
    """f2 and the inflow both move tank 3, in no constant ratio: its row is a direction of its own.

    Mutant: what a fault does to another row taken a tenth too small.
    """
    observer = ob.BoundedErrorUIO(bounds="peak").design(tank(rate=None))
    rest, steps = ob.equilibrium(observer.model), 300
    rng = np.random.default_rng(0)
    faults = np.vstack([np.zeros(2), rng.uniform(2.0, 3.0, (steps, 2))])
    near = np.column_stack([rest.x - 1.0, rest.x + 1.0])
    inputs, inflow = np.tile(rest.u, (steps + 1, 1)), rng.uniform(-0.5, 0.5, (steps + 1, 1))
    scenario = ob.Scenario(
        "wild", steps, rest.x, rest.x, inputs, faults, unknown_inputs=inflow, x_range=near
    )
    run = ob.simulate(observer.model, observer, scenario, seed=1)
    assert run.kept and set(run.coverage.values()) == {1.0}
    assert 0.7 < observer.half_widths[3] < 0.9 and observer.half_widths[4] < 4.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gamma": 1.5}, "gamma is 1.5"),
        ({"gamma": 0.0}, "between 0 and 1"),
        ({"objective": "volume"}, "objective is 'volume'"),
        ({"form": "paper"}, "form is 'paper'"),
        ({"bounds": "box"}, "bounds is 'box'"),
        ({"weights": (0, 0)}, "not all zero"),
        ({"weights": (1, float("nan"))}, "finite"),
        ({"form": "printed", "error": "shifted"}, "stands for"),
    ],
)
def test_options(options, message):
    with pytest.raises(ObsynthError, match=message):
        ob.BoundedErrorUIO(**options)


def test_unknown_option_is_refused():
    with pytest.raises(ob.ObsynthError, match="no option 'gama'; 'gamma' is meant"):
        ob.BoundedErrorUIO(gama=0.1)


def test_weights_of_the_wrong_length(tank_split, tank_bounds):
    with pytest.raises(ObsynthError, match="6 are needed"):
        ob.BoundedErrorUIO(gamma=0.005, weights=(1, 1)).design(tank_split, tank_bounds)


@pytest.mark.parametrize(
    ("gains", "message"),
    [
        ({"K": np.zeros((4, 3))}, "F of shape"),
        ({"K": np.zeros((3, 3)), "F": np.zeros((2, 3))}, "K has shape"),
        ({"K": np.full((4, 3), np.nan), "F": np.zeros((2, 3))}, "finite"),
    ],
)
def test_gains_that_do_not_fit(tank_split, tank_bounds, gains, message):
    with pytest.raises(ObsynthError, match=message):
        ob.BoundedErrorUIO().analyse(tank_split, gains, tank_bounds)


@pytest.mark.parametrize("bounds", ["ellipsoid", "peak"])
def test_unstable_gains(tank_split, tank_bounds, bounds):
    gains = {"K": np.zeros((4, 3)), "F": -np.ones((2, 3))}
    with pytest.raises(ob.InfeasibleDesign):
        ob.BoundedErrorUIO(bounds=bounds).analyse(tank_split, gains, tank_bounds)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"guess": [1, 2, 3]}, "guess has to be 4 finite numbers"),
        ({"guess": [1, 2, 3, np.nan]}, "finite"),
        ({"guess": [1, 2, 3, 4], "x_range": [[0, 1]]}, "x_range has to be 4"),
        ({"guess": [1, 2, 3, 4], "x_range": [[1, 0]] * 4}, "lower <= upper"),
        ({"guess": [1, 2, 3, 4], "f_range": [[0, np.inf]] * 2}, "f_range"),
    ],
)
def test_memory0(base, arguments, message):
    with pytest.raises(ObsynthError, match=message):
        base.memory0(**arguments)


def test_problem_needs_gamma(tank_split, tank_bounds):
    with pytest.raises(ObsynthError, match="give gamma"):
        ob.BoundedErrorUIO().problem(tank_split, tank_bounds)


def test_problem_is_the_same_in_cvxpy(tank_split, tank_bounds, base):
    problem = ob.BoundedErrorUIO(gamma=0.005).problem(tank_split, tank_bounds)
    second = problem.to_cvxpy()
    second.solve(solver="CLARABEL")
    assert second.value / 0.005 == pytest.approx(base.performance["trace_P_inv"], rel=1e-3)


def test_no_fault_declared_is_a_plain_state_observer():
    model = tank(faults=False)
    observer = ob.BoundedErrorUIO(gamma=0.005).design(model)
    assert observer.half_widths.shape == (4,)
    assert observer.gains["F"].shape == (0, 3)
    assert observer.certificate.valid


@pytest.fixture(scope="module")
def two_tanks():
    """The level of the second is not measured: its error goes by 1 - Ts / (2 sqrt(h2)) a step."""
    plant = ob.Plant("two tanks in a row")
    h1, h2 = plant.states("h1 h2", range=(1, 9))
    (v,) = plant.inputs("v", range=(0, 4))
    plant.actuator_faults("f", of=v, rate=0.05)
    (w,) = plant.disturbances("w", bound=0.04)
    plant.dynamics([v - sp.sqrt(h1), sp.sqrt(h1) - sp.sqrt(h2)])
    plant.outputs([h1 + w])
    model = ob.split(plant.discretise("euler", Ts=0.1))
    return model, ob.jacobian_bounds(model)


# Of a design at gamma = 0.02.
GAINS = {"K": [[0.18], [0.044]], "F": [[0.155]]}


def test_a_gamma_little_above_the_largest_is_refused_by_it(two_tanks):
    """There the solver ends at its last iteration with values that violate the inequality.

    Mutant: such a design goes on to its certificate.
    """
    model, bounds = two_tanks
    method = ob.BoundedErrorUIO(gamma=0.034)
    for make in (method.design, lambda *given: method.analyse(model, GAINS, bounds)):
        with pytest.raises(ob.InfeasibleDesign, match="largest feasible gamma is abo") as refusal:
            make(model, bounds)
        assert refusal.value.largest_gamma == pytest.approx(1 - (1 - 0.1 / 6) ** 2, rel=2e-3)
