"""The search for mistakes that no test sees: what it makes, that it catches, that it tells."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TOOL = ROOT / "tools" / "mutants.py"
sys.path.insert(0, str(TOOL.parent))

from mutants import Job  # noqa: E402
from mutation import changes, pick  # noqa: E402

LISTS = {
    key: entries
    for name in ("mutants.toml", "guards.toml")
    for key, entries in tomllib.loads((TOOL.parent / name).read_text()).items()
}
SOURCE = '''
def bound(lower, upper, loss):
    """Say 1.0 + 2.0."""
    if lower > upper:
        raise ValueError(f"{lower + upper}")
    return up(0.5 * upper + raised(loss, 3 + 4)) - lower


def show(lower, upper):
    return upper - lower
'''


def made(source, leave=()):
    return {(c.kind, c.was, c.becomes) for c in changes(source, set(leave))}


def test_every_change_is_one_expression_of_a_function_that_is_not_left_aside():
    found = made(SOURCE, ["show"])
    inside = "0.5 * upper + raised(loss, 3 + 4)"
    whole = f"up({inside}) - lower"
    assert found == {
        ("refusal", "lower > upper", "False"),
        ("comparison", "lower > upper", "((lower) <= (upper))"),
        ("sign", whole, f"((up({inside})) + (lower))"),
        ("term", whole, f"(up({inside}))"),
        ("rounding", f"up({inside})", f"({inside})"),
        ("sign", inside, "((0.5 * upper) - (raised(loss, 3 + 4)))"),
        ("term", inside, "(0.5 * upper)"),
        ("rounding", "raised(loss, 3 + 4)", "(loss)"),
        ("factor", "0.5", "0.25"),
        ("swap", "lower", "upper"),
        ("swap", "upper", "lower"),
    }
    assert len(made(SOURCE)) > len(found)
    assert {kind for kind, *_ in made(SOURCE, ["show", "bound: return"])} == {
        "refusal",
        "comparison",
        "swap",
    }


CODE = """
def step(X, other, near, y):
    inner = ca.logic_and(near, ca.logic_not(y > 0.5))
    return X.where(inner, other), ca.if_else(near, y, ULPS * X.lower.numel())
"""


def test_choices_in_code_are_made_too():
    """Flags stay flags, and how many ends there are is the same for both."""
    chosen, negated = "ca.if_else(near, y, ULPS * X.lower.numel())", "ca.logic_not(y > 0.5)"
    assert made(CODE) == {
        ("choice", "X.where(inner, other)", "(X)"),
        ("choice", "X.where(inner, other)", "(other)"),
        ("choice", chosen, "(y)"),
        ("choice", chosen, "(ULPS * X.lower.numel())"),
        ("condition", f"ca.logic_and(near, {negated})", "(near)"),
        ("condition", f"ca.logic_and(near, {negated})", f"({negated})"),
        ("condition", negated, "(y > 0.5)"),
        ("comparison", "y > 0.5", "((y) <= (0.5))"),
        ("rounding", "ULPS", "(0.0 * ULPS)"),
    }


def test_a_mutant_is_known_again_in_what_a_run_printed():
    """Wherever it stands by then."""
    job = Job(("tests",), "derive/a.py", where="7 bound", says="[sign] -x -> (x)   in: return -x")
    assert job.told_in(f"2.0 s  SURVIVES derive/a.py:9 bound {job.says}")
    assert not job.told_in(f"2.0 s  SURVIVES designs/derive/a.py:7 bound {job.says}")
    assert not job.told_in(f"2.0 s  SURVIVES derive/a.py:7 bound {job.says} + y")


def test_a_change_leaves_the_rest_as_it_is():
    for change in changes(SOURCE):
        mutant = change.apply(SOURCE)
        assert mutant != SOURCE
        assert mutant.count("\n") == SOURCE.count("\n")
        compile(mutant, "mutant", "exec")


def test_which_are_made_does_not_depend_on_where_they_stand():
    moved = "\n\n# a line more\n" + SOURCE
    words = [
        [(c.kind, c.was) for c, _ in zip(pick(changes(s), seed, "file"), range(6), strict=False)]
        for s, seed in ((SOURCE, 0), (moved, 0), (SOURCE, 1))
    ]
    assert words[0] == words[1] != words[2]
    assert len({kind for kind, _ in words[0]}) == 6


def test_files_and_reasons_of_the_list_exist():
    for entry in (*LISTS["mutant"], *LISTS["guard"]):
        for name in (entry["file"], *entry["tests"]):
            assert (ROOT / name.split("::")[0]).is_file(), name
    for entry in LISTS["mutant"]:
        assert (ROOT / entry["file"]).read_text().count(entry["was"]) == 1, entry["was"]
    for entry in LISTS["equivalent"]:
        leave = next(set(g.get("leave", ())) for g in LISTS["guard"] if g["file"] == entry["file"])
        found = changes((ROOT / entry["file"]).read_text(), leave)
        assert any(change.fits(entry) for change in found), entry
        assert entry["why"]


QUICK = """
[[mutant]]
file = "derive/rigour/enclosure.py"
was = "        return Enclosure(-self.mid, self.rad)"
becomes = "        return Enclosure(self.mid, self.rad)"
tests = ["tests/derive/rigour/test_enclosure.py"]

[[mutant]]
file = "derive/rigour/enclosure.py"
was = "        return Enclosure(-self.mid, self.rad)"
becomes = "        return Enclosure(-1.0 * self.mid, self.rad)"
tests = ["tests/derive/rigour/test_definite.py"]

[[mutant]]
file = "derive/rigour/enclosure.py"
was = "_UNDERFLOW = 1e-290"
becomes = "_UNDERFLOW = 0.0"
tests = []
why = "told"
"""


def run(*arguments):
    command = [sys.executable, str(TOOL), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.long
def test_mistakes_are_planted_caught_and_told(tmp_path):
    """A flipped sign, a change of nothing, and one with a reason."""
    (tmp_path / "list.toml").write_text(QUICK)
    done = run("--list", tmp_path / "list.toml", "--workers", 1)
    assert done.returncode == 1, done.stdout + done.stderr
    lines = done.stdout.splitlines()
    assert "caught by" in lines[0] and "SURVIVES" in lines[1]
    assert "derive/rigour                      2           1           1" in lines
    assert any("changes nothing" in line and "told" in line for line in lines)
