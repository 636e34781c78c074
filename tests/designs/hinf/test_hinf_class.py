"""The class of plants: several faults, unknown inputs, states without range, nonlinear inputs."""

import numpy as np
import pytest
import sympy as sp

import obsynth as ob
from obsynth.designs import SolverTrouble
from obsynth.designs.hinf import synthesis


def two_faults(unknown=True):
    """Five states, two faults and, if asked for, an unknown input; a nonlinearity in three rows."""
    plant = ob.Plant("two faults")
    x = plant.states("x1:6")
    (v,) = plant.inputs("v", range=(-1, 1), nominal=0)
    f = plant.faults("f1:3")
    d = plant.unknown_inputs("d")[0] if unknown else 0
    w = plant.disturbances("w1:4")
    R = sp.Rational
    plant.dynamics(
        [
            R(1, 2) * x[0] + R(1, 5) * x[3] + f[0] + R(1, 10) * sp.sin(x[4] + v) + w[0] / 10,
            R(3, 10) * x[1] + R(1, 5) * x[0] + f[1] - R(1, 10) * f[0] + w[1] / 5,
            R(2, 5) * x[2] + R(1, 10) * x[3] + d,
            R(3, 5) * x[3] + R(1, 10) * sp.atan(x[3]) + w[2] / 2,
            R(1, 4) * x[4] + R(1, 5) * x[3] + R(1, 20) * sp.tanh(x[4]) + w[0] / 3,
        ],
        Ts=1,
    )
    plant.outputs([x[0], x[1], x[2], x[3] + x[4]])
    return plant


@pytest.fixture(scope="module")
def plant():
    return two_faults()


@pytest.fixture(scope="module")
def observer(plant):
    return ob.HinfUIO(method="general").design(plant)


def simulate(plant, observer, unknown):
    rng = np.random.default_rng(1)
    samples = 201
    scenario = ob.Scenario(
        "walk",
        samples - 1,
        x0=np.zeros(5),
        guess=np.zeros(5),
        inputs=rng.uniform(-1, 1, (samples, 1)),
        faults=np.cumsum(rng.standard_normal((samples, 2)), axis=0),
        unknown_inputs=unknown * rng.standard_normal((samples, 1)),
        disturbances=rng.standard_normal((samples, 3)),
    )
    return ob.simulate(plant, observer, scenario)


def test_the_unknown_input_leaves_no_trace(plant, observer):
    """|f - fhat| <= mu |w| for both faults together, whatever d does."""
    quiet, loud = (simulate(plant, observer, size) for size in (0.0, 1e3))
    for run in (quiet, loud):
        error = run.f[:-1] - run.fhat[1:]
        ratio = np.linalg.norm(error) / np.linalg.norm(run.w[:-1])
        assert 0.01 < ratio <= observer.performance["l2_gain"]
    np.testing.assert_allclose(loud.fhat, quiet.fhat, atol=1e-9)
    assert np.abs(loud.x[:, 2] - quiet.x[:, 2]).max() > 1e3
    assert observer.gains["H"].shape == (2, 4)


def test_without_decoupling_it_does(plant, observer):
    """The mutant: the gains of the same plant whose d is not declared."""
    ignorant = ob.HinfUIO(method="general").design(two_faults(unknown=False))
    assert ignorant.performance["l2_gain"] <= observer.performance["l2_gain"] * (1 + 1e-6)
    C, D = np.eye(4, 5), np.eye(5)[:, 2:3]
    C[3, 4] = 1.0
    kept = np.eye(5) - ignorant.gains["F"] @ C
    sound = np.eye(5) - observer.gains["F"] @ C
    assert np.abs(sound @ D).max() < 1e-12 < 0.1 < np.abs(kept @ D).max()


def test_worst_case_of_two_faults(observer):
    found = ob.worst_case(observer, steps=2000, points=64)
    assert 0.9 * observer.performance["l2_gain"] < found.gain <= observer.performance["l2_gain"]


def test_states_without_range_and_a_nonlinear_input(observer, tmp_path):
    """Slopes of sin, atan and tanh are bounded everywhere, so no box of the states is needed."""
    ranges = np.array(observer.record["family"]["ranges"])
    assert np.abs(ranges).max() <= 0.1 + 1e-6
    path = tmp_path / "design.json"
    observer.save(path)
    assert ob.load(path).certificate.check().valid
    text = str(observer.guarantee)
    assert "x1 in [-inf, inf]" in text and "v in [-1, 1] [monitored" in text


def test_a_given_split(plant):
    """Another linear part is another description of the same plant."""
    point = (np.zeros(5), np.zeros(1))
    about = ob.split(plant, at=point, linear="jacobian")
    first = ob.HinfUIO(method="polytopic").design(plant)
    second = ob.HinfUIO(method="polytopic").design(about)
    assert second.record["linear"] == "jacobian"
    assert second.performance["least_mu"] == pytest.approx(first.performance["least_mu"], rel=1e-4)
    assert second.certificate.check().valid


def pendulum():
    """Angle and speed measured, the torque fails; discretised by Euler."""
    plant = ob.Plant("pendulum")
    phi, omega = plant.states("phi omega", range=[(-3, 3), (-10, 10)])
    (v,) = plant.inputs("v", range=(-5, 5), nominal=0)
    plant.actuator_faults("f", of=[v])
    w = plant.disturbances("w1:3")
    plant.dynamics([omega + w[0], 10 * v - 9.81 * sp.sin(phi) - omega / 5 + w[1]])
    plant.outputs([phi, omega])
    return plant.discretise("euler", 0.01)


def test_a_pendulum_reaches_what_no_filter_can_beat():
    """w2 enters beside 10 f, so .1 is a bound for every filter; D makes up for the last sample."""
    plant = pendulum()
    general = ob.HinfUIO(method="general", slack=1e-4).design(plant)
    standard = ob.HinfUIO(method="polytopic", slack=1e-4).design(plant)
    assert 0.1 <= general.performance["l2_gain"] < 0.10002
    assert standard.performance["l2_gain"] > 0.1004
    for observer in (general, standard):
        found = ob.worst_case(observer, steps=2000, points=32)
        assert 0.999 * observer.performance["l2_gain"] < found.gain
        assert found.gain <= observer.performance["l2_gain"]


@pytest.mark.parametrize("options", [{"method": "general"}, {"multipliers": "per_row"}])
def test_where_the_solver_finds_no_minimum(options, monkeypatch):
    """The level is found by margins alone, and the filter is proved all the same."""

    def trouble(problem, *, floor, gap):
        raise SolverTrouble("no minimum")

    plant = ob.plants.hinf_example()
    least = ob.HinfUIO(**options).design(plant).performance["least_mu"]
    monkeypatch.setattr(synthesis, "solve_reliably", trouble)
    observer = ob.HinfUIO(**options).design(plant)
    assert observer.certificate.valid
    assert least <= observer.performance["least_mu"] <= least * (1 + 2e-4)


def many(n=14):
    """A chain of n tanks, each with a slope of its own: 2^n vertices."""
    plant = ob.Plant("chain")
    x = plant.states(f"x1:{n + 1}", range=(-3, 3))
    (f,), w = plant.faults("f"), plant.disturbances("w1:3")
    rows = [sp.Rational(1, 2) * x[0] + f + w[0] / 10]
    rows += [
        sp.Rational(2, 5) * a + b / 10 + sp.sin(a) / 20 for a, b in zip(x[1:], x, strict=False)
    ]
    rows[0] += sp.sin(x[1]) / 10 + w[1]
    plant.dynamics(rows, Ts=1)
    plant.outputs([x[0], x[1]])
    return plant


@pytest.mark.long
def test_more_vertices_than_can_be_used():
    plant = many()
    with pytest.raises(ob.InfeasibleDesign, match="8192 vertices") as caught:
        ob.HinfUIO(method="polytopic").design(plant)
    assert "per_entry" in str(caught.value)
    observer = ob.HinfUIO(multipliers="per_entry").design(plant)
    assert observer.certificate.valid
    assert len(observer.record["bound"]["tau"]) == 14


def test_a_set_with_many_vertices_is_found_lazily_and_proved_whole():
    """256 vertices: a few are stated, all are proved, and P stays far below its cap."""
    observer = ob.HinfUIO(method="polytopic").design(many(9))
    assert "all 256 vertices" in observer.certificate["lmi"].statement
    assert observer.certificate.valid
    assert observer.performance["least_mu"] == pytest.approx(1.005006, abs=3e-5)
    assert observer.performance["trace_P"] < 1e7
