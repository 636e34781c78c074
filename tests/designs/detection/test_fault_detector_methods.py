"""The fault detector over the methods: delays of the papers' examples, promises, refusals."""

import pickle

import numpy as np
import pytest
import sympy as sp

import obsynth as ob
from obsynth.designs.core.errors import DetectorError
from obsynth.designs.core.observer import STEP_OUTPUTS

REGION = [(0.2, 0.9), (0.0, 0.4), (0.1, 0.6)]


@pytest.fixture(scope="module")
def interval():
    return ob.IntervalObserver().design(ob.plants.interval_example())


@pytest.fixture(scope="module")
def bank():
    return ob.FilterBank(Ts=0.01, region=REGION).design(ob.plants.three_tanks())


@pytest.mark.parametrize("persistence", [1, 3])
def test_interval_observer_finds_steps_when_promised(interval, persistence):
    """Lamouchi et al.: f_k is bounded at k + 1, so an alarm is at least one sample late."""
    detector = ob.FaultDetector(interval, persistence)
    (smallest,) = detector.smallest_detectable
    steps = 160
    for factor, surely in ((1.01, True), (0.4, False)):
        faults = np.zeros((steps + 1, 1))
        faults[40:80] = factor * smallest
        faults[100:] = -factor * smallest
        for seed in range(5):
            base = ob.scenarios.interval_example(seed, steps)
            scenario = ob.Scenario(**{**vars(base), "faults": faults})
            run = ob.simulate(interval.model, detector, scenario)
            found = detector.detect(run)
            np.testing.assert_array_equal(found.alarm, run.alarm)
            assert found.false_alarms == {"f": 0}
            assert found.lingering == {"f": 0}
            assert [event.onset for event in found.events] == [40, 100]
            for event in found.events:
                assert event.alarm is None or event.alarm >= event.onset + persistence
                if event.promised is not None:
                    assert event.alarm <= event.promised
            if surely:
                # The transient is over long before: the prediction from the steady widths holds.
                assert [e.promised for e in found.events] == [40 + persistence, 100 + persistence]


def test_a_delay_of_the_bounds_that_is_forgotten_shows(interval):
    """A detector that took the bounds of f_{k-1} for those of f_k alarms after the end."""
    from dataclasses import replace

    forgetful = ob.FaultDetector(replace(interval, fault_delay=0))
    steps = 90
    faults = np.zeros((steps + 1, 1))
    faults[40:80] = 0.99
    base = ob.scenarios.interval_example(0, steps)
    scenario = ob.Scenario(**{**vars(base), "faults": faults})
    run = ob.simulate(interval.model, forgetful, scenario)
    assert forgetful.detect(run).lingering == {"f": 1}
    assert ob.FaultDetector(interval).detect(replace(run, fault_delay=1)).lingering == {"f": 0}


@pytest.mark.long
def test_interval_detector_in_c(interval, tmp_path):
    project = ob.generate_c(ob.FaultDetector(interval, 2, window=4), tmp_path / "p", vectors=2000)
    assert project.statuses[0] > 500
    if project.comparison is not None:
        assert project.comparison.vectors == 2000
    header = next((project.folder / "include").glob("*.h")).read_text()
    assert "mean_lower[1]; /* of the faults over the 4 steps before this one */" in header
    assert "- **Means.**" in (project.folder / "README.md").read_text()


@pytest.mark.long
@pytest.mark.parametrize(
    ("engine", "filters", "first"),
    [
        ("step", ob.FilterBank.filters, 1.37),
        ("joint", ob.FilterBank.filters[:1], 1.37),
        # fed with y(t) at all times another filter shows the fault before the slow one does
        ("joint", ob.FilterBank.filters, 1.10),
    ],
)
def test_three_tanks_delays(engine, filters, first):
    """Efimov et al., Section 6, with the bank: 1.37 s and 1.89 s, no false alarm."""
    plant = ob.plants.three_tanks()
    bank = ob.FilterBank(filters=filters, Ts=0.01, region=REGION).design(plant)
    detector = ob.FaultDetector(bank)
    run = ob.simulate(plant, detector, ob.scenarios.three_tanks(), engine=engine, substeps=1)
    assert run.outside == ()
    found = detector.detect(run)
    np.testing.assert_array_equal(found.alarm, run.alarm)
    assert found.delays["theta1"] == pytest.approx(first, abs=0.02)
    assert found.delays["theta2"] == pytest.approx(1.89, abs=0.02)
    assert not any(found.false_alarms.values())
    assert all(event.isolated for event in found.events)
    # The bank encloses a weighted mean, so nothing is promised for the present value.
    assert [event.promised for event in found.events] == [None, None]
    assert np.isinf(detector.smallest_detectable).all()
    later = ob.FaultDetector(bank, persistence=11).detect(run)
    # The noise pulls single intervals back over zero, so eleven in a row take much longer.
    for name, delay in later.delays.items():
        assert delay >= found.delays[name] + 0.1 - 1e-9
    assert not (later.alarm & ~found.alarm).any()


def test_a_mean_is_promised_as_such(bank):
    """A short fault above the smallest detectable mean need not be seen, and is not promised.

    Mutants: `_of_mean` false; a promise of faults that are larger than declared.
    """
    narrow = ob.FaultDetector(ob.FilterBank(Ts=0.01).design(ob.plants.three_tanks()))
    smallest = narrow.smallest_detectable
    assert (smallest < 6e-5).all()
    assert any("of the mean of theta1 above" in claim for claim in narrow.guarantee.claims)
    scenario = ob.scenarios.three_tanks(end=21.0)
    faults = np.zeros_like(scenario.faults)
    faults[2000:2010, 0] = 8e-5
    scenario = ob.Scenario(**{**vars(scenario), "faults": faults})
    run = ob.simulate(ob.plants.three_tanks(), narrow, scenario, substeps=1)
    (event,) = narrow.detect(run).events
    assert event.promised is None and event.alarm is None
    wide = ob.FaultDetector(bank)
    assert not any("in the steady state" in claim for claim in wide.guarantee.claims)
    assert "promised of no size" in str(wide) and "inf" not in str(wide)
    with pytest.raises(DetectorError, match="window=3: filter_bank encloses a mean of theta1"):
        ob.FaultDetector(bank, window=3)


def test_a_mean_outlasts_its_fault(bank):
    scenario = ob.scenarios.three_tanks(end=230.0)
    faults = np.zeros_like(scenario.faults)
    faults[20_000:20_500, 0] = 8e-5
    scenario = ob.Scenario(**{**vars(scenario), "faults": faults})
    detector = ob.FaultDetector(bank)
    found = detector.detect(ob.simulate(bank.model, detector, scenario))
    assert found.delays["theta1"] == pytest.approx(1.37, abs=0.02)
    assert found.lingering["theta1"] > 0
    assert found.lingering["theta2"] == 0
    assert found.false_alarms == {"theta1": 0, "theta2": 0}


def faulty_step(steps=90):
    base = ob.scenarios.interval_example(0, steps)
    return ob.Scenario(**{**vars(base), "faults": np.full((steps + 1, 1), 0.99)})


SCENARIOS = {
    "peak": lambda: ob.scenarios.quadruple_tank("FS1"),
    "interval": faulty_step,
    "bank": lambda: ob.scenarios.three_tanks(end=205.0),
}


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_detector_pickles(request, name):
    """Pickled before or after its step was asked for, it returns the same numbers to the bit."""
    skipped = ("void",)
    detector = ob.FaultDetector(request.getfixturevalue(name), 3, also_skip=skipped)
    fresh, scenario = pickle.loads(pickle.dumps(detector)), SCENARIOS[name]()
    run = ob.simulate(detector.model, detector, scenario, seed=1)
    assert run.alarm.any() and not run.alarm.all()
    for other in (fresh, pickle.loads(pickle.dumps(detector))):
        assert other.step.name_out() == detector.step.name_out()
        assert (other.counts, other.also_skip) == (detector.counts, detector.also_skip)
        assert str(other) == str(detector)
        assert str(other.guarantee) == str(detector.guarantee)
        again = ob.simulate(other.model, other, scenario, seed=1)
        for signal in (*STEP_OUTPUTS[1:], "alarm"):
            assert getattr(again, signal).tobytes() == getattr(run, signal).tobytes(), signal


def test_a_filter_bounds_its_faults_where_disturbances_are_bounded():
    """The inversion tells the fault one sample late to the bound of w1; the core does not."""
    plant = ob.Plant("two states")
    x1, x2 = plant.states("x1 x2", range=(-4, 4))
    (f,) = plant.faults("f", range=(-1, 1))
    w = plant.disturbances("w1:3", bound=0.01)
    plant.dynamics([x1 / 2 + x2 / 4 + f + w[0], x2 / 2 + sp.sin(x1) / 8 + w[1]], Ts=1.0)
    plant.outputs([x1, x2])
    detector = ob.FaultDetector(ob.HinfUIO(method="general").design(plant))
    assert detector.smallest_detectable == pytest.approx(0.02)
    faults = np.zeros((61, 1))
    faults[30:50] = 0.021
    rest = {"x0": [0, 0], "guess": [0, 0], "inputs": np.zeros((61, 0)), "faults": faults}
    found = detector.detect(ob.simulate(plant, detector, ob.Scenario("step", 60, **rest)))
    assert found.false_alarms == {"f": 0} and found.lingering == {"f": 0}
    assert found.events[0].alarm == 31
    assert found.violations == ()


def test_a_method_without_fault_bounds_is_refused():
    """Mutant: `own` with the fault's interval of the call before."""
    plant = ob.plants.hinf_example()
    observer = ob.HinfUIO().design(plant)
    # Its disturbances have no bound, so that the interval of f stays the declared one.
    assert observer.half_widths[3] == pytest.approx(1.0)
    with pytest.raises(DetectorError, match=r"hinf_uio estimates .* without bounds"):
        ob.FaultDetector(observer)
