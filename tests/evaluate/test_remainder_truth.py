"""Simulations of the continuous plant against observers whose model carries its remainder."""

import json

import numpy as np
import pytest
import sympy as sp

import obsynth as ob


def pendulum():
    plant = ob.Plant("pendulum")
    x, v = plant.states("x v", range=[(-1, 1), (-2, 2)])
    (u,) = plant.inputs("u", range=(-1, 1), nominal=0)
    (f,) = plant.process_faults("f", range=(-0.5, 0.5), rate=0.2)
    w = plant.disturbances("w1:3", bound=0.01)
    plant.dynamics([v, -sp.sin(x) - v + u + f])
    plant.outputs([x + w[0], v + w[1]])
    return plant


@pytest.fixture(scope="module")
def observer():
    return ob.IntervalObserver().design(pendulum().discretise("euler", 0.1, remainder=True))


def scenario(disturbances=None):
    return ob.Scenario(
        "turns",
        steps=300,
        x0=[0.2, 0.0],
        guess=[0.2, 0.0],
        x_range=[(0.1, 0.3), (-0.1, 0.1)],
        inputs=lambda k: [0.3 * np.sin(k / 12)],
        faults=lambda k: [0.02 * min(max(k - 50, 0), 10)],
        disturbances=disturbances,
    )


def test_the_continuous_truth_is_inside_the_guarantee(observer):
    """Mutants: the remainder of the run with a state's index moved; the excuse kept."""
    model = observer.model
    run = ob.simulate(model, observer, scenario(), substeps=10)
    assert run.outside == () and "what a step leaves out is in the guarantee" in run.truth
    assert set(run.coverage.values()) == {1.0}
    # what the run shows as remainder is what the discrete plant leaves out, within its range
    for k in (0, 77, 200):
        rhs = model.function()(run.x[k], run.u[k], [], run.f[k], run.w[k], [], [])[0]
        np.testing.assert_allclose(np.array(rhs).ravel(), run.x[k + 1], rtol=0, atol=1e-15)
    ends = np.array([(s.lower, s.upper) for s in model.remainder])
    assert (np.abs(run.w[:-1, 2:]).max(axis=0) > 1e-3).all()
    assert ((run.w[:, 2:] >= ends[:, 0]) & (run.w[:, 2:] <= ends[:, 1])).all()
    # and without it the continuous plant is another one
    plain = model.continuous.discretise("euler", 0.1)
    with pytest.raises(ob.SimulationError, match="disturbances"):
        ob.simulate(plain, observer, scenario(), substeps=10)


def test_the_plant_behind_the_model_is_taken_as_it_is(observer):
    one, two = (
        ob.simulate(plant, observer, scenario(), substeps=5)
        for plant in (observer.model, observer.model.continuous)
    )
    np.testing.assert_array_equal(one.x, two.x)
    assert two.outside == ()


def test_scenarios_give_own_disturbances(observer):
    """Mutant: remainders filled with zeros where their middle is not zero."""
    noise = np.full((301, 2), 0.005)
    filled = scenario(noise).arrays(observer.model)["w"]
    ends = np.array([(s.lower, s.upper) for s in observer.model.remainder])
    np.testing.assert_array_equal(filled[:, :2], noise)
    np.testing.assert_array_equal(filled[:, 2:], np.tile(ends.mean(axis=1), (301, 1)))
    decay = ob.Plant("decay")
    decay.states("x", range=(1, 2))
    decay.disturbances("w", bound=1)
    decay.dynamics(["-x"])
    decay.outputs(["x + w"])
    (rest,) = decay.discretise("euler", 0.1, remainder=True).remainder
    start = {"x0": [1.5], "guess": [1.5], "inputs": np.zeros((3, 0))}
    given = ob.Scenario("decay", steps=2, disturbances=[[1]] * 3, **start)
    filled = given.arrays(decay.discretise("euler", 0.1, remainder=True))["w"]
    assert rest.lower > 0.0
    np.testing.assert_array_equal(filled, [[1.0, 0.5 * (rest.lower + rest.upper)]] * 3)
    run = ob.simulate(observer.model, observer, scenario(noise), substeps=5)
    assert set(run.coverage.values()) == {1.0}


def stored_step(data):
    """Find how the plant of a design was discretised, wherever a method keeps it."""
    if not isinstance(data, dict):
        return None
    return data.get("discretise") or next(filter(None, map(stored_step, data.values())), None)


def test_a_design_proves_its_remainder_and_says_which_plant_it_means(observer, tmp_path):
    """Mutant: the claim left away, or proved of the stored ranges alone."""
    assert observer.certificate["remainder"].holds
    said = "\n".join(observer.guarantee.claims)
    assumed = "\n".join(observer.guarantee.assumptions)
    assert "those of the continuous plant" in said and "remainder_v" in said
    assert "u, w1, w2 held over every step" in assumed
    assert "f within range and rate at all times" in assumed
    path = tmp_path / "o.json"
    observer.save(path)
    assert ob.load(path).certificate.check().valid
    record = json.loads(path.read_text())
    kept = stored_step(record)["remainder"]
    kept["v"] = [0.9 * end for end in kept["v"]]
    path.write_text(json.dumps(record))
    with pytest.raises(ob.CertificateError, match="remainder"):
        ob.load(path).certificate.check()


def test_reports_name_the_remainder(observer):
    from obsynth.evaluate.report import _plant_section

    assert "what a step leaves out is a disturbance: remainder_x in" in str(
        _plant_section(observer).__dict__
    )
