"""Notebooks, run from top to bottom with questions asked in their kernel afterwards."""

import copy
import json
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "notebooks"
sys.path.insert(0, str(ROOT / "tools"))


class Executed:
    """A notebook with its outputs, and what the question printed as JSON."""

    def __init__(self, stored, notebook):
        from notebooks import differences

        probe = notebook.cells.pop()
        (output,) = [o for o in probe.outputs if o.output_type == "stream"]
        self.answers = json.loads(output.text)
        self.cells = notebook.cells
        self.stale = differences(stored, notebook)

    @property
    def pictures(self):
        """Pictures of every cell that shows some."""
        counts = [
            sum("image/png" in output.get("data", {}) for output in cell.get("outputs", ()))
            for cell in self.cells
        ]
        return [count for count in counts if count]

    @property
    def page(self):
        """All outputs as text."""
        return json.dumps([cell.get("outputs", []) for cell in self.cells], ensure_ascii=False)


@pytest.fixture(scope="session")
def execute(tmp_path_factory):
    """Return a function of a notebook's name and of an expression to be evaluated at its end."""

    # Half of what collecting all tests takes, if it stood above.
    import nbformat

    from notebooks import execute

    def run(name, question):
        stored = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
        notebook = copy.deepcopy(stored)
        probe = f"import json\n\nprint(json.dumps({question.strip()}))"
        notebook.cells.append(nbformat.v4.new_code_cell(probe))
        execute(notebook, tmp_path_factory.mktemp(name))
        return Executed(stored, notebook)

    return run
