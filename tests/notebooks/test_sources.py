"""What every notebook owes to its readers: outputs that are stored, and how staleness is seen."""

import re
from pathlib import Path

import nbformat
import pytest

import notebooks

NOTEBOOKS = sorted(notebooks.FOLDER.glob("*.ipynb"))


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: path.stem)
def path(request):
    return request.param


@pytest.fixture
def notebook(path):

    return nbformat.read(path, as_version=4)


def test_outputs_are_stored_as_one_run_from_top_to_bottom_left_them(path, notebook):

    nbformat.validate(notebook)
    cells = notebooks.code(notebook)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell.outputs]
    assert not [o for o in outputs if o.output_type == "error" or o.get("name") == "stderr"]
    assert notebook.cells[0].cell_type == "markdown"
    assert notebook.cells[0].source.startswith("# ")
    assert path.stat().st_size < 1_500_000


def test_nothing_of_the_machine_is_stored(path):
    assert not re.findall(r"/(?:tmp|home|root|work)/", path.read_text())


def test_plants_are_typed_and_only_public_names_are_used(notebook):
    source = "\n".join(cell.source for cell in notebooks.code(notebook))
    assert not re.findall(r"(?:from|import) obsynth\.|ob\.plants\.", source)


def test_nobody_has_to_read_a_double_in_full(notebook):
    lines = [line for cell in notebooks.code(notebook) for line in notebooks.shown(cell)]
    assert not [line for line in lines if re.search(r"\d{14}|\.\d{12}", line)]


def test_every_notebook_is_executed_by_a_test_that_it_is_current(path):
    test = Path(__file__).parent / f"test_{path.stem}_notebook.py"
    assert ".stale == []" in test.read_text()


def shows(outputs):
    from nbformat.v4 import new_code_cell, new_notebook, new_output

    made = [
        new_output("stream", name="stdout", text=data)
        if kind == "text"
        else new_output("display_data", {kind: data})
        for kind, data in outputs
    ]
    return new_notebook(cells=[new_code_cell("x", outputs=made)])


def said(line):
    return [("text", line)]


def table(*rows):
    cells = ("".join(f"<td>{cell}</td>" for cell in row) for row in rows)
    return [("text/html", f"<table>{''.join(f'<tr>{row}</tr>' for row in cells)}</table>")]


PICTURE = [("image/png", "iVBO")]
HEAD = ["design [s]", "f"]


@pytest.mark.parametrize(
    ("stored", "fresh", "current"),
    [
        (said("mu = 0.458611"), said("mu = 0.4586112"), True),
        (said("mu = 0.458611"), said("mu = 0.460"), False),
        (said("gap 4.3e-16"), said("gap 8.8e-16"), True),
        (said("16 vertices"), said("64 vertices"), False),
        (said("x in [-1, 1]"), said("x in [1, 1]"), False),
        (said("refused"), said("proved"), False),
        (said("a\nb"), said("a"), False),
        (PICTURE, [], False),
        (PICTURE, said("no picture"), False),
        (table(["f", "0.25"]), table(["f", "0.26"]), False),
        (table(HEAD, ["1.2", "3"]), table(HEAD, ["9", "3"]), True),
        (table(HEAD, ["1.2", "3"]), table(HEAD, ["9", "4"]), False),
        (said("the C step took 12 ns"), said("the C step took 31 ns"), True),
        (said("built by cc 12.2 with -O2"), said("built by clang 19 with -O2"), True),
        (said("built by cc 12.2 with -O2"), said("built by cc 12.2 with -O3"), False),
    ],
)
def test_only_what_says_the_same_is_current(stored, fresh, current):
    assert (notebooks.differences(shows(stored), shows(fresh)) == []) is current
