"""The documentation: examples run, and the site is built without a warning."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import obsynth as ob

ROOT = Path(__file__).parents[1]
ELSEWHERE = ("docs/fmu.md",)
"""With its shell commands in tests/codegen/test_codegen_fmu.py."""
SEARCHED = {
    "Kalman": "topics/kalman.html",
    "CSV": "topics/csv.html",
    "Simulink": "topics/simulink.html",
    "FMU": "fmu.html",
    "infeasible": "topics/infeasible.html",
    "sensor fault": "topics/sensor_fault.html",
    "units": "topics/units.html",
    "real time": "topics/real_time.html",
    "MISRA": "topics/misra.html",
    "Monte Carlo": "topics/monte_carlo.html",
}
FENCE = re.compile(r"((?:<!--[^\n]*-->\n)?)```python\n(.*?)```", re.DOTALL)
HOST = re.compile(
    r"""(?:<(?:script|img|iframe|source)[^>]*\ssrc=|<link[^>]*\shref=|url\()["']?(?:https?:)?//"""
)


def examples() -> dict[str, str]:
    """Return the examples of every page as one program, at the lines where they stand.

    A block that is not to run stands below a comment ``<!-- not run: why -->``.
    """
    found = {}
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        text, program = path.read_text(), ""
        for block in FENCE.finditer(text):
            if not block[1].startswith("<!-- not run: "):
                lines = text.count("\n", 0, block.start(2)) - program.count("\n")
                program += "\n" * lines + block[2]
        page = path.relative_to(ROOT).as_posix()
        if program and page not in ELSEWHERE:
            found[page] = program
    return found


def shares() -> list[object]:
    """Pages whose examples build C take seconds, and run with the long tests."""
    return [
        pytest.param(page, marks=[pytest.mark.long] if "generate_" in program else [])
        for page, program in examples().items()
    ]


@pytest.mark.parametrize("page", shares())
def test_examples_of_a_page_run(page, tmp_path, monkeypatch):
    """In one namespace, in an empty folder. Mutant: a name misspelt in an example."""
    monkeypatch.chdir(tmp_path)
    exec(compile(examples()[page], ROOT / page, "exec"), {"__name__": "__main__"})


@pytest.fixture(scope="session")
def site(tmp_path_factory):
    """Build the site once; warnings are errors, which ``--quiet`` would hide from ``--strict``."""
    pytest.importorskip("mkdocs")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(folder)]
    told = subprocess.run(
        command,
        cwd=ROOT,
        capture_output=True,
        text=True,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
    )
    assert told.returncode == 0, told.stdout + told.stderr
    return folder


@pytest.mark.long
def test_the_site_needs_no_other_host_and_every_formula_is_known(site):
    """Mutants: a link to a page or heading that is not there (the fixture); ``font: false`` left
    out; a formula left with ``{aligned}``, which the converter does not know and shows."""
    pages = {page: page.read_text() for page in site.rglob("*.html")}
    assert len(pages) > 20
    for page, text in pages.items():
        assert not HOST.search(text), page
        unknown = [
            part
            for formula in re.findall(r"<math.*?</math>", text, re.DOTALL)
            for part in re.findall(r">([^<]*)<", formula)
            if re.search(r"\\|^&(amp;)?$", part)
        ]
        assert not unknown, (page, unknown)
        assert "arithmatex" not in text, page


def test_the_api_page_has_every_public_name():
    """Mutant: a name left out of docs/api.md."""
    told = re.findall(r"^::: (\S+)$", (ROOT / "docs" / "api.md").read_text(), re.MULTILINE)
    assert sorted(name.rpartition(".")[2] for name in told) == sorted(ob.__all__)


@pytest.mark.long
@pytest.mark.skipif(shutil.which("node") is None, reason="runs the site's search in node")
def test_what_one_searches_for_from_another_tool_is_the_first_hit(site):
    """The worker of the built site ranks. Mutant: "Units for co-simulation" as title of the
    page on FMUs, which is the second for both words."""
    command = ["node", str(ROOT / "tests" / "search.js"), str(site), *SEARCHED]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    assert dict(zip(SEARCHED, told, strict=True)) == SEARCHED
    for page in SEARCHED.values():
        source = "docs/" + page.replace(".html", ".md")
        assert source in examples() or source in ELSEWHERE
