"""Plant mistakes in what guarantees rest on, one at a time, and print those that no test sees.

The mistakes stand in ``mutants.toml`` beside this file: a file of the package, the text that is
changed (once in the file), what it becomes, and the tests that have to fail. One that no test can
see because nothing changes says why; it is not planted.

    python tools/mutants.py                 # all; ends with 1 if one survives
    python tools/mutants.py lipschitz       # those whose file or text has the word
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[1]
ROOMS = ("symbolic", "derive", "designs", "codegen", "evaluate")


def copied(place: Path) -> Path:
    """Copy what tests need of this checkout, links as links."""
    for name in (*ROOMS, "src", "tests"):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(HERE / name, place / name, symlinks=True, ignore=ignored)
    shutil.copy(HERE / "pyproject.toml", place)
    return place


def survives(place: Path, mutant: dict[str, Any]) -> bool:
    """Plant a mutant in a copy and run its tests; leave the copy as it was."""
    path = place / mutant["file"]
    right = path.read_text()
    if right.count(mutant["was"]) != 1:
        raise SystemExit(f"{mutant['was']!r} does not stand once in {mutant['file']}")
    path.write_text(right.replace(mutant["was"], mutant["becomes"]))
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-n", "0"]
    environment = {**os.environ, "PYTHONPATH": str(place / "src"), "PYTHONDONTWRITEBYTECODE": "1"}
    tests = [str(place / test) for test in mutant["tests"]]
    done = subprocess.run(
        [*command, *tests], cwd=place, env=environment, capture_output=True, text=True, check=False
    )
    path.write_text(right)
    if done.returncode not in (0, 1):
        raise SystemExit(f"{' '.join(mutant['tests'])} did not run:\n{done.stdout[-2000:]}")
    return done.returncode == 0


def main() -> int:
    """Plant the mutants that are asked for and print the survivors."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("word", nargs="?", default="", help="in the file or in the text")
    word = parser.parse_args().word
    listed = tomllib.loads((Path(__file__).parent / "mutants.toml").read_text())["mutant"]
    chosen = [m for m in listed if word in m["file"] or word in m["was"]]
    planted = [m for m in chosen if "why" not in m]
    alive = []
    with tempfile.TemporaryDirectory() as name:
        place = copied(Path(name))
        for number, mutant in enumerate(planted, 1):
            lives = survives(place, mutant)
            alive += [mutant] if lives else []
            word = "SURVIVES" if lives else "caught"
            text = mutant["was"].strip()
            print(f"{number}/{len(planted)} {word:9} {mutant['file']}: {text}", flush=True)
    told = len(chosen) - len(planted)
    print(f"{len(planted)} planted, {len(alive)} survive; {told} change nothing, with the reason")
    return 1 if alive else 0


if __name__ == "__main__":
    sys.exit(main())
