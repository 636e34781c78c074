"""What an observer says of a record: the leak of the rig, what refutes it, what is shown."""

import dataclasses
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from recorded import measured, start_of
from records import damaged_record

import obsynth as ob
from methods import observer_of
from obsynth.designs.core.observer import STATUS
from obsynth.evaluate import march
from obsynth.evaluate.data import allowed, estimated
from obsynth.evaluate.data.estimated import Estimate

RECORD = ob.records.three_tank_leak()
# least disturbance bounds of the record and its parameters, /reference/data.json cv.whole
TH = {
    "a1": 0.023763991113147354,
    "a3": 0.021526928813387875,
    "b1": 0.03753119977068314,
    "b3": 0.035026740816003106,
}
OMEGA = 0.001568056043987548, 0.006994620522516981


def tanks(rate=None, factor=1.2):
    wx, wy = factor * np.array(OMEGA)
    return ob.plants.leaking_tanks(wx=wx, wy=wy, rate=rate, **TH)


@pytest.fixture(scope="module")
def told():
    return ob.estimate(ob.IntervalObserver().design(tanks()), RECORD)


def test_the_leak_at_the_least_bounds_of_its_record(told):
    """The note's numbers: .0199 by one step, all readings of the meter inside, certain from 61.

    Mutants: pulses of the interval before; the leak's sets one instant late.
    """
    assert told.widths()["leak"]["median"] <= 0.0199 and told.refuted is None
    assert told.widths()["leak"]["of_range"] == told.widths()["leak"]["median"] / 0.05
    beside = told.compare(leak=("pulses", "rate"), scale=0.000968)
    assert beside.inside == 1.0 and beside.false_alarms == 0
    assert beside.scales == pytest.approx((0.0007024857, 0.0012708368), rel=1e-3)
    assert (told.time[beside.first], told.time[beside.known]) == (61, 62)
    own = told.compare(leak=("pulses", "rate"))
    assert own.scale == pytest.approx(0.000968, rel=3e-3) and own.inside == 1.0
    at = told.time[told.alarms()["leak"]]
    assert at[0] == 61 and np.mean(np.isin(np.arange(61, 200), at)) >= 0.604
    assert told.consistent == 1.0 and max(told.use.values()) <= 1.0


@pytest.mark.parametrize(
    "method",
    [
        ob.BoundedErrorUIO(bounds="peak"),
        ob.BoundedErrorUIO(),
        pytest.param(ob.SetMembershipObserver(), marks=pytest.mark.long),
        pytest.param(ob.IntervalObserver(gains="search"), marks=pytest.mark.long),
    ],
)
def test_other_methods_are_as_sharp_on_it(method):
    told = ob.estimate(method.design(tanks()), RECORD)
    beside = told.compare(leak=("pulses", "rate"), scale=0.000968)
    assert told.widths()["leak"]["median"] <= 0.0199
    assert beside.inside == 1.0 and beside.false_alarms == 0 and told.time[beside.first] == 61
    assert told.refuted is None and told.consistent == 1.0


def with_y(change):
    return dataclasses.replace(RECORD, y=RECORD.y + change)


def test_a_reading_that_is_off_refutes_the_record_and_is_named(told, monkeypatch):
    """Mutants: the memory before the block kept for the next; the instant before."""
    for i, name in enumerate(RECORD.names["y"]):
        off = np.zeros((181, 3))
        off[64, i] = 0.3
        broken = ob.estimate(told.observer, with_y(off))
        assert (broken.refuted.instant, broken.refuted.time) == (64, 100)
        assert broken.refuted.signals == (name,) and broken.status[64] & 8
        assert f"without {name} it would not be" in str(broken.refuted)
        assert np.array_equal(broken.x_lower[:64], told.x_lower[:64])
        assert broken.first["void"] == 64 and broken.status_shares["void"] < 0.02
        assert np.array_equal(broken.x_lower[90:], told.x_lower[90:])
        with monkeypatch.context() as patched:
            patched.setattr(march, "BLOCK", 50)
            again = ob.estimate(told.observer, broken.record)
        assert again.blamed == (name,) and np.array_equal(again.f_lower, broken.f_lower)
    assert told.status_shares["ok"] == 180 / 181 and told.first["fault_not_valid"] == 0
    assert told.blamed == ()


def test_a_set_that_misses_its_declared_range_is_a_conflict():
    """The sets of a core alone are not cut with the ranges. Mutant: upper ends not looked at."""
    observer = ob.IntervalObserver(cuts=()).design(tanks())
    off = np.zeros((181, 3))
    off[64, 1] = 0.3
    missed = {}
    for sign in (1, -1):
        told = ob.estimate(observer, with_y(sign * off))
        assert not np.any(told.status & STATUS["void"])
        assert told.conflict[0] == 64 and set(told.conflict) <= {64, 65}
        assert told.refuted.instant == 64 and "misses the declared range" in told.refuted.why
        missed[sign] = told.refuted.signals
    assert missed[1] == ("e1", "h2", "leak") and "leak" in missed[-1]
    clean = ob.estimate(observer, RECORD)
    assert clean.conflict.size == 0 and clean.refuted is None


def test_alarms_are_those_of_the_detector(told):
    """Mutants: skipped samples end a count; void ones keep it."""
    rng, late = np.random.default_rng(0), told.fault_delay
    bits = rng.choice([0, 0, 0, 4, 8, 16, 32, 64], 181)
    low = rng.uniform(-0.02, 0.03, (181, 1))
    made = dataclasses.replace(told, status=bits, f_lower=low, f_upper=low + 0.03)
    for persistence in (1, 2, 4):
        detector = ob.FaultDetector(told.observer, persistence=persistence)
        on = detector.alarms(low, low + 0.03, bits)[:, 0] & detector.valid(bits)
        expected = np.flatnonzero(on) - late
        assert made.alarms(persistence)["leak"].tolist() == expected[expected >= 0].tolist()
    assert on.any()
    with pytest.raises(ob.SimulationError, match="persistence=0"):
        told.alarms(0)


def test_a_comparison_counts_what_it_says(told):
    """Mutants: scales of negative readings the wrong way round; quiet instants not looked at."""
    low = np.full((181, 1), -1.0)
    low[51:101] = 1.0
    level = np.zeros((181, 1))
    level[50:100], level[120:130] = 2.0, -0.5
    names = {**RECORD.names, "reference": ("meter",)}
    record = dataclasses.replace(RECORD, reference=level, names=names)
    made = dataclasses.replace(
        told, record=record, f_lower=low, f_upper=low + 2.0, status=told.status * 0
    )
    found = made.compare(leak=("meter", "level"))
    assert found.scales == (0.5, 1.5) and found.false_alarms == 0 and found.inside == 1.0
    assert found.scale == pytest.approx(50 * 2 * 2 / (50 * 4 + 10 * 0.25))
    assert (found.first, found.known, found.certain) == (50, 51, 50 / 60)
    late = np.roll(level, 1)
    shifted = dataclasses.replace(made, record=dataclasses.replace(record, reference=late))
    found = shifted.compare(leak=("meter", "level"))
    assert found.scales is None and found.false_alarms == 1 and found.first == 51
    assert "no scale holds all readings" in str(found)
    assert shifted.compare(leak=("meter", "level"), scale=0.6).inside == 178 / 180
    none = dataclasses.replace(made, record=dataclasses.replace(record, reference=0 * level))
    for given, refusal in [
        ({"leak": ("meter", "level")}, "nowhere other than zero"),
        ({"leak": ("meter", "flow")}, "'rate' .of a counter. or 'level'"),
        ({"leek": ("meter", "rate")}, "takes one of e1, h2, e3, leak"),
        ({}, "got {}"),
    ]:
        with pytest.raises(ob.SimulationError, match=refusal):
            none.compare(**given)
    with pytest.raises(ob.PlantError, match="no channel is called 'flow'"):
        none.compare(leak=("flow", "rate"))


def test_what_is_allowed_holds_nonlinear_outputs(monkeypatch):
    """Dense sampling of the sets. Mutants: ends of one state exchanged; noise left out."""
    name, rng = "general_uio", np.random.default_rng(1)
    told = ob.estimate(observer_of(name), measured(name), **start_of(name))
    lower, upper = told.y_range
    box, shown = told.observer.model.box("w"), []
    corners = np.array(np.meshgrid(*[[0, 1]] * 3)).reshape(3, -1).T
    for share in [*rng.uniform(size=(200, 3)), *corners]:
        x = told.x_lower + share[:2] * (told.x_upper - told.x_lower)
        w = box[:, 0] + np.roll(share, 1) * (box[:, 1] - box[:, 0])
        y = [[i + w[0], omega + w[1], i * omega / 20 + w[2]] for i, omega in x]
        shown.append(y)
    assert np.all(np.array(shown) >= lower - 1e-12) and np.all(np.array(shown) <= upper + 1e-12)
    assert np.all(np.ptp(shown, axis=0) >= 0.5 * (upper - lower))
    assert told.consistent == 1.0
    monkeypatch.setattr(allowed, "BLOCK", 16)
    again = dataclasses.replace(told)
    assert np.array_equal(again.y_range, told.y_range)


def test_readings_with_a_fault_are_allowed_what_its_sets_or_its_range_allow(monkeypatch):
    """Mutants: the sets of the instant after; means taken for the fault itself."""
    plant = ob.Plant("sensor")
    (x,) = plant.states("x", range=(-1, 1))
    (w,) = plant.disturbances("w", bound=0.125)
    plant.dynamics([x / 2 + w], Ts=1)
    plant.outputs([x])
    plant.sensor_faults("f", of="y1", range=(-4, 4))
    names = {"u": (), "y": ("y1",)}
    units = {"u": (), "y": ("",)}
    none = np.zeros((3, 0))
    record = ob.Record(
        np.arange(3.0), none, np.array([[1.0], [9.0], [3.0]]), none, names, units, ""
    )
    low = np.array([[0.0], [1.0], [2.0]])
    observer = SimpleNamespace(model=plant, fault_delay=1, method="by hand")
    sets = (low, low, 0 * low, 0 * low, low, low + 0.5)
    told = Estimate(observer, record, *sets, status=np.array([0, 0, 16]))
    found = [1, 1.5], [-4, 4], [-4, 4]
    assert np.hstack(told.y_range).tolist() == [*found]
    assert told.consistent == pytest.approx(2 / 3) and told.use == {"y1": 2.25}
    monkeypatch.setattr(estimated, "core_of", lambda _: SimpleNamespace(mean_fault=True))
    assert np.hstack(dataclasses.replace(told).y_range).tolist() == [[-4, 4]] * 3


def test_an_observer_is_told_the_first_reading(told):
    """Mutant: the second one."""
    given = {}

    class Asked:
        def __getattr__(self, name):
            return getattr(told.observer, name)

        def memory0(self, guess, **start):
            given.update(start)
            return told.observer.memory0(guess, **start)

    again = ob.estimate(Asked(), RECORD)
    assert np.array_equal(given["y0"], RECORD.y[0]) and given["x_range"] is None
    assert np.array_equal(again.f_lower, told.f_lower)


def test_columns_files_and_frames_are_the_same_numbers(told, tmp_path):
    """Mutants: faults in the row of the call that knows them; fewer digits."""
    import pandas as pd

    path = told.write(tmp_path / "told.csv")
    frame = told.to_frame()
    assert frame.index.name == "time" and frame["leak_lower"].iloc[25] == told.f_lower[26, 0]
    assert np.isnan(frame["leak_hat"].iloc[-1]) and frame["pulses"].iloc[-1] == RECORD["pulses"][-1]
    # by their texts: pandas before 3.1 reads a third of all numbers a bit off
    again = pd.read_csv(path, dtype=str).astype({"time": float, **frame.dtypes}).set_index("time")
    pd.testing.assert_frame_equal(again, frame, check_exact=True)
    cube = told.to_xarray()
    assert np.array_equal(cube["f_lower"], told.f_lower) and cube.attrs["fault_delay"] == 1
    assert cube["reference"].sel(channel="pulses").shape == (181,)


def test_a_file_is_replaced_only_when_it_is_complete(told, tmp_path, monkeypatch):
    path = tmp_path / "told.csv"
    path.write_text("old")
    import pandas as pd

    def breaks(frame, beside, **_):
        Path(beside).write_text("half")
        raise OSError("full")

    monkeypatch.setattr(pd.DataFrame, "to_csv", breaks)
    with pytest.raises(OSError, match="full"):
        told.write(path)
    assert path.read_text() == "old" and [p.name for p in tmp_path.iterdir()] == ["told.csv"]
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    cases = [("told.txt", "neither with"), ("no/told.csv", "does not exist")]
    for bad, refusal in [*cases, ("told.parquet", "needs pyarrow: pip install")]:
        with pytest.raises(ob.ObsynthError, match=refusal):
            told.write(tmp_path / bad)


def test_what_is_shown(told, tmp_path):
    import json

    import matplotlib as mpl

    mpl.use("agg")
    page = told.report(tmp_path / "page.html", leak=("pulses", "rate")).read_text()
    assert "Records" in page and "100 % inside" in page and "src=" not in page
    assert (
        "nothing in three_tank_leak.csv refutes" in repr(told)
        and "certain from [s]" in told._repr_html_()
    )
    assert ob.plot_signal(told, "leak")[0].get_ylabel() == "leak [V/s]"
    assert [ax.get_ylabel() for ax in told.plot(("h2", "leak"))] == ["h2 [V]", "leak [V/s]"]
    numbers = json.loads(json.dumps(told.to_dict(), allow_nan=False))
    assert numbers["alarms"]["leak"][0] == 25 and numbers["refuted"] is None


def test_a_record_of_another_plant_is_refused(told):
    turned = dataclasses.replace(RECORD, names={**RECORD.names, "y": ("y2", "y1", "y3")})
    with pytest.raises(ob.SimulationError, match=r"y2, y1, y3 as y; .* has y1, y2, y3"):
        ob.estimate(told.observer, turned)
    slow = dataclasses.replace(RECORD, time=2 * RECORD.time)
    with pytest.raises(ob.SimulationError, match=r"has 2 s from t = 72 on; .* every 1 s"):
        ob.estimate(told.observer, slow)
    record = measured("qpv_observer")
    without = dataclasses.replace(
        record, rho=(), names=record.names | {"rho": ()}, units=record.units | {"rho": ()}
    )
    with pytest.raises(ob.SimulationError, match="has nothing as rho; vessel has theta"):
        ob.estimate(observer_of("qpv_observer"), without)


def test_the_estimate_goes_on_over_damage_and_sets_come_back():
    """A channel missing for a while, two gaps, a stuck sensor, an outlier.

    Mutants: an instant without a row left out of the estimate; readings that are left out used.
    """
    damaged = damaged_record()
    record, k = damaged.record, np.arange(len(damaged.record))
    observer = ob.IntervalObserver().design(damaged.plant)
    told = ob.estimate(observer, record)
    stuck, outlier = damaged.stuck[1], damaged.outlier[1]
    assert stuck.start <= told.refuted.instant < stuck.stop and told.refuted.signals == ("y2",)
    void = np.flatnonzero(told.status & STATUS["void"])
    assert set(void) <= {*k[stuck], stuck.stop, outlier} and outlier in void
    inside = np.all((told.x_lower <= damaged.x) & (damaged.x <= told.x_upper), axis=1)
    sound = (k < stuck.start) | (k > stuck.stop + observer.certificate.design.options["recovery"])
    assert inside[sound].all() and not inside.all()
    quiet = np.zeros(len(k), dtype=bool)
    for gap in (*damaged.gaps, damaged.missing[1]):
        quiet[gap] = True
    assert np.array_equal(told.status & STATUS["measurement_left_out"] > 0, quiet)
    assert not np.any(told.status & STATUS["non_finite_input"])
    half = told.x_upper - told.x_lower
    last = damaged.gaps[0].stop
    assert np.all(half[last - 1] > half[last + 3]) and np.isfinite(half).all()
    assert np.all(np.median(half[-40:], axis=0) <= 1.5 * np.median(half[:80], axis=0))
    for finding in record.findings():
        record = record if finding.kind == "missing" else record.without(finding)
    mended = ob.estimate(observer, record)
    assert mended.refuted is None and mended.consistent == 1.0
    assert np.all((mended.x_lower <= damaged.x) & (damaged.x <= mended.x_upper))
    assert np.all(mended.f_lower[1:] <= damaged.f[:-1]) and np.any(mended.f_upper[1:] < 0)
    assert np.all(damaged.f[:-1] <= mended.f_upper[1:])
    assert mended.alarms()["f"][0] > 200
    again = ob.estimate(observer, damaged.source, map={"v": "pump"})
    assert np.array_equal(again.f_lower, told.f_lower)
    assert again.record.notes == damaged.record.notes
