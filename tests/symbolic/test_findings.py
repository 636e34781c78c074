"""What readings show before any model: found where it is, and nowhere else."""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from gallery import TIMES
from records import damaged_record

import obsynth as ob
from obsynth.symbolic.findings import find, quantum

LEAK = ob.records.three_tank_leak()
K = np.arange(400.0)
STILL = np.zeros((400, 1))


def found(y, inputs=STILL) -> list[tuple[str, int, int]]:
    return [(f.kind, f.rows[0], f.rows[-1]) for f in find("y", y, K, inputs)]


def test_nothing_is_found_in_the_readings_of_the_leak():
    """Their runs of up to ten equal readings are those of a slow level and a coarse quantum."""
    assert LEAK.findings() == () and ob.records.three_tank_leak(0).findings() == ()
    for step in LEAK.quanta.values():
        assert step == pytest.approx(0.010194, abs=3e-6)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_damaged_record_names_all_that_was_done_to_it(seed):
    """Mutants: runs one row longer; rows counted in the source, without the gaps; no outlier."""
    damaged = damaged_record(seed)
    record = damaged.record
    (outlier,), (stuck,) = record.findings("outlier"), record.findings("stuck")
    assert (outlier.channel, outlier.rows.tolist()) == ("y1", [damaged.outlier[1]])
    name, rows = damaged.stuck
    assert stuck.channel == name and stuck.rows[-1] == rows.stop - 1
    assert rows.start - 1 <= stuck.rows[0] <= rows.start
    assert not record.findings("saturated")
    gaps = np.concatenate([np.r_[gap] for gap in damaged.gaps])
    for lost in record.findings("missing"):
        there = np.r_[damaged.missing[1]] if lost.channel == damaged.missing[0] else []
        assert set(lost.rows) == {*gaps, *there}
    assert "there is no row for 11 instants of 400, first t = 41 s" in record.notes
    assert "first t = 41 s: its last value is held" in record.notes[2]
    assert set(record.quanta) == {"y1", "y2", "y3"}
    np.testing.assert_allclose(list(record.quanta.values()), 0.01, rtol=1e-9)
    for finding in record.findings():
        record = record.without(finding)
    assert {f.kind for f in record.findings()} == {"missing"}
    assert np.isnan(record["y1"][310]) and "y2: readings were taken out at" in record.notes[-3]


def test_the_truth_of_the_damaged_record_keeps_every_range():
    """Where nothing was done to the readings, they lie within the noise of the truth."""
    for seed in range(3):
        damaged = damaged_record(seed)
        plant, y = damaged.plant, damaged.record.y.copy()
        for signals, kind in ((damaged.x, "x"), (damaged.f, "f"), (damaged.record.u, "u")):
            low, high = plant.box(kind).T
            assert (low <= signals).all() and (signals <= high).all()
        assert np.abs(np.diff(damaged.f, axis=0)).max() <= plant.f[0].rate
        y[damaged.stuck[1], 1], y[damaged.outlier[1], 0] = np.nan, np.nan
        assert np.nanmax(np.abs(y - damaged.x)) <= 0.05


def test_saturation_cuts_off_a_motion_and_a_peak_does_not():
    """Mutants: the other end of a run not looked at; the quantum left out of what is allowed."""
    wave = np.round(np.sin(K / 40), 3)
    assert found(wave) == [] and found(np.round(wave, 1)) == []
    kinds = found(np.minimum(wave, 0.8))
    assert [kind for kind, _, _ in kinds] == ["saturated", "saturated"]
    clipped = np.flatnonzero(wave >= 0.8)
    assert kinds[0][1] == clipped[0] and kinds[-1][2] == clipped[-1]
    # a first-order answer that settles at its largest value for ever
    assert found(np.round(1 - np.exp(-K / 10), 2)) == []


def test_stuck_is_told_by_noise_that_is_missing_or_by_a_jump_that_no_input_has():
    rng = np.random.default_rng(0)
    noisy = np.round(5 + np.sin(K / 50) + rng.uniform(-0.1, 0.1, 400), 2)
    noisy[100:140] = noisy[100]
    assert found(noisy)[-1][::2] == ("stuck", 139) and found(noisy)[-1][1] in (99, 100)
    slow = np.round(0.02 * K, 1)
    assert found(slow) == []
    slow[200:300] = slow[200]
    assert found(slow) == [("stuck", 198, 299)]
    # a level that rests, and the pump that ends the rest
    pump = (K >= 300)[:, None] * 1.0
    level = np.round(np.where(K < 200, 0.02 * K, 4) + (2 + 0.02 * (K - 300)) * pump[:, 0], 1)
    assert found(level, pump) == [] and found(level) == [("stuck", 198, 299)]


def test_a_quantum_coarser_than_noise_explains_rest_steps_and_flicker():
    """Mutants: moves to and fro of one quantum count; the activity of a slow channel not asked."""
    rng = np.random.default_rng(3)
    noise = rng.uniform(-0.04, 0.04, 400)
    level = np.round(np.where(K < 300, 0.01 * K, 3) + noise, 1)
    assert found(level) == []
    # settles at its largest value, and falls without slowing down
    rise = np.where(K < 100, 0, np.where(K < 200, 1 - np.exp((100 - K) / 10), 0))
    answer = rise + np.where(K < 200, 0, np.exp(np.minimum(200 - K, 0) / 10))
    assert found(np.round(answer, 2)) == []
    # four quanta are within what may be missing at a peak, single ones are no outliers
    wave = np.round(8 * np.sin(K / 30)) / 8
    assert found(wave) == [] and found(wave + (K == 140) / 8) == []
    assert found(((K >= 200) | (K == 100)) * 0.1) == []
    stairs = np.floor(K / 6) * 0.1 + (K >= 310) * 2
    stairs[300:310] = stairs[300]
    assert found(np.round(stairs, 1)) == []


def test_outliers_are_far_from_both_neighbours_and_from_what_is_usual():
    """Mutant: a step, which is far from one neighbour only, counts."""
    rng = np.random.default_rng(1)
    y = np.sin(K / 20) + rng.uniform(-0.02, 0.02, 400)
    assert found(y) == [] and found(y + (K >= 200)) == []
    assert found(y + (K == 200)) == [("outlier", 200, 200)]
    assert found(y + (K == 200), (K == 200)[:, None] * 1.0) == []
    assert found(y + (K == 200), (K == 199)[:, None] * 1.0) == []
    burst = y + np.where(abs(K - 200) < 10, np.cos(3 * K), 0)
    assert found(burst) == []


def test_the_quantum_is_the_step_of_all_differences():
    rng = np.random.default_rng(2)
    for step in (0.01, 5 / 1024, 3.0):
        codes = rng.integers(-300, 300, 50)
        assert quantum(codes * step) == pytest.approx(step, rel=1e-9)
        assert quantum(np.round(codes * step, 4)) == pytest.approx(step, rel=1e-2)
    assert np.isnan(quantum(rng.normal(size=50))) and np.isnan(quantum(np.ones(9)))
    assert np.isnan(quantum(np.full(5, np.nan)))


@pytest.mark.long
@pytest.mark.parametrize("name", TIMES)
def test_nothing_is_found_in_what_healthy_sensors_of_the_gallery_show(name):
    """With and without noise, at four quanta."""
    plant = getattr(ob.plants, name)().discretise("euler", Ts=TIMES[name])
    step, bounds = plant.function(), plant.box("w")
    scenario = ob.scenarios.gentle(plant, 400, 0, 0.02)
    fields, middle = scenario.arrays(plant, 0), [(s.lower + s.upper) / 2 for s in plant.p]
    for noise in (0, 0.1, 1):
        rng, x, rows = np.random.default_rng(0), np.array(scenario.x0, dtype=float), []
        for k in range(400):
            w = noise * rng.uniform(*bounds.T)
            given = [fields[kind][k] if len(getattr(plant, kind)) else [] for kind in "udf"]
            x, shown = (v.full()[:, 0] for v in step(x, *given, w, middle, []))
            rows.append(shown)
        for y in np.array(rows).T:
            for share in (0, 0.25, 1, 4):
                q = share * (bounds.max() if noise else np.ptp(y) / 100)
                seen = np.round(y / q) * q if q else y
                assert found(seen, fields["u"][:400]) == []


def test_records_are_cut_split_and_mended():
    """Mutants: times that begin at 0 anew; a window of what is left over."""
    cut = LEAK[10:50:2]
    assert cut.time.tolist() == list(range(46, 86, 2)) and np.array_equal(cut.y, LEAK.y[10:50:2])
    first, middle, last = LEAK.split(60, 100)
    assert (len(first), len(middle), len(last)) == (60, 40, 81) and last.time[0] == 136
    parts = LEAK.windows(50)
    assert [len(part) for part in parts] == [50] * 3 and parts[2].time[0] == 136
    assert len(LEAK[1:].windows(60)) == 3 and LEAK.windows(200) == ()
    mended = LEAK.without("y2", slice(3, 5)).without("y2", [0]).without("pulses")
    assert np.flatnonzero(np.isnan(mended["y2"])).tolist() == [0, 3, 4]
    assert np.isnan(mended["pulses"]).all() and not np.isnan(LEAK.y).any()
    counts = [f"y2: readings were taken out at {count} instants" for count in (2, 1)]
    assert mended.notes[:2] == tuple(counts) and "pulses: " in mended.notes[2]
    for call, text in (
        (lambda: LEAK.split(100, 60), "over two instants at least"),
        (lambda: LEAK.windows(1), "over two instants at least"),
        (lambda: LEAK.without("u1", 3), "u1 is known to the plant, .* leave the instants out"),
        (lambda: LEAK[3:4], "the time has to increase, over two instants at least"),
    ):
        with pytest.raises(ob.RecordError, match=text):
            call()


def test_a_record_is_shown_as_a_table_and_drawn():
    record = damaged_record(0).record
    text = record._repr_html_()
    assert ">1 stuck, 1 missing</td>" in text and "<li>v = pump</li>" in text
    assert repr(record) == "<Record 'dict', 400 samples, inputs v, outputs y1, y2, y3>"
    axes = record.plot()
    assert [ax.get_ylabel() for ax in axes] == ["v", "y1 [cm]", "y2 [cm]", "y3 [cm]"]
    marks = axes[1].lines[1].get_xdata()
    assert record.time[310] in marks and len(marks) == 12
    assert len(replace(record, notes=()).plot(["y3"])) == 1
    plt.close("all")
