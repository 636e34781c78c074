"""The scheduled step as C: theta as inputs, vectors that reach the certified set."""

from dataclasses import replace

import numpy as np
import pytest

import obsynth as ob
from obsynth.symbolic.scenarios.qpv_example import _equilibrium


@pytest.fixture(scope="module")
def project(designed, tmp_path_factory):
    observer = designed("box_tight")
    memory = observer.memory0(
        [10, 10, 10], x_range=[(9.95, 10.05)] * 3, f_range=[(-0.05, 0.05)] * 3
    )
    folder = tmp_path_factory.mktemp("c") / "qpv"
    return ob.generate_c(observer, folder, memory=memory)


@pytest.mark.long
def test_all_recorded_steps_are_equal_to_the_last_bit(project):
    # estimates and level once, twice what the guard has of faults, its marks
    memory = 7 + 2 * (6 + 1) + 3
    assert dict(project.sizes) == {"memory": memory, "u": 3, "y": 3, "theta": 2, "x": 3, "f": 3}
    assert project.vectors == 3000
    if project.comparison is not None:
        assert project.comparison.vectors == 3000


def test_every_bit_of_the_status_and_none_occurs(project):
    assert project.statuses[0] > 100, "inside the certified set"
    every = {1, 2, 4, 8, 16, 32, 64}
    assert {bit for status in project.statuses for bit in every if status & bit} == every


def test_theta_stands_in_the_header_by_its_names(project):
    header = (project.folder / "include" / f"{project.name}.h").read_text()
    for i in (0, 1):
        name = f"theta{i + 1}"
        assert f"_THETA_{name} {i} /* {name}, declared range 0 to 1 */" in header
    assert "_real_t theta[2];" in header


def apart(plant, observer, seconds=1.0):
    """Largest distance of xhat between joint integration and the sampled step."""
    Ts = float(observer.model.Ts)
    steps = round(seconds / Ts)

    def theta(k):
        return 0.5 + 0.5 * np.sin([2.0 * k * Ts, 3.0 * k * Ts])

    scenario = ob.Scenario(
        "moving",
        steps,
        x0=[10, 10, 10],
        guess=[10.02, 9.98, 10.03],
        inputs=lambda k: _equilibrium(*theta(k)) + np.cos(5.0 * k * Ts),
        scheduling=theta,
        disturbances=np.zeros((steps + 1, 3)),
        x_range=[(9.9, 10.1)] * 3,
        f_range=[(-0.05, 0.05)] * 3,
    )
    exact, sampled = (
        ob.simulate(plant, observer, scenario, engine=engine, substeps=8)
        for engine in ("joint", "step")
    )
    assert exact.outside == ()
    assert any("sampled step" in text for text in sampled.outside)
    return float(np.abs(exact.xhat - sampled.xhat).max())


def test_the_step_follows_the_differential_equation(designed, plant):
    """What is held over a sample leaves an error of first order."""
    design, contract = designed("box_tight").certificate.design, ob.QPVObserver.CONTRACT
    shorter = [replace(design, Ts=design.Ts / n) for n in (4, 8, 16)]
    halves = [contract.certify(one, "lmi").observer() for one in shorter]
    found = np.array([apart(plant, observer) for observer in halves])
    np.testing.assert_allclose(found[:-1] / found[1:], 2.0, atol=0.3)
