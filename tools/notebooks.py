"""Execute notebooks and store their outputs, so that a reader of the repository sees them.

python tools/notebooks.py            all, one after the other
python tools/notebooks.py tour qpv   some
python tools/notebooks.py --check    say what is not current, store nothing

What says the same as the stored outputs, but for numbers in their last digits and for times, is
left as it is: a run that changes nothing changes no file.
"""

import argparse
import base64
import io
import math
import os
import re
import sys
import tempfile
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
COLOURS = 256
"""Of a stored picture, chosen so that thin lines keep theirs: a quarter of the bytes is left."""
RTOL, ATOL = 1e-3, 1e-9
# Columns of tables that tell times, and what depends on the machine in a line.
TIMES = {"design [s]"}
MACHINE = [(re.compile(r"built by .* with"), "built with"), (re.compile(r"^.*\btook\b.*$"), "took")]
NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[-+]?\d+)?")
SECONDS = 900


def execute(notebook: Any, folder: Path) -> None:
    """Run a notebook in a folder, in a kernel of its own, and tidy its outputs."""
    from nbclient import NotebookClient

    metadata = dict(notebook.metadata)
    before = {name: os.environ.get(name) for name in ("OMP_NUM_THREADS", "TMPDIR")}
    os.environ.update(OMP_NUM_THREADS="1", TMPDIR=str(folder))
    try:
        NotebookClient(
            notebook,
            timeout=SECONDS,
            kernel_name="python3",
            resources={"metadata": {"path": str(folder)}},
            record_timing=False,
            extra_arguments=["--IPKernelApp.log_level=ERROR"],
        ).execute()
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
    notebook.metadata.clear()
    notebook.metadata.update(metadata)
    for cell in code(notebook):
        told: list[Any] = []
        for output in cell.outputs:
            _tidy(output, folder)
            # A kernel sends what a cell prints in one piece or in several.
            if told and output.get("name") == told[-1].get("name", ""):
                told[-1].text += output.text
            else:
                told.append(output)
        cell.outputs = told


def code(notebook: Any) -> list[Any]:
    """Return the cells with code."""
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def _tidy(output: Any, folder: Path) -> None:
    """Keep the richest form of an output, with small pictures and without names of this machine."""
    made = re.compile(re.escape(str(folder)) + r"(?:/tmp\w+)?")
    if output.output_type == "stream":
        output.text = made.sub("…", output.text)
        return
    data = output.get("data", {})
    for kind in ("image/png", "text/html", "text/plain"):
        if kind in data:
            kept = data[kind]
            output.data = {kind: _small(kept) if kind == "image/png" else made.sub("…", kept)}
            return


def _small(picture: str) -> str:
    from PIL import Image

    image = Image.open(io.BytesIO(base64.b64decode(picture))).convert("RGBA")
    white = Image.new("RGBA", image.size, "white")
    flat = Image.alpha_composite(white, image).convert("RGB")
    target = io.BytesIO()
    few = flat.quantize(COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(target, "PNG", optimize=True)
    return base64.b64encode(target.getvalue()).decode()


def differences(stored: Any, fresh: Any) -> list[str]:
    """Say in which cells two notebooks of the same sources show something else."""
    found = []
    for k, (old, new) in enumerate(zip(code(stored), code(fresh), strict=True), 1):
        before, after = list(shown(old)), list(shown(new))
        if len(before) != len(after):
            found.append(f"cell {k}: {len(before)} lines are stored, {len(after)} shown")
        found += [
            f"cell {k}: {a!r} is stored, {b!r} shown"
            for a, b in zip(before, after, strict=False)
            if not same(a, b)
        ][:3]
    return found


def shown(cell: Any) -> Iterator[str]:
    """Yield the lines of a cell's outputs: text, rows of tables, a word for every picture."""
    for output in cell.get("outputs", ()):
        data = output.get("data", {})
        if "image/png" in data:
            yield "picture"
            continue
        if "text/html" in data:
            text = _Text()
            text.feed(data["text/html"])
            lines = text.lines()
        else:
            told = data.get("text/plain") or output.get("text") or output.get("evalue", "")
            lines = told.splitlines()
        for line in lines:
            for pattern, word in MACHINE:
                line = pattern.sub(word, line)
            if line.strip():
                yield line.rstrip()


def same(a: str, b: str) -> bool:
    """Tell whether two lines are equal but for the last digits of their numbers."""
    if NUMBER.sub("#", a) != NUMBER.sub("#", b):
        return False
    pairs = zip(NUMBER.findall(a), NUMBER.findall(b), strict=True)
    return all(math.isclose(float(x), float(y), rel_tol=RTOL, abs_tol=ATOL) for x, y in pairs)


class _Text(HTMLParser):
    """The text of a page, a line for a row, without the columns that tell times."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[list[str]] = [[]]
        self.heads: set[int] = set()
        self.hidden = 0

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        """Begin a row or a cell."""
        self.hidden += tag in ("style", "script")
        if tag == "table":
            self.heads = set()
        if tag in ("tr", "table", "p", "div", "li", "br", "caption"):
            self.rows.append([])
        if tag in ("td", "th") or not self.rows[-1]:
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        """End a row: cells below a title of times are emptied."""
        self.hidden -= tag in ("style", "script")
        if tag == "tr":
            row = self.rows[-1]
            self.heads |= {k for k, text in enumerate(row) if text.strip() in TIMES}
            self.rows[-1] = ["" if k in self.heads else text for k, text in enumerate(row)]
            self.rows.append([])

    def handle_data(self, data: str) -> None:
        """Add to the last cell."""
        if not self.hidden:
            self.rows[-1] = self.rows[-1] or [""]
            self.rows[-1][-1] += data

    def lines(self) -> list[str]:
        """Return what was read."""
        return [" | ".join(" ".join(text.split()) for text in row) for row in self.rows]


def renew(path: Path, store: bool = True) -> list[str]:
    """Execute a notebook and store it if it shows something else than is stored."""
    import nbformat

    stored, fresh = (nbformat.read(path, as_version=4) for _ in range(2))
    with tempfile.TemporaryDirectory() as folder:
        execute(fresh, Path(folder))
    found = differences(stored, fresh)
    numbers = [[cell.execution_count for cell in code(one)] for one in (stored, fresh)]
    if store and (found or numbers[0] != numbers[1]):
        nbformat.write(fresh, path)
    return found


def main() -> None:
    """Renew what is named, or everything."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="notebooks; all if none is named")
    parser.add_argument("--check", action="store_true", help="store nothing, fail if not current")
    asked = parser.parse_args()
    names = asked.names or sorted(path.stem for path in FOLDER.glob("*.ipynb"))
    stale = False
    for name in names:
        found = renew(FOLDER / f"{name}.ipynb", store=not asked.check)
        stale |= bool(found)
        told = "current" if not found else "not current" if asked.check else "stored"
        print(name, told, *found[:20], sep="\n  ", flush=True)
    sys.exit(asked.check and stale)


if __name__ == "__main__":
    main()
