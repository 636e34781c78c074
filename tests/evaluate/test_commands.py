"""All commands by one table: their help, the example in it, JSON, and every exit code."""

import json
import math
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import obsynth as ob
from obsynth.cli import ORDER, app
from obsynth.commands.told import EXAMPLES, Told, command
from obsynth.evaluate.progress import bar
from obsynth.symbolic import Table
from obsynth.symbolic.shown import plain

runner = CliRunner()
# So that each finds the files that those before it left; test_command has `run`.
WORKFLOW = (
    *("new", "plants", "analyse", "design", "simulate", "campaign", "check", "export"),
    *("report", "estimate", "bounds", "choose", "papers"),
)


def said(result):
    return " ".join(result.output.split())


def strict(text):
    """JSON without NaN and Infinity, which `json` reads although they are none."""

    def refuse(token):
        raise AssertionError(token)

    return json.loads(text, parse_constant=refuse)


def write_log(folder):
    """A record of the tank of `obsynth new`, the level in millimetres."""
    study = ob.read_study(folder / "tank.toml")
    plant = study.plant
    k = np.arange(30)
    level, rng = [30.0], np.random.default_rng(0)
    for _ in k[:-1]:
        level.append(
            float(plant.function()(level[-1], 5, [], 0, np.zeros(len(plant.w)), [], [])[0])
        )
    y = 10 * (np.array(level) + rng.uniform(-0.09, 0.09, len(k)))
    rows = np.column_stack([k, y, np.full(len(k), 5.0)])
    np.savetxt(folder / "log.csv", rows, delimiter=",", header="t,level,v", comments="")


def test_every_command_is_listed_once():
    assert sorted(EXAMPLES) == sorted(ORDER) == sorted([*WORKFLOW, "run"])
    assert [c.name for c in app.registered_commands] == list(ORDER)


@pytest.mark.parametrize("name", ORDER)
def test_help_shows_the_example_and_the_exit_codes(name):
    text = said(runner.invoke(app, [name, "--help"], env={"COLUMNS": "120"}))
    assert f"$ obsynth {name} {EXAMPLES[name]}".strip() in text
    assert "--json" in text and "3 the data refute the assumptions" in text


def test_the_page_of_the_commands_has_all_of_them_in_order():
    page = (Path(__file__).parents[2] / "docs" / "commands.md").read_text()
    rows = re.findall(r"^\| `obsynth ([^`]+)` \|", page, re.MULTILINE)
    assert rows == [f"{name} {EXAMPLES[name]}".strip() for name in ORDER]


@pytest.mark.long
def test_the_examples_run_in_this_order_and_tell_json(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in WORKFLOW:
        if name == "estimate":
            write_log(tmp_path)
        found = runner.invoke(app, [name, *shlex.split(EXAMPLES[name]), "--json"])
        assert found.exit_code == 0 and strict(found.stdout), (name, found.output)


def test_json_has_no_token_that_is_none():
    """Mutant: numbers as they are."""
    table = Table("T", ["a", "b"], [[np.float64(math.nan), math.inf], [np.int64(3), True]])
    given = {"table": table, "widths": np.array([1.0, -math.inf]), "names": ("x", None)}
    assert plain(given) == {
        "table": {"title": "T", "rows": [{"a": None, "b": None}, {"a": 3, "b": True}]},
        "widths": [1.0, None],
        "names": ["x", None],
    }
    assert strict(json.dumps(plain(given))) == plain(given)


@pytest.mark.parametrize(
    ("args", "code", "message"),
    [
        (["new", "tank.toml"], 0, "edit it, then: obsynth analyse tank.toml"),
        (["check", "none.json"], 1, "there is no file 'none.json'"),
        (["check", "given.toml"], 1, "obsynth design given.toml --out design.json"),
        (["simulate", "given.json"], 1, "is no study; a study is a text file"),
        (["design", "none.toml"], 1, "No such file or directory: none.toml"),
        (["report", "given.toml"], 1, "given.toml, line 1, column 1: "),
        (["papers", "kalman"], 1, "there are bounded-error, hinf, qpv, interval, set-adaptive"),
        (["analyse", "lorentz"], 1, "there is no plant and no file 'lorentz'"),
        (["simulate", "given.toml", "--seeds", "0"], 2, "Invalid value for '--seeds'"),
        (["campaign"], 2, "Missing argument 'STUDY'"),
        (["desing"], 2, "No such command 'desing'"),
    ],
)
def test_exit_codes_mean_something(args, code, message, tmp_path, monkeypatch):
    """3 is that of `estimate` and `bounds`, see test_command and test_bounds_command."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "given.toml").write_text("")
    (tmp_path / "given.json").write_text("{}")
    result = runner.invoke(app, args)
    assert (result.exit_code, "Traceback" in result.output) == (code, False)
    plain_text = re.sub(r"[│╭╮╰╯─]", " ", result.output)
    assert message.lower() in " ".join(plain_text.split()).lower()


@pytest.mark.parametrize(
    ("told", "code"),
    [
        (Told([1], ("fine",)), 0),
        (Told([1], ("bad",), failed="it fails."), 1),
        (Told([1], ("bad",), failed="it fails.", refuted="refuted."), 3),
    ],
)
def test_what_is_told_sets_the_exit_code_with_and_without_json(told, code):
    import typer

    own = typer.Typer()
    command(own, "try", "")(lambda: told)
    EXAMPLES.pop("try")
    for args in ([], ["--json"]):
        result = runner.invoke(own, args)
        assert result.exit_code == code
        assert result.stdout.strip() == ("[\n 1\n]" if args else told.shown[0])
        assert (f"obsynth: {told.refuted or told.failed}" in result.stderr) == bool(code)


def test_plants_says_which_methods_take_them():
    told = {
        plant["name"]: plant for plant in strict(runner.invoke(app, ["plants", "--json"]).stdout)
    }
    assert told["quadruple_tank"]["faults"] == ["f1", "f2"]
    assert "HinfUIO" in told["hinf_example"]["methods"]
    assert "BoundedErrorUIO" not in told["interval_example"]["methods"]
    assert "FilterBank" not in told["quadruple_tank"]["methods"]


@pytest.mark.parametrize(
    ("paper", "wrong"),
    [
        ("hinf", {"(52)": 1, "(53)": 1, "(45)": 0, "(14)": 1}),
        pytest.param("bounded-error", {"(51)": 1, "(18)": 1, "(49)": 1}, marks=pytest.mark.long),
        pytest.param("qpv", {"(19)": 1, "(47)": 1, "Fig": 2}, marks=pytest.mark.long),
        pytest.param("interval", {"(32)": 1, "Theorem 1": 1}, marks=pytest.mark.long),
        pytest.param("set-adaptive", {"(17)": 1, "(8)": 1, "gain": 1}, marks=pytest.mark.long),
    ],
)
def test_papers_computes_what_the_errata_say(paper, wrong):
    """How many claims of each place do not hold, as docs/methods has them."""
    (told,) = strict(runner.invoke(app, ["papers", paper, "--json"]).stdout)
    for place, count in wrong.items():
        found = [c for c in told["claims"] if c["place"].startswith(place)]
        assert found and sum(not c["holds"] for c in found) == count, place
    if paper == "hinf":
        assert "0.49888" in str(told) and "1.0562" in str(told) and "2.1042" in str(told)


def test_a_terminal_is_told_the_stage_and_the_time_left(monkeypatch, capsys):
    """Others are told nothing. Mutant: a stage that is not shown."""
    for terminal in ("1", ""):
        monkeypatch.setenv("FORCE_COLOR", terminal)
        with bar() as say:
            say("designing", 0.5)
        told = capsys.readouterr().err
        assert ("designing" in told and "left" in told) if terminal else not told
