"""The command ``obsynth bounds``: what `least_bounds` says, in the words of a shell."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import obsynth as ob
from obsynth.cli import app


@pytest.fixture(scope="module")
def leak(tmp_path_factory):
    """The leak record, with the channels of the plant, in a file."""
    path = tmp_path_factory.mktemp("leak") / "leak.csv"
    record = ob.records.three_tank_leak()[:60]
    channels = [*record.names["u"], *record.names["y"]]
    table = np.column_stack([record.time, *(record[name] for name in channels)])
    np.savetxt(path, table, delimiter=",", header=",".join(["t", *channels]), comments="")
    return path


def said(*args):
    found = CliRunner().invoke(app, ["bounds", *map(str, args)])
    assert found.exception is None or isinstance(found.exception, SystemExit), found.exception
    return found


def test_what_least_bounds_says(leak, tmp_path):
    """The declared bounds are refuted by these instants: exit 3, and the numbers all the same."""
    plant = tmp_path / "plant.json"
    plant.write_text(json.dumps(ob.plants.leaking_tanks().to_dict()))
    found = said(plant, leak, "--json", "--free", "leak", "--to", "8")
    told = json.loads(found.stdout)
    fit = ob.least_bounds(
        ob.plants.leaking_tanks(),
        ob.read_record(leak, ob.plants.leaking_tanks())[:8],
        ["leak"],
    )
    assert told == json.loads(json.dumps(fit.to_dict())) and told["instants"] == 8
    assert found.exit_code == (3 if fit.refuted else 0)
    assert told["lower"] <= told["upper"] and told["declared"]["outputs"] == 0.006


def test_declared_bounds_that_are_refuted(leak, tmp_path):
    plant = tmp_path / "plant.json"
    plant.write_text(json.dumps(ob.plants.leaking_tanks(wx=1e-3, wy=1e-3).to_dict()))
    found = said(plant, leak, "--to", "20")
    assert found.exit_code == 3 and "refutes the declared bounds" in found.stderr
    assert "sum, certified" in found.stdout


@pytest.mark.parametrize(
    ("args", "refusal"),
    [
        (["--free", "a1=.005"], "is not PARAMETER=LOWER:UPPER"),
        (["--free", "a1=x:1"], "could not convert"),
        (["--free", "a1"], "give the range"),
        (["--free", "g"], "'g'"),
        (["--map", "y1"], "is not SIGNAL=COLUMN"),
        (["--map", "y1=level"], "level"),
    ],
)
def test_bad_input_is_refused(leak, args, refusal):
    found = said("leaking_tanks", leak, *args)
    assert found.exit_code == 1 and refusal in found.stderr
