"""Notebooks, run from top to bottom with questions asked in their kernel afterwards."""

import json
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "notebooks"


class Executed:
    """A notebook with its outputs, and what the question printed as JSON."""

    def __init__(self, notebook):
        self.cells = notebook.cells
        (output,) = [o for o in notebook.cells[-1].outputs if o.output_type == "stream"]
        self.answers = json.loads(output.text)

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
    from nbclient import NotebookClient

    def run(name, question):
        notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
        probe = f"import json\n\nprint(json.dumps({question.strip()}))"
        notebook.cells.append(nbformat.v4.new_code_cell(probe))
        folder = tmp_path_factory.mktemp(name)
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("OMP_NUM_THREADS", "1")
            patch.setenv("TMPDIR", str(folder))
            resources = {"metadata": {"path": folder}}
            NotebookClient(
                notebook, timeout=600, kernel_name="python3", resources=resources
            ).execute()
        return Executed(notebook)

    return run
