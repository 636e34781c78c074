"""The command: what it prints, its exit codes, and refusals without tracebacks."""

import functools
import json
import math
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

import obsynth
from obsynth.cli import app
from obsynth.symbolic import Table

runner = CliRunner()


def said(result):
    return " ".join(result.output.split())


def test_version():
    result = runner.invoke(app, ["--version"])
    assert result.exit_code == 0
    assert result.output == f"obsynth {obsynth.__version__}\n"


def test_help_names_the_commands():
    result = runner.invoke(app, [])
    assert "run" in result.output
    assert "check" in result.output


def test_a_new_plant_is_written_once(tmp_path):
    for k, like in enumerate(([], ["--like", "cart_pole"])):
        file = tmp_path / f"{k}.toml"
        assert runner.invoke(app, ["new", str(file), *like]).exit_code == 0
        assert obsynth.read_plant(file).check()
        again = runner.invoke(app, ["new", str(file)])
        assert again.exit_code == 1 and "is there already" in said(again)
    refused = runner.invoke(app, ["new", str(tmp_path / "x.toml"), "--like", "planar_arm"])
    assert refused.exit_code == 1 and "no plant with a text; there are battery" in said(refused)
    assert not (tmp_path / "x.toml").exists()


def test_a_mistake_in_a_file_is_pointed_at(tmp_path):
    file = tmp_path / "plant.toml"
    assert runner.invoke(app, ["new", str(file)]).exit_code == 0
    file.write_text(file.read_text().replace("sqrt(h)", "sqrt(hh)"))
    result = runner.invoke(app, ["choose", str(file)])
    assert result.exit_code == 1 and "plant.toml, line 30, column 19: " in result.output


def test_an_unknown_study_is_refused_with_the_known_ones():
    result = runner.invoke(app, ["run", "triple-tank"])
    assert result.exit_code == 1
    assert "no study 'triple-tank'; there is quadruple-tank" in said(result)


@pytest.fixture
def canned(monkeypatch):
    calls = []

    def study(folder, steps, seeds, progress):
        calls.append((folder, steps, seeds))
        progress("working", 0.5)
        table = Table("Bounds", ["entry", "value"], [["m[13]", 0.5]], marked=[0])
        return SimpleNamespace(tables=lambda: [table], coverage=study.coverage)

    study.coverage = 1.0
    monkeypatch.setattr("obsynth.evaluate.studies.quadruple_tank", study)
    return SimpleNamespace(calls=calls, study=study)


def test_run_prints_tables_and_what_it_left(canned, tmp_path):
    out = tmp_path / "result"
    result = runner.invoke(
        app, ["run", "quadruple-tank", "--out", str(out), "--steps", "40", "--seeds", "2"]
    )
    assert result.exit_code == 0
    assert canned.calls == [(out, 40, 2)]
    assert "m[13]" in result.output
    assert "holds report.html, design.json" in said(result)


def test_a_violated_interval_is_a_failure(canned, tmp_path):
    canned.study.coverage = 0.9998
    result = runner.invoke(app, ["run", "quadruple-tank", "--out", str(tmp_path / "r")])
    assert result.exit_code == 1
    assert "a guaranteed interval was violated" in said(result)


def test_a_folder_in_use_is_refused_before_the_work(canned, tmp_path):
    (tmp_path / "mine.txt").write_text("")
    result = runner.invoke(app, ["run", "quadruple-tank", "--out", str(tmp_path)])
    assert result.exit_code == 1
    assert "did not write (mine.txt)" in said(result)
    assert canned.calls == []
    assert "Traceback" not in result.output


def test_steps_below_one_are_refused_by_the_parser():
    result = runner.invoke(app, ["run", "quadruple-tank", "--steps", "0"])
    assert result.exit_code == 2


def test_check_proves_a_design_from_its_file(given_peak, tmp_path):
    path = tmp_path / "design.json"
    given_peak.save(path)
    result = runner.invoke(app, ["check", str(path)])
    assert result.exit_code == 0
    text = said(result)
    assert "every claim proved again" in text
    assert "Guaranteed:" in text
    assert "[monitored in part: status bit 8]" in text


def test_check_refuses_a_bound_a_tenth_of_a_per_cent_too_small(given_peak, tmp_path):
    path = tmp_path / "design.json"
    given_peak.save(path)
    record = json.loads(path.read_text())
    record["bound"]["b"][0] *= 0.999
    path.write_text(json.dumps(record))
    result = runner.invoke(app, ["check", str(path)])
    assert result.exit_code == 1
    assert "n + G b <= b" in said(result)
    assert "every claim proved again" not in said(result)


def test_check_refuses_what_is_no_design(tmp_path):
    missing = runner.invoke(app, ["check", str(tmp_path / "no.json")])
    assert missing.exit_code == 1
    assert "there is no file" in said(missing)
    (tmp_path / "text.json").write_text("{not json")
    broken = runner.invoke(app, ["check", str(tmp_path / "text.json")])
    assert broken.exit_code == 1
    assert "is not JSON" in said(broken)


def test_the_command_line_itself_loads_quickly_and_without_heavy_libraries():
    code = (
        "import sys, obsynth.cli\n"
        "print(sorted({'casadi', 'sympy', 'numpy', 'matplotlib', 'cvxpy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.long
def test_the_whole_command_from_outside(tmp_path):
    """FS1 and FS2, three seeds, both bounds: everything inside, everything left, in a minute."""
    out = tmp_path / "tank"
    environment = {**os.environ, "COLUMNS": "140"}
    command = [sys.executable, "-m", "obsynth", "run", "quadruple-tank", "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    text = done.stdout
    assert text.count("100 %") == 4 * 6
    assert "0.00903" in text
    assert "too narrow" in text
    rows = {line.split()[0]: line.split() for line in text.splitlines() if line.strip()}
    assert abs(float(rows["ellipsoid"][-2]) - 21.80) < 0.01
    assert float(rows["peak"][-1]) < 0.14
    assert (out / "report.html").stat().st_size > 100_000
    for name in ("design.json", "design_ellipsoid.json"):
        proof = subprocess.run(
            [sys.executable, "-m", "obsynth", "check", str(out / name)],
            capture_output=True,
            text=True,
            check=False,
        )
        assert proof.returncode == 0, proof.stderr


@pytest.fixture
def chosen(monkeypatch):
    """`obsynth.choose` with a table of its own; what it was given."""
    given = []

    def choose(plant, **options):
        given.append((plant, options))
        table = Table("Observers", ["observer"], [["interval"]])
        shares = {"interval": {"run": {"x": 0.5}, "guaranteed": {"x": math.inf}}}
        return SimpleNamespace(
            table=table,
            widths=table,
            shares=shares,
            recommended=choose.best,
            reason="none fits",
        )

    choose.best = object()
    monkeypatch.setattr(obsynth, "choose", choose)
    return SimpleNamespace(given=given, choose=choose)


def test_choose_takes_a_name_the_file_of_a_plant_or_of_a_design(chosen, tmp_path):
    result = runner.invoke(app, ["choose", "battery", "--ts", "1", "--budget", "900"])
    assert result.exit_code == 0 and "interval" in result.output
    plant = obsynth.plants.leaking_tanks()
    for name, data in (("plant", plant.to_dict()), ("design", {"plant": plant.to_dict()})):
        (tmp_path / name).write_text(json.dumps(data))
        assert runner.invoke(app, ["choose", str(tmp_path / name)]).exit_code == 0
    (battery, options), (first, _), (second, _) = chosen.given
    assert battery.name == "battery 1RC" and first.to_dict() == second.to_dict() == plant.to_dict()
    assert options == {"budget": 900, "criterion": "faults", "Ts": 1.0, "limit": 60.0}


def test_choose_without_a_recommendation_is_a_failure_that_shows_the_table(chosen):
    chosen.choose.best = None
    result = runner.invoke(app, ["choose", "battery"])
    assert result.exit_code == 1
    assert "interval" in result.output and "obsynth: none fits" in said(result)
    result = runner.invoke(app, ["choose", "battery", "--json"])
    shares = json.loads(result.stdout)["half_widths"]
    assert shares == {"interval": {"run": {"x": 0.5}, "guaranteed": {"x": None}}}


@pytest.mark.parametrize(
    ("text", "refusal"),
    [
        (None, "there is no plant and no file"),
        ("no json", "is no JSON file"),
        ("[1]", "a table with 'format' is needed"),
        ("{}", "format"),
    ],
)
def test_choose_refuses_what_is_no_plant(chosen, tmp_path, text, refusal):
    path = tmp_path / "plant.json"
    if text is not None:
        path.write_text(text)
    result = runner.invoke(app, ["choose", str(path)])
    assert result.exit_code == 1 and refusal in said(result) and "Traceback" not in result.output
    assert "planar_arm is made in Python" in said(runner.invoke(app, ["choose", "planar_arm"]))


def test_choose_refuses_a_continuous_plant_without_a_sample_time():
    result = runner.invoke(app, ["choose", "battery"])
    assert result.exit_code == 1 and "battery 1RC is a continuous plant: give Ts=" in said(result)


RAW = Path(obsynth.symbolic.records.three_tank_leak.__code__.co_filename).with_suffix(".csv")


@pytest.fixture(scope="module")
def leaking(tmp_path_factory):
    path = tmp_path_factory.mktemp("design") / "design.json"
    obsynth.IntervalObserver().design(obsynth.plants.leaking_tanks()).save(path)
    return path, obsynth.load(path)


@pytest.fixture
def design(leaking, monkeypatch):
    """A saved design, whose proof is not waited for again."""
    monkeypatch.setattr(obsynth, "load", {leaking[0]: leaking[1]}.__getitem__)
    return leaking[0]


def test_export_writes_a_unit_or_a_project(design, monkeypatch):
    """Mutants: one writer for both; options not handed on."""
    calls = []
    for name in ("generate_fmu", "generate_c"):
        note = functools.partial(
            lambda name, _, *args, **options: calls.append((name, args, options)), name
        )
        monkeypatch.setattr(obsynth, name, note)
    for args in (["x.fmu", "--name", "x", "--overwrite"], ["x", "--backend", "casadi"]):
        assert runner.invoke(app, ["export", str(design), *args]).exit_code == 0
    assert calls == [
        ("generate_fmu", (Path("x.fmu"), "x"), {"backend": "tape", "overwrite": True}),
        ("generate_c", (Path("x"), None), {"backend": "casadi", "overwrite": False}),
    ]


def channels(**changed):
    """The options that make the file's columns the signals of the plant."""
    scale = f"{1 / 0.57!r},{-0.43 / 0.57!r}"
    at = {"u1": f"u1,{scale}", "u3": f"u3,{scale}"}
    at |= {
        f"y{i}": f"y{i},1,-{rest}"
        for i, rest in zip((1, 2, 3), (".160824", ".103167", ".156445"), strict=True)
    }
    return [part for name, told in (at | changed).items() for part in ("--map", f"{name}={told}")]


def test_estimate_tells_what_estimate_tells(design, tmp_path, monkeypatch):
    """Mutants: the offset left out; the end of the record kept."""
    files = tmp_path / "told.csv", tmp_path / "page.html"
    drawn = []
    monkeypatch.setattr(obsynth.Estimate, "report", lambda told, path: drawn.append(path))
    rest = [
        "--from",
        "36",
        "--to",
        "200",
        "--guess",
        ".06,.2,.12",
    ]
    rest += ["--out", str(files[0]), "--report", str(files[1]), "--window", "5"]
    args = ["estimate", str(design), str(RAW), *channels(), *rest]
    result = runner.invoke(app, [*args, "--json"])
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    record = obsynth.records.three_tank_leak()[: 200 - 36]
    same = obsynth.estimate(obsynth.load(design), record, guess=[0.06, 0.2, 0.12])
    assert told["instants"] == 164 and told["alarms"]["leak"] == same.alarms()["leak"].tolist()
    assert told["widths"]["leak"]["median"] == pytest.approx(same.widths()["leak"]["median"])
    assert told["refuted"] is None and told["consistent"] == 1.0
    means = told["widths"]["mean of leak over 5"]
    assert 2 * means["median"] < told["widths"]["leak"]["median"] and means["finite"] > 0.9
    assert len(files[0].read_text().splitlines()) == 165 and drawn == [files[1]]
    shown = runner.invoke(app, args)
    assert shown.exit_code == 0 and "median half width" in shown.output


def test_estimate_ends_with_3_where_the_record_refutes_the_assumptions(design):
    """Mutant: 1, which is bad input."""
    args = ["estimate", str(design), str(RAW), *channels(y2="y2,1,0.5"), "--from", "36", "--json"]
    result = runner.invoke(app, args)
    assert result.exit_code == 3 and json.loads(result.stdout)["refuted"]["instant"] == 0
    assert "obsynth: the record refutes the assumptions at k = 0" in said(result)


@pytest.mark.parametrize(
    ("args", "refusal"),
    [
        (["--map", "y1"], "--map 'y1' is not SIGNAL=COLUMN"),
        (["--map", "y1=y1,one"], "could not convert string to float: 'one'"),
        (["--map", "y9=y1"], "names 'y9'"),
        (["--guess", "1"], "guess has to be 3 finite numbers"),
        (["--out", "told.txt"], "neither with .parquet nor .csv"),
        (["--from", "216"], "two instants at least"),
    ],
)
def test_estimate_refuses_bad_input(design, args, refusal):
    result = runner.invoke(app, ["estimate", str(design), str(RAW), *args])
    assert result.exit_code == 1 and refusal in said(result) and "Traceback" not in result.output
