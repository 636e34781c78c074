"""The fault detector: decisions, promises, delays, and what it refuses."""

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import obsynth as ob
from obsynth.designs import STATUS, FaultDetector
from obsynth.designs.core.errors import DetectorError
from obsynth.designs.core.observer import STEP_OUTPUTS

NOISE = 0.05


def plant():
    """Two integrators, each with its own fault, both measured."""
    result = ob.Plant("two integrators")
    a, b = result.states("a b", range=(-100, 100))
    f, g = result.process_faults("f g", range=(-9, 9))
    v, w = result.disturbances("v w", bound=NOISE)
    result.dynamics([0.5 * a + f, 0.5 * b + g], Ts=0.1)
    result.outputs([a + v, b + w], names=["ya", "yb"])
    return result


@dataclass(frozen=True, eq=False)
class Differences:
    """f_{k-1} from two measurements, with bounds that every admissible noise attains."""

    model: Any
    shift: int = 0
    bounded: bool = True
    fault_delay: int = 1
    method: str = "differences"
    ode: None = None
    step_covered: bool = False

    @property
    def half_widths(self):
        return np.array([NOISE] * 2 + [1.5 * NOISE] * 2) if self.bounded else None

    @property
    def guarantee(self):
        return SimpleNamespace(claims=("f inside",), assumptions=("|v| <= 0.05",))

    @property
    def outputs(self):
        return {"xhat": ("a_hat", "b_hat")}

    @property
    def memory_layout(self):
        return {"y": slice(0, 2), "samples": slice(2, 3), "last": slice(3, 5)}

    @property
    def step(self):
        m, u, y = ca.SX.sym("m", 5), ca.SX.sym("u", 0), ca.SX.sym("y", 2)
        fhat = y - 0.5 * m[:2]
        if self.shift:
            fhat, fresh = m[3:], fhat
        else:
            fresh = fhat
        half = 1.5 * NOISE * (1 + 1e-12)
        good = ca.logic_and(*(ca.fabs(y[i]) <= 1e300 for i in range(2)))
        status = ca.if_else(m[2] >= 1, ca.if_else(m[2] >= 2, 0, 16), 1) + ca.if_else(good, 0, 2)
        samples = ca.if_else(m[2] >= 1, m[2] + 1, 0)
        memory = ca.vertcat(ca.if_else(good, y, 0.5 * m[:2]), samples, fresh)
        wide = ca.SX.inf(2)
        lower, upper = (fhat - half, fhat + half) if self.bounded else (-wide, wide)
        results = [memory, y, fhat, y - NOISE, y + NOISE, lower, upper, status]
        names = ["next", *STEP_OUTPUTS[1:]]
        return ca.Function("step", [m, u, y], results, ["memory", "u", "y"], names)

    def memory0(self, guess, x_range=None, f_range=None, y0=None):
        return np.array([0.0, 0.0, 1.0, 0.0, 0.0])


def stairs(steps=60, high=2.0, start=20, stop=40, column=0):
    faults = np.zeros((steps + 1, 2))
    faults[start:stop, column] = high
    return ob.Scenario(
        "stairs", steps, x0=[0, 0], guess=[0, 0], inputs=np.zeros((steps + 1, 0)), faults=faults
    )


def reference(lower, upper, status, persistence, skipped, ends=STATUS["void"]):
    """The rule of the alarm, sample by sample."""
    count, rows = np.zeros(lower.shape[1], dtype=int), []
    for low, high, word in zip(lower, upper, status, strict=True):
        if int(word) & ends:
            count[:] = 0
        if not any(int(word) & STATUS[name] for name in skipped):
            for i in range(len(count)):
                count[i] = count[i] + 1 if low[i] > 0 or high[i] < 0 else 0
        rows.append(count >= persistence)
    return np.array(rows)


SKIPPED = ("not_initialised", "non_finite_input", "void", "fault_not_valid", "recovering")


def random_bounds(seed, samples=200):
    rng = np.random.default_rng(seed)
    middle = np.repeat(rng.normal(0, 2, (samples // 5, 2)), 5, axis=0)
    half = rng.uniform(0, 1.5, (samples, 2))
    status = rng.choice([0] * 12 + [1, 2, 4, 8, 12, 16, 20, 31, 32, 40, 64, 64, 68], samples)
    return middle - half, middle + half, status


@settings(derandomize=True, deadline=None, max_examples=25)
@given(st.integers(0, 10**6), st.tuples(st.integers(1, 5), st.integers(1, 5)))
def test_alarms_follow_the_rule(seed, persistence):
    lower, upper, status = random_bounds(seed)
    detector = FaultDetector(Differences(plant()), persistence)
    found = detector.alarms(lower, upper, status)
    np.testing.assert_array_equal(
        found, reference(lower, upper, status, np.array(persistence), SKIPPED)
    )


MUTANTS = {
    "one sample too early": lambda a, b, s, p, q: reference(a, b, s, p - 1, q),
    "one sample too late": lambda a, b, s, p, q: reference(a, b, s, p + 1, q),
    "sign of the upper bound": lambda a, b, s, p, q: reference(a, -b, s, p, q),
    "swapped bounds": lambda a, b, s, p, q: reference(b, a, s, p, q),
    "one index late": lambda a, b, s, p, q: np.roll(reference(a, b, s, p, q), 1, axis=0),
    "invalid samples count": lambda a, b, s, p, q: reference(a, b, s, p, ()),
    "faults mixed up": lambda a, b, s, p, q: reference(a, b, s, p, q)[:, ::-1],
    "void samples end nothing": lambda a, b, s, p, q: reference(a, b, s, p, q, 0),
    "recovering ends alarms": lambda a, b, s, p, q: reference(a, b, s, p, q, 8 | 64),
    "recovering counts": lambda a, b, s, p, q: reference(a, b, s, p, q[:-1]),
    "the domain counts too": lambda a, b, s, p, q: reference(a, b, s, p, (*q, "outside_domain")),
}


@pytest.mark.parametrize("mutant", MUTANTS)
def test_the_rule_tells_mutants_apart(mutant):
    arguments = (*random_bounds(1), np.array([2, 2]), SKIPPED)
    assert np.any(reference(*arguments) != MUTANTS[mutant](*arguments))


def test_further_bits_can_be_skipped():
    lower, upper, status = random_bounds(3)
    detector = FaultDetector(Differences(plant()), 2, also_skip=("outside_domain",))
    expected = reference(lower, upper, status, 2, (*SKIPPED, "outside_domain"))
    np.testing.assert_array_equal(detector.alarms(lower, upper, status), expected)
    np.testing.assert_array_equal(
        detector.valid(status), [(int(s) & (1 + 2 + 4 + 8 + 16 + 64)) == 0 for s in status]
    )


def test_the_step_is_the_observers_with_alarms_behind():
    observer = Differences(plant())
    detector = FaultDetector(observer, 3)
    assert detector.step.name_out() == [*STEP_OUTPUTS, "alarm"]
    assert detector.memory_layout["alarm_count"] == slice(5, 7)
    assert detector.outputs["alarm"] == ("f_alarm", "g_alarm")
    rng = np.random.default_rng(0)
    memory = detector.memory0([0, 0])
    np.testing.assert_array_equal(memory, [0, 0, 1, 0, 0, 0, 0])
    for k in range(50):
        y = np.array([np.nan, np.inf]) if k % 7 == 3 else rng.normal(size=2)
        own = [np.array(v).ravel() for v in observer.step(memory[:5], [], y)]
        both = [np.array(v).ravel() for v in detector.step(memory, [], y)]
        np.testing.assert_array_equal(both[0][:5], own[0])
        for a, b in zip(both[1:8], own[1:], strict=True):
            np.testing.assert_array_equal(a, b)
        memory = both[0]


@pytest.mark.parametrize("persistence", [1, 2, 4])
def test_a_run_with_the_detector_and_a_run_judged_afterwards_agree(persistence):
    detector = FaultDetector(Differences(plant()), persistence)
    run = ob.simulate(detector.model, detector, stairs(), seed=2)
    found = detector.detect(run)
    np.testing.assert_array_equal(found.alarm, run.alarm)
    alone = ob.simulate(detector.model, detector.observer, stairs(), seed=2)
    assert alone.alarm is None
    np.testing.assert_array_equal(detector.detect(alone).alarm, run.alarm)
    assert "alarm" in run.to_xarray()
    (event,) = found.events
    # One sample because the bounds speak of k - 1, and one for each further sample that counts.
    assert (event.fault, event.onset, event.end) == ("f", 20, 39)
    assert event.alarm == 20 + persistence
    assert event.delay == pytest.approx(0.1 * persistence)
    assert event.promised == event.alarm
    assert event.level == 2.0
    assert event.isolated
    assert found.false_alarms == {"f": 0, "g": 0}
    assert found.lingering == {"f": 0, "g": 0}
    assert found.delays == {"f": event.delay}


def test_bounds_that_are_one_step_late_show_as_alarms_after_the_end():
    late = Differences(plant(), shift=1)
    detector = FaultDetector(late)
    found = detector.detect(ob.simulate(late.model, late, stairs()))
    assert found.lingering["f"] == 1
    assert found.events[0].alarm == 22
    early = FaultDetector(replace(Differences(plant()), fault_delay=0))
    found = early.detect(ob.simulate(early.model, early.observer, stairs()))
    assert found.lingering["f"] == 1, "claimed for k, true for k - 1"


def test_the_smallest_detectable_fault_is_the_length_of_the_interval():
    """Whatever the noise, above 2 w the alarm comes; just below, the worst noise hides it."""
    detector = FaultDetector(Differences(plant()))
    smallest = detector.smallest_detectable
    np.testing.assert_allclose(smallest, 3 * NOISE)
    hidden = np.zeros((61, 2))
    # f_hat = f + v_k - 0.5 v_{k-1}: the worst noise pulls the estimate down by w for good at k.
    hidden[20:41, 0] = np.where(np.arange(21) % 2, -NOISE, NOISE)
    for factor, seen in ((1 + 1e-9, True), (1 - 1e-3, False)):
        scenario = replace(stairs(high=factor * smallest[0], stop=21), disturbances=hidden)
        # The noise of instants 20 and 21, which decide on f_20.
        scenario.disturbances.flags.writeable = True
        scenario.disturbances[20:22, 0] = [NOISE, -NOISE]
        found = detector.detect(ob.simulate(detector.model, detector, scenario))
        event = found.events[0]
        assert (event.alarm is not None) == seen
        assert (event.promised is not None) == seen
        assert found.missed == (() if seen else (event,))


def test_random_faults_are_found_when_promised_and_never_without_fault():
    rng = np.random.default_rng(5)
    model = plant()
    detector = FaultDetector(Differences(model), persistence=(1, 3))
    kept = 0
    for seed in range(20):
        faults = np.repeat(rng.choice([0, 0, 0.1, -0.2, 0.5], (12, 2)), 10, axis=0)
        scenario = ob.Scenario(
            "random", 119, x0=[0, 0], guess=[0, 0], inputs=np.zeros((120, 0)), faults=faults
        )
        found = detector.detect(ob.simulate(model, detector, scenario, seed))
        assert not any(found.false_alarms.values())
        assert not any(found.lingering.values())
        for event in found.events:
            if event.promised is not None:
                kept += 1
                assert event.alarm <= event.promised
    assert kept > 50


def test_samples_that_do_not_count_leave_the_alarm_as_it_is():
    model = plant()
    detector = FaultDetector(Differences(model), 3)
    step, memory = detector.step, detector.memory0([0, 0])
    alarms = []
    y = [0.0, 0.0]
    for k in range(20):
        y = [0.5 * y[0] + (1.0 if 5 <= k < 12 else 0.0), 0.0]
        seen = [np.nan, 0.0] if k in (6, 9) else y
        memory, *results = (np.array(v).ravel() for v in step(memory, [], seen))
        alarms.append(int(results[-1][0]))
    # 5 counts, 6 fails, 7 and 8 count: the alarm comes one sample later than without the failure.
    assert alarms.index(1) == 8
    assert alarms[9] == 1, "a missing sample withdraws nothing"
    assert alarms[11] == 1
    assert alarms[12] == 0


def judged(f, voids, recovering, persistence=2):
    """What the detector makes of exact intervals of the fault f, void at some samples."""
    model = plant()
    detector = FaultDetector(replace(Differences(model), fault_delay=0), persistence)
    run = ob.simulate(model, detector.observer, stairs())
    status, exact = np.zeros(len(run.t), dtype=int), np.column_stack([f, 0 * f])
    status[voids], status[recovering] = 8, 64
    wide = np.isin(np.arange(len(f)), voids)[:, None] * [9.0, 9.0]
    said = {"f_lower": exact - 0.1 - wide, "f_upper": exact + 0.1 + wide, "status": status}
    return detector.detect(replace(run, f=np.column_stack([run.f[:, 0], 0 * f]), **said))


def test_a_violation_ends_the_alarms_and_is_listed():
    """Mutants: void instants skipped only, `ended` from the void on, voids not listed."""
    f = np.zeros(61)
    f[20:40] = 2.0  # what the stairs are
    found = judged(f, [30], range(31, 36))
    (event,) = found.events
    assert (event.alarm, event.violation) == (21, 30)
    assert np.flatnonzero(found.alarm[:, 0]).tolist() == [*range(21, 30), *range(37, 40)]
    assert found.before_violation == {"f": 9, "g": 0}
    assert [(v.first, v.last, v.count, v.until) for v in found.violations] == [(30, 30, 1, 35)]
    assert "at 2, before the violation at k = 30" in str(found)
    assert "f: 9 instants of alarm before a violation" in str(found)
    lines = str(found).splitlines()
    assert "no false alarm" in lines
    assert lines[-1] == "some assumption failed: void at 1 instant, k = 30, recovering until k = 35"
    assert lines[-1] in found._repr_html_()
    calm = judged(f, [], [])
    assert calm.violations == () and calm.events[0].violation is None
    assert "violation" not in str(calm) and not any(calm.before_violation.values())


def test_nothing_is_promised_across_a_violation():
    """Mutant: void samples left out of the stretch in which the persistence is counted."""
    f = np.zeros(61)
    f[20:40] = 2.0
    assert judged(f, [], [], persistence=6).events[0].promised == 25
    found = judged(f, [24], range(25, 30), persistence=6).events[0]
    assert found.promised == found.alarm == 35


def test_zeros_are_not_initialised():
    detector = FaultDetector(Differences(plant()))
    memory, *results = detector.step(np.zeros(7), [], [5.0, 5.0])
    assert int(results[6]) & 1
    np.testing.assert_array_equal(np.array(results[7]).ravel(), [0, 0])
    np.testing.assert_array_equal(np.array(memory)[5:].ravel(), [0, 0])


def test_other_faults_are_named():
    model = plant()
    detector = FaultDetector(Differences(model))
    run = ob.simulate(model, detector.observer, stairs())
    mixed = replace(run, f_lower=run.f_lower[:, [0, 0]], f_upper=run.f_upper[:, [0, 0]])
    found = detector.detect(mixed)
    assert found.events[0].others == ("g",)
    assert not found.events[0].isolated
    assert found.false_alarms == {"f": 0, "g": 20}
    assert "together with g" in str(found)
    assert "g: 20 instants of alarm false" in found._repr_html_()


def test_guarantee_and_text():
    detector = FaultDetector(Differences(plant()), (1, 4))
    claims = detector.guarantee.claims
    assert claims[0] == "f inside"
    assert any("alarm of g proves that" in c and "at 4 samples" in c for c in claims)
    assert any("a magnitude of f above 0.15 at 1 consecutive samples" in c for c in claims)
    assert any("status bit 8" in c and "some assumption failed" in c for c in claims)
    assert "g: alarm after 4 samples, promised above 0.15" in str(detector)
    assert detector.method == "differences with fault_detector"


def test_refusals():
    with pytest.raises(DetectorError, match=r"differences estimates f, g without bounds"):
        FaultDetector(Differences(plant(), bounded=False))
    bare = ob.Plant("bare")
    (a,) = bare.states("a", range=(-1, 1))
    bare.dynamics([a / 2], Ts=1)
    bare.outputs([a])
    with pytest.raises(DetectorError, match="'bare' declares no fault"):
        FaultDetector(replace(Differences(plant()), model=bare))
    observer = Differences(plant())
    for wrong in (0, -1, 1.5, True, "2", (1, 0)):
        with pytest.raises(DetectorError, match="whole number of samples from 1 on"):
            FaultDetector(observer, wrong)
    with pytest.raises(DetectorError, match=r"3 numbers for the 2 faults f, g"):
        FaultDetector(observer, (1, 2, 3))
    with pytest.raises(DetectorError, match="also_skip names 'tired'"):
        FaultDetector(observer, also_skip=("tired",))
    run = ob.simulate(observer.model, observer, stairs())
    with pytest.raises(DetectorError, match="with a delay of 0"):
        FaultDetector(observer).detect(replace(run, fault_delay=0))


@pytest.fixture(scope="module")
def settled_peak(tank_split, tank_bounds):
    """A horizon that lets the bounds settle: the predicted widths are those of an old copy."""
    return ob.BoundedErrorUIO(bounds="peak", horizon=5000).design(tank_split, tank_bounds)


@pytest.mark.parametrize("persistence", [1, 3])
@pytest.mark.parametrize("name", ["FS1", "FS2"])
def test_quadruple_tank(settled_peak, tank, name, persistence):
    """Peak bounds of Buciakowski's plant: ramps are found when promised, and told apart."""
    detector = ob.FaultDetector(settled_peak, persistence=persistence)
    run = ob.simulate(tank, detector, ob.scenarios.quadruple_tank(name))
    found = detector.detect(run)
    np.testing.assert_array_equal(found.alarm, run.alarm)
    assert set(found.delays) == ({"f1"} if name == "FS1" else {"f1", "f2"})
    assert len(found.events) == 2 * len(found.delays)
    assert not any(found.false_alarms.values())
    assert not any(found.lingering.values())
    smallest = dict(zip(("f1", "f2"), detector.smallest_detectable, strict=True))
    for event in found.events:
        assert event.isolated
        assert event.promised is not None
        assert event.alarm <= event.promised
        if event.onset > 3000:
            # Long after the transient the ramp of 0.05 V/s is promised at the predicted size, or
            # before it where the interval is narrower than predicted.
            at = event.promised, ("f1", "f2").index(event.fault)
            level = abs(run.f[at])
            assert run.f_upper[at] - run.f_lower[at] < level
            assert level <= smallest[event.fault] + 0.05 * (persistence + 1)


@pytest.mark.long
def test_quadruple_tank_detector_in_c(peak, tmp_path):
    project = ob.generate_c(ob.FaultDetector(peak, persistence=2), tmp_path / "p", vectors=2000)
    header = (project.folder / "include/quadruple_tank.h").read_text()
    assert "alarm_count[2];" in header
    assert "quadruple_tank_real_t alarm[2];" in header
    readme = (project.folder / "README.md").read_text()
    assert "out.alarm" in readme
    assert "raises its alarm" in readme
    if project.comparison is not None:
        assert project.comparison.vectors == 2000


@pytest.mark.parametrize("size", [10.0, 100.0, 1e4, 1e20])
def test_a_glitch_of_one_sensor_raises_no_false_alarm(peak, tank, size):
    """y1 is wrong at one sample of a calm run: the violation is reported, no fault.

    Before there was a guard: 9, 24 and 73 instants of false alarm after 10, 100 and 1e4.
    Mutant: a detector that counts at void samples, or a step that keeps its sets there.
    """
    at, steps = 1000, 1600
    detector, x = FaultDetector(peak), np.array([170.0, 170.0, 52.5, 52.5])
    u = np.tile([[10.0], [10.0]], steps)
    truth = tank.function().mapaccum(steps)
    zeros = [np.zeros((tank.function().numel_in(i), steps)) for i in range(2, 7)]
    _, y = (np.array(v) for v in truth(x, u, *zeros))
    y[0, at] += size
    near = np.column_stack([x - 1, x + 1])
    many = detector.step.mapaccum(steps)
    *_, lower, upper, status, alarm = many(detector.memory0(x, x_range=near), u, y)
    status = np.array(status).ravel().astype(int)
    run = SimpleNamespace(
        names={"f": tank.names("f")},
        fault_delay=peak.fault_delay,
        f=np.zeros((steps, 2)),
        t=np.arange(steps, dtype=float),
        f_lower=np.array(lower).T,
        f_upper=np.array(upper).T,
        status=status,
    )
    found = detector.detect(run)
    np.testing.assert_array_equal(found.alarm, np.array(alarm).T > 0.5)
    assert found.false_alarms == {"f1": 0, "f2": 0}
    assert found.violations[0].first in (at, at + 1)
