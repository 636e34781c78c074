"""Means of faults over a window: laws for any sets that hold the truth, statuses, the detector.

Mutants, each seen to fail here: m - 1 in place of m; c'X of the instant after the window's first;
D with the input of this call; D with the fault set of the call before; a sum, or a weight, that is
not rounded outwards; a void instant or a missing input within the window.
"""

from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
import sympy as sp
from contracted import drawn, finite, made, signals

import obsynth as ob
from obsynth.designs.core.errors import DetectorError
from obsynth.designs.core.observer import MEAN_OUTPUTS, STATUS, STEP_OUTPUTS
from obsynth.designs.detection.window import Window, relations

NOT_VALID, VOID = STATUS["fault_not_valid"], STATUS["void"]
KINDS = ("u", "d", "f", "w", "p", "rho")


def window_of(plant, m, delay, moving=True):
    """The window of an observer of which nothing is known but its plant."""
    inputs = 3 + any(s.measured for s in plant.rho)
    parts = {"fault_delay": delay, "ode": None if moving else "not discrete", "half_widths": None}
    step = SimpleNamespace(n_in=lambda: inputs)
    observer = SimpleNamespace(model=plant, step=step, precision="double", **parts)
    return Window(observer, m)


def plant_of(name):
    return ob.plants.leaking_tanks() if name == "leaking_tanks" else made(name)


def courses(plant, calls, count, seed, ends=0.8):
    """Trajectories by the equations alone, noise and faults mostly at vertices: (calls, ., count).

    Faults jump as they like; parameters that stand still are drawn once.
    """
    rng = np.random.default_rng(seed)
    step = plant.function().map(count)
    found = {kind: [] for kind in ("x", *KINDS)}
    box = finite(plant.box("x"))
    inner = box.mean(axis=1, keepdims=True) + 0.6 * (box - box.mean(axis=1, keepdims=True))
    x, still = drawn(rng, inner, count, 0.0), None
    for _ in range(calls):
        now = {kind: signals(rng, plant.box(kind), count, ends) for kind in KINDS}
        still = now["p"] if still is None else still
        now["p"] = np.where([[s.constant] for s in plant.p], still, now["p"]) if plant.p else still
        for kind, value in {"x": x, **now}.items():
            found[kind].append(value)
        x = np.array(step(x, *(now[kind] for kind in KINDS))[0])
    arrays = {kind: np.array(value) for kind, value in found.items()}
    fair = np.all((arrays["x"] >= box[:, [0]]) & (arrays["x"] <= box[:, [1]]), axis=(0, 1))
    return rng, arrays, fair


def around(rng, truth, box, size):
    """Sets that hold the truth, which is mostly at one of their ends; cut with the ranges."""
    width = size * np.diff(finite(box), axis=1) * 10.0 ** rng.uniform(-3, 0, truth.shape)
    share = rng.uniform(0, 1, truth.shape)
    share = np.where(rng.random(truth.shape) < 0.8, np.round(share), share)
    lower, upper = truth - share * width, truth + (1.0 - share) * width
    low, high = (box[:, [side]] for side in (0, 1))
    return np.minimum(np.maximum(lower, low), truth), np.maximum(np.minimum(upper, high), truth)


def judged(window, plant, course, rng):
    """Run a window over sets around courses: true means and their bounds at the last call."""
    arrays, fair = course
    count = len(fair)
    measured = [i for i, s in enumerate(plant.rho) if s.measured]
    X = around(rng, arrays["x"], plant.box("x"), 0.05)
    F = around(rng, arrays["f"], plant.box("f").reshape(-1, 2), 2.0)
    step, memory = window.step.map(count), np.tile(window.first[:, None], count)
    calls, m, delay = len(arrays["x"]), window.m, window.delay
    for k in range(calls):
        j = max(k - delay, 0)
        sets = X[0][k], X[1][k], F[0][j], F[1][j]
        status = np.full((1, count), float(NOT_VALID if k < delay else 0))
        memory, *means = step(memory, arrays["u"][k], arrays["rho"][k][measured], *sets, status)
        expected = 0 if k >= m else NOT_VALID
        assert (np.array(means[2])[0, fair] == expected).all()
    mean = arrays["f"][calls - 1 - m : calls - 1].mean(axis=0)
    return [value[:, fair] for value in (mean, np.array(means[0]), np.array(means[1]))]


CASES = [("leaking_tanks", 0), ("leaking_tanks", 1), ("flexible_joint", 1), ("tanks", 0)]


@pytest.mark.parametrize(("name", "delay"), [*CASES, ("gains", 0), ("gains", 1), ("corners", 1)])
def test_no_course_of_a_fault_leaves_its_mean(name, delay):
    """Unmeasured states, gains that vary, unknown inputs, parameters; whatever the sets."""
    plant, count, m = plant_of(name), 1000, 3
    window = window_of(plant, m, delay)
    assert window.relations[0]
    rng, *course = courses(plant, m + 2, count, seed=7 + delay)
    assert course[1].sum() > 0.4 * count
    for one in (window, window_of(plant, m, delay, moving=False)):
        mean, lower, upper = judged(one, plant, course, rng)
        size = 1e-13 * (1.0 + np.abs(mean).max())  # what the trajectory itself is rounded by
        assert ((lower <= mean + size) & (mean - size <= upper)).all()
        room = np.minimum(mean - lower, upper - mean) / (upper - lower)
        assert np.sort(room.ravel())[:3].max() < 0.02


def test_the_rows_are_simplified_before_they_are_enclosed():
    """x cancels: what is left of a row of the tanks is flows, inputs and noise."""
    plant = ob.plants.leaking_tanks()
    found, equations = relations(plant, np.full(4, 0.01), 10)
    # of h2 alone, -h2, without h2 and the leak
    assert equations.slopes[len(found), :4, 0].tolist() == [0, -1, 0, 0]
    assert not equations.slopes[0, 1].any() and not equations.slopes[0, 3].any()


def test_pairs_of_rows_are_free_of_what_they_share():
    """An unknown input in both rows that know the fault: neither row tells it, their sum does."""
    plant = ob.Plant("shared")
    a, b = plant.states("a b", range=(-2, 2))
    (f,) = plant.faults("f", range=(-1, 1))
    (d,) = plant.unknown_inputs("d")
    w = plant.disturbances("w1:3", bound=0.01)
    flow = sp.tanh(a - b)
    plant.dynamics([a - flow / 4 + d / 3 + f / 2, b + flow / 4 - d], Ts=1)
    plant.outputs([a + w[0], b + w[1]])
    found, equations = relations(plant, None, 4)
    assert equations.slopes[1, :2].mean(axis=1) == pytest.approx([2, 2 / 3]) and found == [0]
    window = window_of(plant, 4, 1)
    rng, *course = courses(plant, 6, 500, seed=2)
    assert course[1].sum() > 50
    mean, lower, upper = judged(window, plant, course, rng)
    assert (lower <= mean + 1e-12).all() and (mean - 1e-12 <= upper).all()
    assert np.median(upper - lower) < 0.3


def test_ends_are_rounded_outwards():
    """Sets of one double each, whose fault is an exact rational; large terms leave a small mean."""
    plant = ob.Plant("exact")
    x, z = plant.states("x z", range=(-100, 100))
    (u,) = plant.inputs("u", range=(-9, 9))
    (f,) = plant.faults("f", range=(-3, 3))
    plant.dynamics([x * sp.Rational(3, 4) + u * sp.Rational(1, 8) + f * 3 + z, z / 2], Ts=1)
    plant.outputs([x, z])
    rng, m, narrow = np.random.default_rng(0), 5, []
    window, alone = window_of(plant, m, 1), window_of(plant, m, 1, moving=False)
    none, calm, wide = np.zeros((m + 1, 0)), np.zeros(m + 1), np.full((m + 1, 1), 3.0)
    for _ in range(40):
        us, at, faults = rng.uniform(-9, 9, m + 1), [rng.uniform(-80, 80, 2)], []
        for given in us[:m]:
            a, b = at[-1]
            at.append(np.array([0.75 * a + given / 8 + b + rng.uniform(-1e-3, 1e-3), b / 2]))
            rest = Fraction(a) * Fraction(3, 4) + Fraction(given) / 8 + Fraction(b)
            faults.append((Fraction(at[-1][0]) - rest) / 3)
        lower, upper, _ = window.over(us, none, np.array(at), np.array(at), -wide, wide, calm)
        assert Fraction(lower[-1, 0]) <= sum(faults) / m <= Fraction(upper[-1, 0])
        narrow.append(upper[-1, 0] - lower[-1, 0])
        a, b = rng.uniform(-1.5, 1.5, 2)
        points = np.array([0.0, a, b, 1e-3 - a, 1e-3 - b, rng.uniform(-1e-3, 1e-3)])
        mean = sum(map(Fraction, points)) / m
        lower, upper, _ = alone.over(us, none, np.array(at), np.array(at), *[points] * 2, calm)
        assert Fraction(lower[-1, 0]) <= mean <= Fraction(upper[-1, 0])
    assert max(narrow) < 1e-12


def test_sets_are_cut_with_the_domain_before_they_are_used():
    """1/x of a set that reaches over a pole which the declared range excludes."""
    plant = ob.Plant("pole")
    (x,) = plant.states("x", range=(0.5, 4))
    (f,) = plant.faults("f", range=(-3, 3))
    plant.dynamics([x - 1 / x + f], Ts=1)
    plant.outputs([x])
    one, wide = np.ones((3, 1)), np.full((3, 1), 3.0)
    none, status = np.zeros((3, 0)), np.zeros(3)
    lower, upper, _ = window_of(plant, 2, 1).over(none, none, -0.5 * one, one, -wide, wide, status)
    # the truth may rest at 1 with f = 1, and went from .5 to 1 at most
    assert lower[-1, 0] <= 1.0 <= upper[-1, 0] and upper[-1, 0] == pytest.approx(2.25)


def quiet(window, words, u=None, F=None):
    """Run over a plant at rest with these statuses: lower ends, and the statuses of the mean."""
    N = len(words)
    rest = np.tile([0.12, 0.1, 0.12], (N, 1))
    u = np.full((N, 2), 0.2) if u is None else u
    F = np.full((N, 1), 0.05) if F is None else F
    lower, _, status = window.over(
        u, np.zeros((N, 0)), rest - 0.001, rest + 0.001, -F, F, np.array(words, dtype=float)
    )
    return lower[:, 0], status


def test_a_window_needs_all_of_its_instants():
    """The mean's status joins those of the calls k - m..k; it begins anew after what breaks it."""
    m = 3
    window = window_of(ob.plants.leaking_tanks(), m, 1)
    words = np.zeros(30, dtype=int)
    words[0], words[8], words[15] = NOT_VALID, VOID | 4, 2
    words[22:24] = 32
    u = np.full((30, 2), 0.2)
    u[15] = np.nan
    lower, status = quiet(window, words, u)
    valid = (status & NOT_VALID) == 0
    # 8 is void: instants from 9 on count, and m transitions are complete at 12; the input of 15
    # is missing, so that 16 is the first instant of the next window
    assert np.flatnonzero(~valid).tolist() == [0, 1, 2, *range(8, 12), 16, 17, 18]
    assert (lower[~valid] == -0.05).all() and (lower[valid] > -0.05).all()
    for bit, calls in ((VOID | 4, [8]), (2, [15]), (32, [22, 23])):
        marked = sorted({k for call in calls for k in range(call, call + m + 1)})
        assert np.flatnonzero((status & bit) == bit).tolist() == marked
    zeros = window.step(np.zeros(len(window.first)), [0.2, 0.2], [], *[[0.1] * 3] * 2, 0, 0, 1)
    assert int(zeros[3]) & (1 | NOT_VALID) == 1 | NOT_VALID


def test_inputs_beyond_their_range_break_a_window_where_they_matter():
    plant = ob.Plant("products")
    (x,) = plant.states("x", range=(0, 2))
    (u,) = plant.inputs("u", range=(0, 1))
    (f,) = plant.faults("f", range=(-1, 1))
    plant.dynamics([x / 2 + u * x / 4 + f], Ts=1)
    plant.outputs([x])
    rows, wide = np.full((12, 1), 0.5), np.ones((12, 1))
    rows[[2, 6]] = [[-0.5], [1.5]]
    _, _, status = window_of(plant, 2, 0).over(
        rows, np.zeros((12, 0)), wide, wide, -wide, wide, np.zeros(12)
    )
    assert np.flatnonzero(status & NOT_VALID).tolist() == [0, 1, 3, 4, 7, 8]


def test_rows_that_are_too_long_to_write_out_are_left_alone():
    """Mutant: the power of the order; symbolic rows of this step would take minutes."""
    reactor = ob.plants.klatt_engell_reactor()
    assert relations(reactor.discretise("rk4", Ts=0.001), None, 4) == ([], None)
    assert relations(reactor.discretise("euler", Ts=0.001), None, 4)[0] == [0, 0, 0]


def test_a_mean_that_contradicts_its_sets_is_void():
    window = window_of(ob.plants.leaking_tanks(), 2, 1)
    F = np.full((8, 1), 0.05)
    N, rest = 8, np.tile([0.12, 0.1, 0.12], (8, 1))
    rest[4, 1] += 0.3  # no leak explains it
    lower, upper, status = window.over(
        np.full((N, 2), 0.2), np.zeros((N, 0)), rest, rest, -F, F, np.zeros(N)
    )
    assert np.flatnonzero(status & VOID).tolist()[0] == 4
    assert (lower[4], upper[4]) == (-0.05, 0.05)
    assert np.flatnonzero(status & NOT_VALID)[2:].tolist() == [5, 7]


def test_a_fault_set_that_is_not_valid_is_the_declared_one():
    """Mutant: bit 16 of the observer taken over, or its set taken."""
    window = window_of(ob.plants.leaking_tanks(), 2, 1)
    words = np.full(6, NOT_VALID)
    lower, status = quiet(window, words, F=np.full((6, 1), 1e-9))
    assert not (status[2:] & NOT_VALID).any()
    assert not (status & VOID).any() and (lower[2:] > 0.01).all()


@pytest.fixture(scope="module")
def leak_observer():
    return ob.IntervalObserver().design(tank_of_record())


def tank_of_record():
    """The plant of the record, at 1.2 times the least bounds that explain it."""
    th = {"a1": 0.023763991113147354, "a3": 0.021526928813387875}
    th |= {"b1": 0.03753119977068314, "b3": 0.035026740816003106}
    return ob.plants.leaking_tanks(1.2 * 0.001568056043987548, 1.2 * 0.006994620522516981, **th)


@pytest.fixture(scope="module")
def leak_run(leak_observer):
    return ob.estimate(leak_observer, ob.records.three_tank_leak(), windows=(5, 10))


@pytest.mark.parametrize(("m", "half"), [(5, 0.006446667324215116), (10, 0.004747971753276736)])
def test_the_leak_of_the_record(leak_observer, leak_run, m, half):
    """Reference: the same means over y +- wy alone. A meter on the leak, opened at 60.

    Mutant: e1 + h2 in place of h2, or x that is not cancelled in D.
    """
    trace, k = leak_run.means[m]["leak"], 36 + np.arange(181)
    assert k[trace.valid].min() == 36 + m and not trace.status[trace.valid].any()
    assert np.median(trace.half_width[trace.valid]) <= half * (1.0 + 1e-6)
    rate = np.diff(ob.records.three_tank_leak()["pulses"])
    meter = 0.000968 * np.array([rate[i - m : i].mean() for i in range(m, 181)])
    assert ((trace.lower[m:] <= meter) & (meter <= trace.upper[m:])).all()
    # certain from 62 on, which the instants up to 61 tell; no alarm before
    assert k[leak_run.alarms()[trace.name]].tolist() == list(range(62, 217))
    found = leak_run.columns()[f"leak_mean_{m}_lower"]
    np.testing.assert_array_equal(found, trace.lower)
    assert leak_run.widths()[f"mean of leak over {m}"]["median"] == pytest.approx(half, rel=1e-4)
    assert f"mean of leak over {m}" in str(leak_run.summary())
    detector = ob.FaultDetector(leak_observer, window=m)
    same = ob.estimate(detector, ob.records.three_tank_leak(), windows=(m,))
    np.testing.assert_array_equal(same.mean_lower[:, 0], trace.lower)
    np.testing.assert_array_equal(same.means[m]["leak"].upper, trace.upper)
    assert k[same.alarm[:, 0]].tolist() == list(range(62, 217))
    assert same.columns()["leak_mean_upper"].size == 181


def stairs(steps=60):
    """A leak that jumps, far below what one instant shows."""
    faults = np.zeros((steps + 1, 1))
    faults[20:40] = 0.011
    return ob.Scenario(
        "stairs",
        steps,
        x0=[0.12, 0.1, 0.12],
        guess=[0.12, 0.1, 0.12],
        inputs=lambda k: [0.22, 0.2],
        faults=faults,
        f_range=[(0, 0)],
    )


def test_a_detector_with_a_window_sees_what_one_instant_hides(leak_observer):
    model, m = leak_observer.model, 6
    detector = ob.FaultDetector(leak_observer, 2, window=m)
    run = ob.simulate(model, detector, stairs(), seed=1)
    alone = ob.simulate(model, leak_observer, stairs(), seed=1)
    found = detector.detect(run)
    np.testing.assert_array_equal(found.alarm, run.alarm)
    np.testing.assert_array_equal(detector.detect(alone).alarm, run.alarm)
    for a, key in zip(detector.means(alone), MEAN_OUTPUTS, strict=True):
        np.testing.assert_array_equal(getattr(run, key), a)
    for key in ("xhat", "x_lower", "f_upper", "status"):
        np.testing.assert_array_equal(getattr(run, key), getattr(alone, key))
    assert found.false_alarms == {"leak": 0} and found.events[0].alarm is not None
    assert found.lingering["leak"] < m
    assert ob.FaultDetector(leak_observer, 2).detect(run).events[0].alarm is None
    true = np.array([run.f[i - m : i].mean(axis=0) for i in range(m, 61)])
    assert (run.mean_lower[m:] <= true).all() and (true <= run.mean_upper[m:]).all()
    assert {"mean_lower", "mean_status"} <= set(run.to_xarray())
    assert any(f"over the {m} instants" in claim for claim in detector.guarantee.claims)
    assert detector.step.name_out() == [*STEP_OUTPUTS, "alarm", *MEAN_OUTPUTS]
    assert detector.outputs["mean_upper"] == ("leak_mean_upper",)
    import pickle

    again = ob.simulate(model, pickle.loads(pickle.dumps(detector)), stairs(), seed=1)
    np.testing.assert_array_equal(again.mean_upper, run.mean_upper)


def test_the_alarm_counts_either_and_takes_neither_for_the_other(leak_observer):
    """Random bounds against the rule, sample by sample.

    Mutants: an invalid mean counts; a mean with zero in it sets an alarm back that f keeps up.
    """
    rng, N, needed = np.random.default_rng(4), 400, 2
    detector = ob.FaultDetector(leak_observer, needed, window=3)
    ends = [np.repeat(rng.normal(0, 2, (N // 5, 1)), 5, axis=0) for _ in range(2)]
    half = [rng.uniform(0, 1.5, (N, 1)) for _ in range(2)]
    words = [rng.choice([0] * 6 + [2, 8, 16, 32, 64], N) for _ in range(2)]
    words[1] |= words[0] & ~NOT_VALID  # as a mean inherits them
    pairs = [(e - h, e + h, s) for e, h, s in zip(ends, half, words, strict=True)]
    found = detector.alarms(*pairs[0], *pairs[1])
    count, expected = 0, []
    for k in range(N):
        valid = [(int(s[k]) & (1 + 2 + 8 + 16 + 64)) == 0 for *_, s in pairs]
        out = [
            v and (a[k, 0] > 0 or b[k, 0] < 0) for v, (a, b, _) in zip(valid, pairs, strict=True)
        ]
        count = 0 if int(words[0][k]) & 8 else count
        count = count + 1 if any(out) else 0 if valid[0] else count
        expected.append(count >= needed)
    np.testing.assert_array_equal(found[:, 0], expected)
    assert any(expected) and not all(expected)


def test_windows_that_are_refused(leak_observer):
    for wrong in (0, -2, 1.5, True, "3", (2, 3)):
        with pytest.raises(DetectorError, match="window"):
            ob.FaultDetector(leak_observer, window=wrong)
