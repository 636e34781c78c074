"""The bank: delays, no false alarm, inclusion of weighted means, refusals by name."""

from fractions import Fraction

import numpy as np
import pytest

import obsynth as ob
from obsynth.derive.jacobian.slope_signs import Monotone, with_ranges
from obsynth.designs.filter_bank import step as step_module
from obsynth.designs.filter_bank.method import FilterBank
from obsynth.designs.filter_bank.model import read as filter_bank_model
from obsynth.designs.filter_bank.step import bank_intervals
from obsynth.symbolic.noise import bounded_noise

REGION = [(0.2, 0.9), (0.0, 0.4), (0.1, 0.6)]
BOUND = 4.5e-3
START = np.array([(0.44, 0.56), (0.04, 0.16), (0.24, 0.36)])
RATES = (0.1, 0.2, 0.3, 0.5)


@pytest.fixture(scope="module")
def bank(tanks):
    return FilterBank(Ts=0.01, region=REGION).design(tanks)


@pytest.fixture(scope="module")
def loop(bank, closed_loop):
    return closed_loop(bank)


@pytest.fixture(scope="module")
def paper_run(loop, schedule):
    f, raised = schedule(32_000)
    w = bounded_noise(1, 32_000, [BOUND, BOUND])
    return {**loop(w, f, raised, x_range=START), "f": f, "w": w}


def intervals(observer, run):
    """Fault intervals of every filter, shape (N, faults, rates), infinite while N = 0."""
    layout, memory = observer.memory_layout, run["memory"]
    N = memory[:, layout["response"]]
    low = np.repeat(run["y"] - BOUND, len(RATES), axis=1) - memory[:, layout["filter_upper"]]
    high = np.repeat(run["y"] + BOUND, len(RATES), axis=1) - memory[:, layout["filter_lower"]]
    with np.errstate(divide="ignore", invalid="ignore"):
        shape = (-1, 2, len(RATES))
        return (
            np.where(N > 0, low / N, -np.inf).reshape(shape),
            np.where(N > 0, high / N, np.inf).reshape(shape),
        )


def weighted_means(f, Ts=0.01):
    """Means of faults that are held over the steps, with the weights exp(-rate age)."""
    total, weight = np.zeros((2, len(RATES))), np.zeros(len(RATES))
    rates = np.array(RATES)
    decay, gathered = np.exp(-rates * Ts), -np.expm1(-rates * Ts) / rates
    means = np.zeros((len(f), 2, len(RATES)))
    for k, row in enumerate(f):
        if k:
            means[k] = total / weight
        total = decay * total + gathered * row[:, None]
        weight = decay * weight + gathered
    return means


def violations(observer, run):
    """Counts of states and of weighted means outside of their sets."""
    low, high = intervals(observer, run)
    means = weighted_means(run["f"])
    states = (run["x_lower"] > run["x"]) | (run["x"] > run["x_upper"])
    return int(states.sum()), int(((low > means) | (means > high)).sum())


def alarms(observer, run):
    low, high = intervals(observer, run)
    return ((low > 0) | (high < 0)).any(axis=2)


def test_delays_and_no_false_alarm(bank, paper_run):
    found = alarms(bank, paper_run)
    for i, start in enumerate((20_000, 30_000)):
        assert not found[:start, i].any()
        delay = np.flatnonzero(found[start:, i])[0] * 0.01
        assert delay == pytest.approx((1.37, 1.89)[i], abs=0.02)
    # the interval that is returned, of the slowest filter, shows both faults as soon
    for i, start in enumerate((20_000, 30_000)):
        own = (paper_run["f_lower"][:, i] > 0) | (paper_run["f_upper"][:, i] < 0)
        assert not own[:start].any()
        assert np.flatnonzero(own[start:])[0] * 0.01 == pytest.approx((1.37, 1.89)[i], abs=0.02)


def test_every_filter_has_its_own_delay(bank, paper_run, numbers):
    expected = numbers["robust"]["h.01_seed1"]
    low, high = intervals(bank, paper_run)
    for j, rate in enumerate(RATES):
        for i, start in enumerate((20_000, 30_000)):
            shown = (low[start:, i, j] > 0) | (high[start:, i, j] < 0)
            delay = np.flatnonzero(shown)[0] * 0.01
            assert delay == pytest.approx(expected[f"{rate:g}"][f"d{i + 1}"], abs=0.02)


def test_the_intervals_of_all_filters(bank, cooperative, paper_run):
    expected = intervals(bank, paper_run)
    found = bank_intervals(bank, paper_run["memory"], paper_run["y"])
    for a, b in zip(expected, found, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)
    low, high = bank_intervals(bank, paper_run["memory"][700], paper_run["y"][700])
    assert low.shape == (2, 4)
    f_box = bank.model.box("f")
    assert paper_run["f_lower"][700] == pytest.approx(np.maximum(low[:, 0], f_box[:, 0]), abs=1e-9)
    assert paper_run["f_upper"][700] == pytest.approx(np.minimum(high[:, 0], f_box[:, 1]), abs=1e-9)
    with pytest.raises(ob.ObsynthError, match="no bank"):
        bank_intervals(cooperative, cooperative.memory0([0.5, 0.1, 0.3]), [0.5, 0.1])


def test_no_violation_in_thirty_two_thousand_checks(bank, paper_run):
    assert violations(bank, paper_run) == (0, 0)
    assert set(paper_run["status"]) == {0}
    assert len(paper_run["x"]) == 32_001


def test_the_unmeasured_level_is_enclosed_as_tightly_as_the_reference(paper_run, numbers):
    expected = numbers["robust"]["h.01_seed1"]
    at = 19_900
    assert paper_run["x"][at, :2] == pytest.approx(expected["x199"][:2], abs=1e-7)
    low, high = paper_run["x_lower"][at, 2], paper_run["x_upper"][at, 2]
    assert high - low <= expected["Z199"][1] - expected["Z199"][0]
    assert [low, high] == pytest.approx(expected["Z199"], abs=2e-5)


@pytest.mark.parametrize(("Ts", "key"), [(0.02, "h.02"), (0.05, "h.05"), (0.1, "h.1")])
def test_longer_steps(tanks, closed_loop, schedule, numbers, Ts, key):
    bank = FilterBank(Ts=Ts, region=REGION).design(tanks)
    steps = round(320.0 / Ts)
    f, raised = schedule(steps, Ts)
    run = {**closed_loop(bank)(bounded_noise(1, steps, [BOUND] * 2), f, raised, x_range=START)}
    found = alarms(bank, run)
    assert set(run["status"]) == {0}
    assert ((run["x_lower"] <= run["x"]) & (run["x"] <= run["x_upper"])).all()
    for i, start in enumerate((200.0, 300.0)):
        k = round(start / Ts)
        assert not found[:k, i].any()
        delay = np.flatnonzero(found[k:, i])[0] * Ts
        assert delay <= numbers["robust"][key]["bank"][f"d{i + 1}"] + 0.02


def test_the_interval_is_of_the_mean_and_not_of_the_present_value(bank, paper_run):
    low, high = intervals(bank, paper_run)
    fault, after = paper_run["f"][20_000:30_000, 0], slice(20_000, 30_000)
    for j, seconds in ((0, 16.6), (3, 0.34)):
        outside = (low[after, 0, j] > fault) | (fault > high[after, 0, j])
        assert outside.sum() * 0.01 == pytest.approx(seconds, abs=0.02)
    assert any("not its" in claim for claim in bank.guarantee.claims)


def first_alarms(run, low, high, start):
    """Seconds from a start to the alarm of the first filter, and to that of what is returned."""
    alone = (low[start:, 0, 0] > 0) | (high[start:, 0, 0] < 0)
    shown = (run["f_lower"][start:, 0] > 0) | (run["f_upper"][start:, 0] < 0)
    return [np.flatnonzero(flags)[:1] * 0.01 for flags in (alone, shown)]


@pytest.mark.parametrize(
    ("size", "seconds", "alone", "latest"),
    [(2e-4, 1.0, None, 0.75), (8e-5, 2.0, None, 2.0), (2e-4, 10.0, 2.1, 0.75)],
)
def test_another_filter_shows_a_fault_first(bank, loop, size, seconds, alone, latest):
    """Ten seconds after the start the slow filter still remembers how little was known then.

    The short faults it misses, the lasting one it shows more than a second later. Mutants: the
    first filter's interval returned, another one's returned although the first shows the fault,
    the intervals cut with each other.
    """
    detector = ob.FaultDetector(bank)
    for seed in (1, 2, 3):
        f = np.zeros((2001, 2))
        f[1000 : 1000 + round(100 * seconds), 0] = size
        run = loop(bounded_noise(seed, 2000, [BOUND] * 2), f, x_range=START)
        low, high = intervals(bank, run)
        slow, shown = first_alarms(run, low, high, 1000)
        assert 0.0 < shown[0] < latest
        assert slow.size == 0 if alone is None else slow[0] > alone
        alarm = detector.alarms(run["f_lower"], run["f_upper"], run["status"])
        assert np.array_equal(alarm, alarms(bank, run))
        # what is returned is one of the filters' intervals, the first one's while that will do
        box = bank.model.box("f")[:, :, None]
        returned = run["f_lower"][:, :, None], run["f_upper"][:, :, None]
        ends = np.maximum(low, box[:, 0]), np.minimum(high, box[:, 1])
        near = [np.abs(a - b) <= 1e-11 for a, b in zip(ends, returned, strict=True)]
        same = near[0] & near[1]
        own = (low[:, :, 0] > 0) | (high[:, :, 0] < 0) | ~alarm
        assert same.any(axis=2).all() and same[own][:, 0].all()


def test_fault_free_runs_raise_no_alarm(bank, loop, schedule):
    _, raised = schedule(12_000)
    for seed in range(2, 5):
        w = bounded_noise(seed, 12_000, [BOUND] * 2)
        run = loop(w, None, raised, x_range=START)
        assert not alarms(bank, run).any()
        assert ((run["f_lower"] <= 0) & (run["f_upper"] >= 0)).all()
        assert set(run["status"]) == {0}


@pytest.mark.long
def test_a_hundred_fault_free_runs_raise_no_alarm(bank, loop, schedule):
    _, raised = schedule(20_000)
    for seed in range(100, 200):
        w = bounded_noise(seed, 20_000, [BOUND] * 2)
        run = loop(w, None, raised, x_range=START)
        assert not alarms(bank, run).any(), seed
        assert ((run["f_lower"] <= 0) & (run["f_upper"] >= 0)).all(), seed
        assert ((run["x_lower"] <= run["x"]) & (run["x"] <= run["x_upper"])).all(), seed


def hard_run(loop, seed, steps=400):
    """Bang-bang noise, a start at a corner, faults that jump between their ends."""
    rng = np.random.default_rng(seed)
    w = BOUND * (1 - 1e-12) * rng.choice([-1.0, 1.0], (steps, 2))
    if seed % 3 == 0:
        w = np.tile(BOUND * (1 - 1e-12) * rng.choice([-1.0, 1.0], 2), (steps, 1))
    f = 2e-4 * rng.choice([-1.0, 0.0, 1.0], (steps, 2))
    f = np.repeat(f[:: 50 + seed % 40], 50 + seed % 40, axis=0)[:steps]
    x0 = START[np.arange(3), rng.integers(0, 2, 3)]
    raised = rng.integers(0, 2, steps).astype(float)
    return {**loop(w, f, raised, x0=x0, x_range=START), "f": f}


@pytest.mark.parametrize("seed", range(50))
def test_inclusion_in_hard_runs(bank, loop, seed):
    run = hard_run(loop, seed)
    assert violations(bank, run) == (0, 0)
    assert set(run["status"]) == {0}


@pytest.mark.long
def test_inclusion_in_a_thousand_hard_runs(bank, loop):
    assert [violations(bank, hard_run(loop, seed)) for seed in range(1000)] == [(0, 0)] * 1000


@pytest.mark.long
@pytest.mark.parametrize(
    "mutant", ["no noise", "sign of the fault", "swapped ends", "late by one", "no envelope"]
)
def test_inclusion_sees_a_mutant(bank, closed_loop, certify, monkeypatch, mutant):
    record = dict(bank.record)
    late = 0
    if mutant == "no noise":
        record["noise"] = (0.98 * np.array(record["noise"])).tolist()
    elif mutant == "sign of the fault":
        right = step_module.Corners.rate

        def wrong(self, *given, **named):
            named["faults"] = True
            return right(self, *given, **named)

        monkeypatch.setattr(step_module.Corners, "rate", wrong)
        signs = {kind: np.array(v) for kind, v in record["signs"].items()}
        signs["f"] = -signs["f"]
        record["signs"] = {kind: v.tolist() for kind, v in signs.items()}
    elif mutant == "swapped ends":
        signs = {kind: np.array(v) for kind, v in record["signs"].items()}
        signs["x"][2] = [-1, -1, -1]
        record["signs"] = {kind: v.tolist() for kind, v in signs.items()}
    elif mutant == "no envelope":
        monkeypatch.setattr(
            step_module, "_envelope", lambda design, corners, low, high: ((low, high), low[0] > 0)
        )
    else:
        late = 1
    # a response of the other sign than the slope is refused before anything runs
    assert certify(record).valid is (mutant != "sign of the fault")
    broken = certify(record, claims=lambda design: ()).observer()
    loop = closed_loop(broken, late=late)
    counts = [sum(violations(broken, hard_run(loop, seed))) for seed in range(12)]
    assert sum(counts) > 0
    if mutant in ("sign of the fault", "swapped ends"):
        with pytest.raises(ob.CertificateError, match="monotone"):
            broken.certificate.check()
    elif mutant == "no noise":
        with pytest.raises(ob.CertificateError, match="noise"):
            broken.certificate.check()


def test_a_missing_measurement_or_input(bank, tanks):
    memory = bank.memory0([0.5, 0.1, 0.3], x_range=START)
    u, y = [5e-5, 5e-6], [0.5, 0.1]
    plain = bank.step(memory, u, y)
    missing = bank.step(plain[0], u, [np.nan, 0.1])
    assert int(missing[7]) == 32
    width = np.array(missing[4] - missing[3]).ravel()
    assert (width[:2] > 2 * BOUND).all()
    assert np.isfinite(width).all()
    blind = bank.step(plain[0], [np.nan, 0.0], y)
    assert int(blind[7]) == 2
    again = bank.step(blind[0], u, y)
    assert int(again[7]) == 0
    region = np.array(REGION)
    assert np.array(again[3])[2] == region[2, 0]
    assert np.array(again[6]).ravel() == pytest.approx([2e-4, 2e-4])


def test_outside_of_the_region_is_reported_and_the_bank_starts_again(bank):
    memory = bank.memory0([0.5, 0.1, 0.3], x_range=START)
    u = [5e-5, 5e-6]
    outside = bank.step(memory, u, [0.91, 0.1])
    assert int(outside[7]) == 8 + 32
    back = bank.step(outside[0], u, [0.5, 0.1])
    assert int(back[7]) == 64
    assert np.array(back[3])[2] == REGION[2][0]
    jump = bank.step(bank.step(memory, u, [0.5, 0.1])[0], u, [0.52, 0.1])
    assert int(jump[7]) == 8
    # nothing is told of what begins anew, nothing of what came before
    low, high = bank_intervals(bank, np.array(jump[0]).ravel(), [0.5, 0.1])
    assert np.isinf(low).all() and np.isinf(high).all()


def test_zeros_are_not_initialised(bank):
    n = bank.step.numel_in(0)
    results = bank.step(np.zeros(n), [0, 0], [0.5, 0.1])
    assert int(results[7]) & 1
    assert np.array(results[0]).ravel().tolist() == [0.0] * n
    assert np.isinf(np.array(results[3])).all()


def test_the_continuous_form_agrees_with_short_steps(bank, tanks):
    memory = bank.memory0([0.5, 0.1, 0.3], x_range=START)
    u, y = np.array([5.8e-5, 3.5e-6]), np.array([0.5, 0.1])
    short = FilterBank(Ts=1e-5, region=REGION).design(tanks)
    moved = np.array(short.step(memory, u, y)[0]).ravel()
    slope = (moved - memory) / 1e-5
    rates = np.array(bank.ode(memory, u, y)).ravel()
    layout = bank.memory_layout
    for name in ("hidden_lower", "hidden_upper", "filter_lower", "filter_upper", "response"):
        # the envelope of the step still adds what y moves in 1e-5 s
        np.testing.assert_allclose(slope[layout[name]], rates[layout[name]], rtol=1e-4, atol=1e-6)


def test_through_simulate_and_the_fault_detector(bank, tanks):
    scenario = ob.scenarios.three_tanks(end=210.0)
    detector = ob.FaultDetector(bank)
    run = ob.simulate(bank.model, detector, scenario)
    assert min(run.coverage[name] for name in ("x1", "x2", "x3")) == 1.0
    first = np.flatnonzero(run.alarm[:, 0])[0]
    assert first * 0.01 - 200.0 == pytest.approx(1.37, abs=0.02)
    assert not run.alarm[:, 1].any()
    fine = ob.simulate(tanks, bank, ob.scenarios.three_tanks("fault free", end=20.0), substeps=4)
    assert min(fine.coverage.values()) == 1.0
    assert fine.outside == ()


def test_steady_widths_are_predicted(tanks, closed_loop, bank):
    # flows through zero have slopes without a bound, so nothing is predicted over a wide region
    assert "core_half_widths" not in bank.performance
    assert all(
        "no more than is declared" in bank.widths[name] for name in ("x3", "theta1", "theta2")
    )
    narrow = FilterBank(Ts=0.01).design(tanks)
    run = closed_loop(narrow)(bounded_noise(7, 40_000, [BOUND] * 2), x_range=START)
    last = slice(30_000, None)
    states = (run["x_upper"] - run["x_lower"])[last] / 2
    faults = (run["f_upper"] - run["f_lower"])[last] / 2
    found = np.concatenate([states.max(axis=0), faults.max(axis=0)])
    assert (found <= narrow.half_widths).all()
    # and not by much: faults within a quarter, the unmeasured level within a factor of two
    by_filters = narrow.performance["mean_half_widths"]
    assert (by_filters[:, 0] < 1.25 * found[3:]).all()
    assert narrow.half_widths[2] < 2.0 * found[2]
    low, high = intervals(narrow, {name: value[last] for name, value in run.items()})
    every = (high - low).max(axis=0) / 2
    assert (every <= by_filters).all() and (by_filters < 1.25 * every).all()
    assert (narrow.half_widths[3:] >= by_filters.max(axis=1)).all()
    smallest = ob.FaultDetector(narrow).smallest_detectable
    assert smallest == pytest.approx(2.0 * by_filters[:, 0], rel=1e-6)
    assert (smallest < [8e-5, 6e-5]).all()


@pytest.mark.parametrize("horizon", [400, 2000])
def test_widths_of_sets_that_are_young(tanks, closed_loop, horizon):
    """After N calls a copy has not settled; mutants: the limit taken, 2 N calls counted."""
    bank = FilterBank(Ts=0.01, horizon=horizon).design(tanks)
    limit = FilterBank(Ts=0.01).design(tanks).performance["mean_half_widths"]
    run = closed_loop(bank)(bounded_noise(7, 3 * horizon, [BOUND] * 2), x_range=START)
    low, high = intervals(bank, run)
    for k in (2 * horizon, 3 * horizon):  # the call before and the call at which a copy is given up
        found = np.minimum(high[k : k + 2] - low[k : k + 2], 4e-4).max(axis=0) / 2
        assert (found <= bank.performance["mean_half_widths"]).all()
        assert (found[:, 0] > limit[:, 0]).all()
        assert (run["x_upper"] - run["x_lower"])[k, 2] / 2 <= bank.half_widths[2]


def test_the_old_spelling_designs_the_bank(bank, tanks, certify):
    old = ob.SetAdaptiveObserver(robust=True, Ts=0.01, region=REGION)
    observer = old.design(tanks)
    assert observer.method == bank.method == "filter_bank"
    assert observer.record == bank.record
    assert str(observer.guarantee) == str(bank.guarantee)
    with pytest.raises(ob.ObsynthError, match="no gains") as refusal:
        old.analyse(tanks, {"L": np.eye(3, 2)})
    assert refusal.value.option == "robust"
    with pytest.raises(ob.ObsynthError, match="no gains"):
        FilterBank().analyse(tanks, {"L": np.eye(3, 2)})


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"filters": ()}, "filters is"),
        ({"filters": (0.1, -0.2)}, "filters is"),
        ({"Ts": 0.0}, "Ts is"),
        ({"precision": "half"}, "precision is"),
        ({"region": [0.1, 0.2]}, "region is"),
        ({"region": "wide"}, "region is"),
    ],
)
def test_options_out_of_range(options, words):
    with pytest.raises(ob.ObsynthError, match=words):
        FilterBank(**options)


@pytest.mark.parametrize("region", [[(0, 1)], [(0, 1), (0, np.inf), (0, 1)]])
def test_a_region_that_does_not_fit(tanks, region):
    with pytest.raises(ob.ObsynthError, match="region") as refusal:
        FilterBank(region=region).design(tanks)
    assert refusal.value.option == "region"


# -- monotone equations --------------------------------------------------------------


def test_signs_are_proved_through_a_flow_without_a_derivative(tanks):
    monotone = Monotone(with_ranges(tanks, [(0.0, 1.0)] * 3))
    assert [monotone.signs(i, tanks.x).tolist() for i in range(3)] == [
        [-1, 0, 1],
        [0, -1, 1],
        [1, 1, -1],
    ]
    assert monotone.signs(0, tanks.f).tolist() == [1, 0]


def test_an_equation_that_is_not_monotone_is_named():
    plant = ob.Plant("bump")
    a, b = plant.states("a b", range=(0, 2))
    (f,) = plant.faults("f", range=(-1, 1))
    plant.dynamics([b * (1 - b) - a + f, a - b])
    plant.outputs([a])
    with pytest.raises(
        ob.StructureError, match=r"equation of a is not proved to be monotone in b"
    ) as refusal:
        FilterBank().design(plant)
    assert refusal.value.symbol == "b"
    narrow = FilterBank(region=[(0, 2), (0.6, 2)]).design(plant)
    assert narrow.certificate.valid


def chain(fault_rows, **changes):
    """Four levels in a row, of which the first and the last are measured."""
    plant = ob.Plant("chain")
    x = plant.states("x1:5", range=(0.0, 3.0))
    (u,) = plant.inputs("u", range=(0, 2))
    faults = plant.faults("f1:3", range=(-0.2, 0.2))
    (v,) = plant.disturbances("v", bound=0.01)
    (w,) = plant.disturbances("w", bound=0.02)
    (k,) = plant.params("k", range=(0.9, 1.1))
    (d,) = plant.params("d", range=(0.99, 1.01))
    flow = [x[0] - x[1], d * (x[1] - x[2]), x[2] - x[3]]
    out = x[3] ** 2 / 2
    rates = [u - flow[0], flow[0] - flow[1] + w, flow[1] - flow[2], flow[2] - k * out]
    for fault, row in zip(faults, fault_rows, strict=True):
        rates[row] += (x[0] if changes.get("varying") else 1) * fault
    plant.dynamics(rates)
    plant.outputs([x[0] + v, x[3]])
    return plant


def test_parameters_disturbances_and_two_unmeasured_states():
    plant = chain((0, 3))
    with pytest.raises(ob.StructureError, match="equation of x2 is not proved to be monotone in d"):
        FilterBank().design(plant)
    ordered = [(2.0, 3.0), (1.5, 2.0), (1.0, 1.5), (0.2, 1.0)]
    bank = FilterBank(Ts=0.02, region=ordered, filters=(0.5,)).design(plant)
    rng = np.random.default_rng(3)
    F = bank.model.function()
    x, theta = np.array([2.3, 1.75, 1.2, 0.75]), np.array([0.1, -0.05])
    memory = bank.memory0(x)
    for _ in range(120):
        v, w = rng.choice([-0.01, 0.01]), rng.choice([-0.02, 0.02])
        u, y = [0.4], x[[0, 3]] + [v, 0.0]
        memory, _, _, low, high, f_low, f_high, status = bank.step(memory, u, y)
        assert int(status) == 0
        assert (np.array(low).ravel() <= x + 1e-12).all()
        assert (x <= np.array(high).ravel() + 1e-12).all()
        assert (np.array(f_low).ravel() <= theta).all()
        assert (theta <= np.array(f_high).ravel()).all()
        x = np.array(F(x, u, [], theta, [v, w], [1.05, 0.99], [])[0]).ravel()
    assert (np.array(f_high - f_low) < 0.4).all()
    assert "core_half_widths" not in bank.performance


@pytest.mark.parametrize(
    ("rows", "changes", "words"),
    [
        ((0, 1), {}, "f2 enters the equation of x2, which is not measured"),
        ((0, 0), {}, "f1 and f2 enter the same equation"),
        ((0, 3), {"varying": True}, "f1 .*factor x1; the bank needs a constant"),
    ],
)
def test_other_plants_are_refused_by_name(rows, changes, words):
    with pytest.raises(ob.StructureError, match=words):
        FilterBank().design(chain(rows, **changes))


def test_an_unmeasured_state_that_grows_by_itself_is_refused():
    plant = ob.Plant("growing")
    a, b = plant.states("a b", range=(0, 1))
    (f,) = plant.faults("f", range=(-1, 1))
    plant.dynamics([-a + b + f, b - 2 * a])
    plant.outputs([a])
    with pytest.raises(ob.StructureError, match="derivative of b rises with b itself"):
        FilterBank().design(plant)


def test_the_range_of_the_noise_is_rounded_outwards():
    """Thirds of decimal bounds are no doubles; mutant: no rounding of the sums."""
    plant = ob.Plant("sum of thirds")
    (x,) = plant.states("x", range=(1, 2))
    (f,) = plant.process_faults("f", range=(-1, 1))
    w = plant.disturbances("w1:6", bound=[0.1, 0.3, 0.7, 0.9, 1.1])
    plant.dynamics([-x + f])
    plant.outputs([x + sum(w) / 3])
    low, high = filter_bank_model(plant).noise[0]
    exact = sum(Fraction(s.upper) for s in plant.w) / 3
    assert Fraction(low) <= -exact and exact <= Fraction(high)
    assert float(high) <= float(exact) * (1.0 + 1e-12)
