"""Records of any source: the same numbers from all, what is refused, what is noted."""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import obsynth as ob

FILE = Path(ob.records.__file__).parent / "three_tank_leak.csv"
PLANT = ob.plants.leaking_tanks()
OFFSETS = {"y1": -0.160824, "y2": -0.103167, "y3": -0.156445}
MAP = {name: (name, 1, offset) for name, offset in OFFSETS.items()}
MAP |= {name: lambda c, name=name: (c[name] - 0.43) / (1 - 0.43) for name in ("u1", "u3")}


def tank() -> ob.Plant:
    """One input, two outputs, half a second."""
    plant = ob.Plant("tank")
    (h,) = plant.states("h", range=(0, 2), unit="m")
    (v,) = plant.inputs("v", range=(0, 1), unit="l/s")
    plant.dynamics([0.9 * h + 0.1 * v], Ts=0.5)
    plant.outputs([h, 2 * h], names="level weight", unit=["m", "kg"], range=[(0, 2), None])
    return plant


TANK = tank()


def log(**changed) -> dict:
    """Six rows that the tank takes as they are."""
    base = {
        "t": 0.5 * np.arange(6),
        "v": np.array([0, 0, 1, 1, 1, 0.5]),
        "level": np.array([0.5, 0.45, 0.4, 0.46, 0.51, 0.56]),
        "weight": np.array([1, 0.9, 0.8, 0.92, 1.02, 1.12]),
    }
    return base | changed


def read(map=None, time=None, options=None, **changed) -> ob.Record:
    return ob.read_record(log(**changed), TANK, map, time, **(options or {}))


def same(a: ob.Record, b: ob.Record) -> bool:
    arrays = ("time", "u", "rho", "y", "reference")
    equal = all(np.array_equal(getattr(a, n), getattr(b, n), equal_nan=True) for n in arrays)
    return equal and a.names == b.names and a.units == b.units


def test_the_file_of_the_leak_reads_to_the_record_that_ships_bit_for_bit():
    """Mutants: scale and offset swapped; a number of the text rounded."""
    record = ob.read_record(FILE, PLANT, map=MAP, reference={"pulses": "leak_pulses"})
    shipped = ob.records.three_tank_leak()
    assert same(record[36:], shipped) and record.source == shipped.source
    assert record.notes[2] == "y1 = y1 - 0.160824" and len(record.notes) == 6


def test_all_sources_give_the_same_record(tmp_path):
    """Mutant: the index of a frame dropped, so that its time is lost."""
    data = log(note=np.array(list("abcdef")))
    expected = ob.read_record(data, TANK)
    assert expected.notes == ("column 'note' is left out: row 0 is no number",)
    frame, before = pd.DataFrame(data), pd.DataFrame(data)
    frame.to_csv(tmp_path / "log.csv", index=False)
    frame.to_csv(tmp_path / "log.txt", index=False, sep=";", decimal=",")
    frame.to_csv(tmp_path / "log.tsv", index=False, sep="\t")
    packed = frame.drop(columns="note").to_records(index=False)
    sources = [frame, frame.set_index("t"), tmp_path / "log.csv", str(tmp_path / "log.txt")]
    sources += [tmp_path / "log.tsv", np.asarray(packed), frame.set_index("t").to_xarray()]
    sources += [{name: list(column) for name, column in data.items()}, frame.convert_dtypes()]
    for source in sources:
        found = ob.read_record(source, TANK)
        assert same(found, expected), source
    assert same(ob.read_record(expected.to_frame(), TANK), expected) and frame.equals(before)


@pytest.mark.parametrize("mark", [".", ","])
def test_numbers_of_a_text_are_read_to_the_last_bit(mark, tmp_path):
    """Mutant: the default conversion of pandas before 3.1, a third of these a last bit off."""
    t, levels = 0.5 * np.arange(200), np.random.default_rng(0).uniform(0, 2, 200)
    frame = pd.DataFrame({"t": t, "v": 1.0, "level": levels, "weight": 1.0})
    frame.to_csv(tmp_path / "log.csv", index=False, sep=";", decimal=mark)
    assert np.array_equal(ob.read_record(tmp_path / "log.csv", TANK).y[:, 0], levels)


def test_parquet_is_read_where_pyarrow_is_and_refused_where_not(tmp_path, monkeypatch):
    path = tmp_path / "log.parquet"
    path.write_bytes(b"PAR1")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ob.RecordError, match=r"'log.parquet': Parquet needs pyarrow: pip install"):
        ob.read_record(path, TANK)
    monkeypatch.undo()
    pytest.importorskip("pyarrow")
    with pytest.raises(ob.RecordError, match="cannot be read as PARQUET"):
        ob.read_record(path, TANK)
    pd.DataFrame(log()).to_parquet(path)
    assert same(ob.read_record(path, TANK), read())


def test_dates_durations_and_units_are_kept(tmp_path):
    """Mutants: seconds counted from 1970; the zone of a clock dropped, not converted."""
    dates = pd.date_range("2026-01-31 12:00", periods=6, freq="500ms", tz="Europe/Paris")
    frame = pd.DataFrame(log() | {"t": dates, "v2": np.arange(6.0)})
    frame.attrs["units"] = {"v2": "bar", "level": "cm"}
    record = ob.read_record(frame, TANK)
    assert record.start == np.datetime64("2026-01-31T11:00") and record.time[-1] == 2.5
    assert record.units["reference"] == ("bar",)
    assert record.notes == ("level is in cm, level in m, and no scale is given",)
    again = ob.read_record(record.to_frame(), TANK)
    assert same(again, record) and again.start == record.start
    frame.to_csv(tmp_path / "log.csv", index=False)
    assert ob.read_record(tmp_path / "log.csv", TANK).start == record.start
    spans = ob.read_record(frame.assign(t=dates - dates[0]), TANK)
    assert np.array_equal(spans.time, record.time) and spans.start is None
    data = xr.Dataset({n: ("time", v, {"units": "x"}) for n, v in log(w=np.ones(6)).items()})
    assert ob.read_record(data.drop_vars("t"), TANK).units["reference"] == ("x",)


def test_rows_are_instants_and_missing_ones_are_nan():
    """Mutant: missing rows dropped, so that later ones move forward."""
    keep = [0, 1, 2, 5]
    record = ob.read_record({n: v[keep] for n, v in log().items()}, TANK)
    assert np.array_equal(record.time, log()["t"])
    assert np.isnan(record.y[[3, 4]]).all() and np.array_equal(
        record.y[keep, 0], log()["level"][keep]
    )
    assert record["v"].tolist() == [0, 0, 1, 1, 1, 0.5]
    assert record.notes == (
        "there is no row for 2 instants of 6, first t = 1.5 s",
        "input v is missing at 2 instants of 6, first t = 1.5 s: its last value is held, which a "
        "guarantee assumes",
    )
    left = ob.read_record({n: v[keep] for n, v in log().items()}, TANK, hold=False)
    assert np.isnan(left["v"][[3, 4]]).all() and "it stays missing" in left.notes[1]


def test_what_is_seen_and_assumed_is_noted():
    moved = log()["t"] + np.array([0, 0.02, 0, -0.02, 0, 0])
    found = read(t=moved, options={"jitter": 0.05})
    assert np.array_equal(found.time, log()["t"])
    assert "stamps lie up to 0.02 s off the grid" in found.notes[0]
    far = log()["t"] + np.array([0, 0.2, 0, 0, -0.02, 0])
    assert np.array_equal(read(t=far, options={"jitter": 0.24}).time, log()["t"])
    assert read(time=False).notes == ("there is no time: rows are taken to be Ts = 0.5 s apart",)
    assert (
        "v runs over [0, 2] and leaves its declared range, [0, 1], at 1 instant of 6, first t = 1 s"
        in read(v=np.array([0, 0, 2, 1, 1, 1])).notes
    )
    assert "first t = 0 s" in read(level=np.array([-1, 0, 0, 0, 0, 3])).notes[0]
    none = read(map={"weight": None})
    assert np.isnan(none["weight"]).all() and none.notes == ("weight was not measured",)
    assert none.names["reference"] == ("column weight",)
    scaled = read(map={"level": ("weight", 0.5, 0.1)})
    assert np.array_equal(scaled["level"], 0.5 * log()["weight"] + 0.1)
    assert scaled.notes[0] == "level = 0.5 * weight + 0.1"
    assert same(read(t=[str(t) for t in log()["t"]]), read())
    minutes = read(t=log()["t"] / 60, time=("t", 60))
    np.testing.assert_allclose(minutes.time, log()["t"], rtol=1e-15)
    assert read(time=("t", 1, 2.0)).time[0] == 2


def test_measured_scheduling_is_held_like_an_input():
    plant = ob.Plant("vessel")
    (x,) = plant.states("x", range=(0, 9))
    theta, _ = plant.scheduling("theta hidden", range=(0, 1), measured=[True, False])
    plant.dynamics([x * theta / 2], Ts=1)
    plant.outputs([x])
    data = {"y1": [1.0, 2, 3], "theta": [0, np.nan, 2], "other": [7, 8, 9]}
    record = ob.read_record(data, plant, time=False)
    assert record.names["rho"] == ("theta",) and record.names["reference"] == ("other",)
    assert record.u.shape == (3, 0) and record.units["rho"] == ("",)
    assert record["theta"].tolist() == [0, 0, 2] and record["other"].tolist() == [7, 8, 9]
    span = "theta runs over [0, 2] and leaves its declared range, [0, 1], at 1 instant of 3"
    assert record.notes[2] == f"{span}, first t = 2 s" and len(record.notes) == 3
    frame = pd.DataFrame(data)
    frame.attrs["units"] = {"y1": "bar"}  # where the plant has no unit, none is missed
    assert ob.read_record(frame, plant, time=False).notes == record.notes


def test_resampling_is_asked_for_and_said():
    """Rows off the grid. Mutants: interpolation over gaps; inputs of the next row."""
    t = 0.07 + 0.1 * np.arange(40)
    data = {"t": t, "v": (t >= 1.2) * 1.0, "level": 0.5 + 0.1 * t, "weight": 1 + 0 * t}
    data["level"][20:34] = np.nan
    for way in ("nearest", "linear"):
        record = ob.read_record(data, TANK, resample=way)
        assert np.allclose(record.time, 0.07 + 0.5 * np.arange(8))
        assert record["v"].tolist() == [0, 0, 0, 1, 1, 1, 1, 1]
        there = np.isfinite(record["level"])
        assert np.array_equal(there, [1, 1, 1, 1, way == "nearest", 0, 0, 1])
        expected = (0.5 + 0.1 * record.time)[there]
        off = 1e-12 if way == "linear" else 0.0101  # the reading of .1 s before, at 1.1 % a second
        np.testing.assert_allclose(record["level"][there], expected, rtol=0, atol=off)
        assert (
            "to cover" in record.notes[0]
            and "inputs change between instants after 1" in record.notes[1]
        )
    at = ob.read_record(data | {"v": (t >= 1.0) * 1.0}, TANK, resample="nearest")
    assert at["v"].tolist() == [0, 0, 1, 1, 1, 1, 1, 1]
    assert not [note for note in at.notes if "between instants" in note]
    # .564 is less than .064 + .5 in doubles, and no other row is near
    rows = {"t": [0.064, 0.564, 2.064], "v": [0, 1, 0], "level": [1, 2, 3], "weight": [1, 1, 1]}
    for way in ("nearest", "linear"):
        record = ob.read_record(rows, TANK, resample=way)
        np.testing.assert_array_equal(record["level"], [1, 2, np.nan, np.nan, 3])
    gone = ob.read_record(data, TANK, map={"level": None}, resample="linear")
    assert np.isnan(gone["level"]).all() and gone["weight"].tolist() == [1] * 8
    late = {name: column[:2] for name, column in log(t=0.08 + log()["t"]).items()}
    assert len(ob.read_record(late, TANK, resample="nearest")) == 2  # .58 - .08 < .5 in doubles
    slow = {"t": [0, 1, 2, 5], "v": [0, 1, 1, 0], "level": [0, 1, 2, 5], "weight": [1, 1, 1, 1]}
    record = ob.read_record(slow, TANK, resample="linear")
    expected = [0, 0.5, 1, 1.5, 2] + [np.nan] * 5 + [5]
    np.testing.assert_array_equal(record["level"], expected)
    assert record["v"].tolist() == [0, 0, 1, 1, 1, 1, 1, 1, 1, 1, 0]
    near = ob.read_record(slow, TANK, resample="nearest")["level"]
    np.testing.assert_array_equal(near, [0, np.nan, 1, np.nan, 2] + [np.nan] * 5 + [5])


REFUSED = [
    (read, {"map": {"lever": "level"}}, r"map= names 'lever', .*'tank' .did you mean 'level'\?.; "),
    (
        read,
        {"map": {"level": "wieght"}},
        r"level has no column 'wieght' .did you mean 'weight'.*or ",
    ),
    (read, {"map": {"v": None}}, "v is mapped to None; a column, .column, scale. or"),
    (read, {"map": {"level": ("level", "2")}}, "level is mapped to .'level', '2'.; a column"),
    (read, {"map": {"level": ("level", np.inf)}}, "level is mapped to .'level', inf.; a column"),
    (read, {"map": {"level": lambda c: c["levle"]}}, "no column 'levle' .did you mean 'level'"),
    (
        read,
        {"map": {"level": lambda c: c["level"][1:]}},
        r"the function of level gives the shape .5,., not 6",
    ),
    (read, {"level": [1, 2, "x", "4", 5, 6]}, "column 'level', row 2: 'x' is no number; a missing"),
    (read, {"level": [1, 2, np.inf, 4, 5, 6]}, "column 'level', row 2: .*inf.* is no number"),
    (read, {"v": np.arange(6) * 1j}, "column 'v', row 0: .* is no number"),
    (read, {"v": [1, 2]}, "'dict' is no table of columns over time: .*same length"),
    (read, {n: v[:1] for n, v in log().items()}, "it has 1 rows; two at least"),
    (read, {"t": [0, 0.5, None, 1.5, 2, 2.5]}, "time 't' is missing at row 2"),
    (read, {"t": [0, 0.5, 1, 1, 1.5, 2]}, "time 't' does not increase after 1 s at row 3"),
    (read, {"t": [0, 0.5, 1, 1.6, 2, 2.5]}, "row 3, at 1.6 s, lies off .* 0.05 s off, 0.025 s are"),
    (
        read,
        {"t": [0, 0.5, 0.51, 1, 1.5, 2]},
        "rows 1 and 2, at 0.5 s and 0.51 s, .*one instant, drop",
    ),
    (read, {"t": [0, 0.5, 1, 1.5, 2, 1e6]}, "rows 4 and 5, at 2 s and 1000000 s, are far apart"),
    (read, {"t": 0.1 * np.arange(6)}, "rows are 0.1 s apart, .*Ts = 0.5 s: keep every 5th row"),
    (read, {"t": 1.0 * np.arange(6)}, "rows are 1 s apart, .*Ts = 0.5 s: discretise .* Ts = 1, "),
    (read, {"t": ["noon"] * 6}, "time 't', row 0: 'noon' is no number of seconds"),
    (read, {"time": "clock"}, "there is no column 'clock'"),
    (read, {"v": [None, 0, 1, 1, 1, 0]}, "input v is missing at row 0, t = 0 s, so the next state"),
    (read, {"options": {"jitter": 0.3}}, "jitter=0.3, .* a share of Ts from 0 to less than .25"),
    (
        read,
        {"options": {"resample": "cubic"}},
        "resample='cubic': .* resample 'nearest' or 'linear'",
    ),
    (
        read,
        {"options": {"resample": "linear"}, "t": np.arange(6) / 99},
        "over two instants at least",
    ),
    (
        read,
        {"options": {"reference": ["level"]}},
        "reference= names 'level', a symbol of the plant",
    ),
    (ob.read_record, {"source": 3, "plant": TANK}, "a record is a pandas DataFrame.*not int"),
    (
        ob.read_record,
        {"source": log(), "plant": ob.plants.cruise_control()},
        "cruise control is continuous.* give plant.discretise",
    ),
    (
        ob.read_record,
        {"source": pd.DataFrame(np.ones((3, 2)), columns=["v", "v"]), "plant": TANK},
        "column 'v' occurs 2 times; rename or drop one",
    ),
    (
        ob.read_record,
        {"source": xr.Dataset({"v": (("a", "b"), np.ones((2, 2)))}), "plant": TANK},
        "is no table of columns over time",
    ),
    (
        ob.read_record,
        {"source": FILE.with_name("three_tank_laek.csv"), "plant": TANK},
        "there is no file .*did you mean 'three_tank_leak.csv'",
    ),
]


@pytest.mark.parametrize("number", range(len(REFUSED)))
def test_what_cannot_be_read_is_refused(number):
    call, given, text = REFUSED[number]
    with pytest.raises(ob.RecordError, match=text):
        call(**given)


def test_a_plant_without_outputs_is_refused():
    plant = ob.Plant("bare")
    (x,) = plant.states("x")
    plant.dynamics([x / 2], Ts=1)
    with pytest.raises(ob.PlantError, match="no outputs yet"):
        ob.read_record(log(), plant)


@pytest.mark.parametrize(
    ("name", "text", "refusal"),
    [
        ("a.csv", "t,v,v\n0,1,2\n", "column 'v' occurs 2 times"),
        ("a.csv", "t,v,level,weight\n0,1,2,3\n1,1,2,3,4\n", "cannot be read as CSV: .*line 3"),
        (
            "a.csv",
            "0,1,2\n3,4,5\n",
            "cannot be read as CSV: the first line has to name the columns, not 0,1,2",
        ),
        ("a.csv", "", "cannot be read as CSV: the first line has to name the columns"),
        ("a.csv", "t,v,level,weight\n0,1,2,3\n.5,1,two,3\n", "column 'level', row 1: 'two' is no"),
        ("a.xlsx", "", "files of type '.xlsx' are not read; give CSV, Parquet or a DataFrame"),
    ],
)
def test_files_that_cannot_be_read_are_refused(tmp_path, name, text, refusal):
    (tmp_path / name).write_text(text)
    with pytest.raises(ob.RecordError, match=f"record '{name}': (it )?{refusal}"):
        ob.read_record(tmp_path / name, TANK)
    (tmp_path / "b.csv").write_bytes(b"t,\xff\n0,1\n")
    with pytest.raises(ob.RecordError, match=r"'b\.csv': it cannot be read as CSV"):
        ob.read_record(tmp_path / "b.csv", TANK)
