"""Studies as text: the observer, the scenario and the record that a file names."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import obsynth as ob
from obsynth.cli import app

NEW = (Path(ob.plants.__file__).parents[1] / "new_plant.toml").read_text()
TANK = NEW.replace('"taylor"', '"euler"')
DESIGN = '[design]\nmethod = "BoundedErrorUIO"\nbounds = "peak"'


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    file = tmp_path_factory.mktemp("study") / "tank.toml"
    file.write_text(TANK)
    return ob.read_study(file)


def changed(tmp_path, what, into):
    assert what in TANK
    file = tmp_path / "tank.toml"
    file.write_text(TANK.replace(what, into))
    return ob.read_study(file)


def test_the_observer_is_that_of_python(study):
    plant = study.plant
    same = ob.BoundedErrorUIO(bounds="peak").design(plant)
    assert np.array_equal(study.observer.half_widths, same.half_widths)


def test_signals_are_functions_of_the_time(study):
    """t in samples, or a fault at the place of an input, differs."""
    arrays = study.scenario.arrays(study.observer.model)
    t = np.arange(601)
    assert np.allclose(arrays["u"][:, 0], 5 + np.sin(t / 20), atol=1e-15)
    assert np.allclose(arrays["f"][:, 0], np.clip((t - 200) / 100, 0, 0.5), atol=1e-15)
    assert study.scenario.x0.tolist() == [30] and study.scenario.guess.tolist() == [25]
    run = ob.simulate(study.observer.model, study.observer, study.scenario, seed=study.seed)
    assert min(run.coverage.values()) == 1.0


def test_time_is_in_seconds(tmp_path):
    told = changed(tmp_path, "Ts = 1", 'Ts = "1/4"')
    arrays = told.scenario.arrays(told.observer.model)
    assert np.allclose(arrays["u"][:, 0], 5 + np.sin(np.arange(601) / 80), atol=1e-15)


def test_inputs_may_follow_what_is_measured(tmp_path):
    told = changed(tmp_path, '"5 + sin(t/20)"', '"5 + t/1000 - 3*(y - 30)/100"')
    fed = told.scenario
    assert fed.feedback
    assert fed.inputs(200, np.array([33.0])) == pytest.approx([5 + 0.2 - 0.09], abs=1e-12)
    run = ob.simulate(told.model, told.observer, fed, seed=told.seed)
    assert run.kept and min(run.coverage.values()) == 1.0
    k = np.arange(len(run.u))
    assert run.u[:, 0] == pytest.approx(5 + k / 1000 - 0.03 * (run.y[:, 0] - 30), abs=1e-9)


def test_without_a_scenario_waves(tmp_path):
    told = changed(tmp_path, TANK[TANK.index("[scenario]") :], "")
    assert told.scenario.name == "gentle 0" and told.record is None and told.seed == 0


def test_a_record_beside_the_file(tmp_path):
    given = "[record]\nfile = 'log.csv'\nmap = { y = ['level', 0.1], v = 'pump' }\nto = 3"
    told = changed(tmp_path, "# [record]", given)
    with pytest.raises(ob.PlantError, match=r"line 60.*there is no file 'log.csv' beside tank"):
        told.record  # noqa: B018
    (tmp_path / "log.csv").write_text("t,level,pump\n0,250,5\n1,251,5\n2,252,5\n3,253,5\n")
    assert np.allclose(told.record.to_frame()["y"], [25.0, 25.1, 25.2], atol=1e-12)


@pytest.mark.parametrize(
    ("what", "into", "message"),
    [
        ('"BoundedErrorUIO"', '"Bounded"', "line 48.*'Bounded' is no method; there are Bounded"),
        ('bounds = "peak"', 'bound = "peak"', "line 49.*bound has no meaning.*did you mean bounds"),
        ('bounds = "peak"', 'bounds = "peaks"', "line 47.*bounds"),
        ("steps = 600", "steps = 0.5", "line 53.*steps is a whole number"),
        ("{ h = 30 }", "{ hh = 30 }", "line 54, column 8: hh has no meaning.*did you mean h"),
        ("sin(t/20)", "sin(k/20)", "line 55, column 25: the symbol k is not declared"),
        ("faults = {", "fault = {", "line 56.*fault has no meaning.*did you mean faults"),
        ("{ f = ", "{ g = ", "line 56.*g has no meaning in faults"),
    ],
)
def test_mistakes_are_told_by_line(tmp_path, what, into, message):
    with pytest.raises(ob.PlantError, match=message):
        changed(tmp_path, what, into).scenario  # noqa: B018


@pytest.mark.long
def test_commands(tmp_path):
    file, out, page = (tmp_path / name for name in ("tank.toml", "tank.json", "tank.html"))
    runner = CliRunner()
    assert runner.invoke(app, ["new", str(file)]).exit_code == 0
    analysed = runner.invoke(app, ["analyse", str(file), "--json"])
    assert analysed.exit_code == 0 and '"general class"' in analysed.output
    designed = runner.invoke(app, ["design", str(file), "--out", str(out)])
    assert designed.exit_code == 0 and "Guaranteed:" in designed.output
    assert ob.load(out).model.name == "tank"
    ran = runner.invoke(app, ["simulate", str(file), "--report", str(page)])
    assert ran.exit_code == 0 and "100 %" in ran.output and page.stat().st_size > 10_000
    jump = file.read_text().replace("Min(1/2, (t - 200)/100)", "1")
    file.write_text(jump)
    ran = runner.invoke(app, ["simulate", str(file)])
    assert ran.exit_code == 1 and "left what the guarantee assumes: f moves by 1" in ran.output
    many = runner.invoke(app, ["campaign", str(file), "--seeds", "2"])
    assert many.exit_code == 0 and "n/a" in many.output  # no run kept what is assumed
    assert runner.invoke(app, ["design", str(tmp_path / "none.toml")]).exit_code == 1
