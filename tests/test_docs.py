"""The documentation: examples run, and the site is built without a warning."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ELSEWHERE = ("docs/fmu.md",)
"""With its shell commands in tests/codegen/test_codegen_fmu.py."""
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
    """Build the site once; warnings are errors."""
    pytest.importorskip("mkdocs")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(folder)]
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
    """Mutants: a link to a page that is not there (the fixture); ``font: false`` left out; a
    formula with a command that the converter does not know, which it would show as it stands."""
    pages = {page: page.read_text() for page in site.rglob("*.html")}
    assert len(pages) > 20
    for page, text in pages.items():
        assert not HOST.search(text), page
        unknown = [
            part
            for formula in re.findall(r"<math.*?</math>", text, re.DOTALL)
            for part in re.findall(r">([^<]*\\[^<]*)<", formula)
            if re.search(r"\\[A-Za-z]", part)
        ]
        assert not unknown, (page, unknown)
        assert "arithmatex" not in text, page
